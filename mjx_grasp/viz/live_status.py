"""What the live page says of a grasp: the phase, the fingers, the outcome; pure."""

from __future__ import annotations

import html

from mjx_grasp.pipeline.phases import Phase
from mjx_grasp.viz.demo.plots import FINGERS, STAGES
from mjx_grasp.viz.live_tick import HELD, LiveTick

SLOW = 0.95
"""Share of real time below which the page says how slow it is [-]."""
_STYLE = "padding:2px 12px 8px;font-size:13px;line-height:1.5;font-variant-numeric:tabular-nums"
_CHIP = "padding:1px 6px;border-radius:9px;margin-right:3px;white-space:nowrap;font-size:11px"
_GOOD, _BAD, _INK, _FAINT = "#1d7a43", "#b03020", "#1f2630", "#9aa3b0"


def note(text: str) -> str:
    """A line of text as HTML.

    Args:
        text: Plain.
    """
    return f"<div style='{_STYLE}'>{html.escape(text)}</div>"


def status(tick: LiveTick, pace: float = 1.0, stopped: bool = False) -> str:
    """A grasp as HTML: where it stands, each finger, what came of it.

    Args:
        tick: The last one.
        pace: Simulated time per real time [-].
        stopped: Whether somebody has ended it.
    """
    slow = f", {pace:.1f} of real time" if pace < SLOW else ""
    now = Phase(int(tick.phase))
    headline = f"<b>{_name(now)}</b> at {tick.clock:.1f} s{slow}"
    chips = "".join(_chip(phase, now) for phase in list(Phase)[:-1])
    outcome = _outcome(tick, stopped)
    return (
        f"<div style='{_STYLE}'><div>{headline}</div><div style='margin:3px 0 5px'>{chips}</div>"
        f"{_fingers(tick)}<div>raised {1e3 * max(tick.rise, 0.0):.0f} mm</div>{outcome}</div>"
    )


def _name(phase: Phase) -> str:
    return phase.name.lower()


def _chip(phase: Phase, now: Phase) -> str:
    """One stage; those that have been are coloured, the present one is framed."""
    been = phase <= now and now != Phase.FAILED
    frame = f"1px solid {'#5b6470' if phase == now else 'transparent'}"
    back, ink = (STAGES[_name(phase)], _INK) if been else ("#f3f4f6", _FAINT)
    return (
        f"<span style='{_CHIP};border:{frame};background:{back};color:{ink}'>{_name(phase)}</span>"
    )


def _fingers(tick: LiveTick) -> str:
    """A row per finger: how far its tip is, whether it touches, how hard."""
    cell = "<td style='text-align:right;padding-left:12px'>"
    heads = "".join(f"{cell}{each}</td>" for each in ("to go", "contact", "force"))
    rows = [f"<tr style='color:{_FAINT}'><td></td>{heads}</tr>"]
    for (name, colour), error, touches, force in zip(
        FINGERS, tick.tip_error, tick.touching, tick.force, strict=True
    ):
        dot = f"<span style='color:{colour}'>●</span>"
        rows.append(
            f"<tr><td>{dot} {name}</td>{cell}{1e3 * error:.0f} mm</td>"
            f"{cell}{'yes' if touches else 'no'}</td>{cell}{force:.1f} N</td></tr>"
        )
    return f"<table style='border-collapse:collapse'>{''.join(rows)}</table>"


def _outcome(tick: LiveTick, stopped: bool) -> str:
    text = tick.outcome
    colour = _BAD if tick.phase == Phase.FAILED else _GOOD if text == HELD else _INK
    if stopped and tick.phase != Phase.FAILED:
        text = "stopped" if text is None else f"{text}, then stopped"
    return "" if text is None else f"<div><b style='color:{colour}'>{html.escape(text)}</b></div>"
