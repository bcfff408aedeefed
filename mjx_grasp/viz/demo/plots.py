"""What happened in a grasp over time: errors, contacts, forces, rise, wrench; its stages behind."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes

from mjx_grasp.viz.plots import GREY, new_figure, png, style

FINGERS = (("thumb", "#c03a26"), ("index", "#2563a8"), ("middle", "#2e8b57"))
"""With the colours of their tips in pictures."""
STAGES = {
    "reaching": "#eef3fa",
    "closing": "#fdf3e4",
    "lifting": "#eaf6ee",
    "holding": "#f3eefa",
    "failed": "#fbe9e7",
}
"""Colours behind the curves."""
_LIFTED_MM = 100.0
_CM = 100.0
"""In a metre: with such levers moments are about as large as forces."""


class Curves(NamedTuple):
    """One grasp, tick by tick."""

    time: Float[np.ndarray, " t"]
    """since the start [s]"""
    tip_error: Float[np.ndarray, "t 3"]
    """of tips to standoffs while reaching, then of pads to contacts [m]"""
    touching: Bool[np.ndarray, "t 3"]
    """by the simulator"""
    observed: Bool[np.ndarray, "t 3"]
    """by the momentum observer"""
    felt: Float[np.ndarray, "t 3"]
    """estimated from joint torques [N]"""
    force: Float[np.ndarray, "t 3"]
    """by the simulator [N]"""
    rise: Float[np.ndarray, " t"]
    """of the object [m]"""
    net_force: Float[np.ndarray, " t"]
    """of contacts and weight together, on the object [N]"""
    net_moment: Float[np.ndarray, " t"]
    """the same about its centre of mass [N m]"""


class Stage(NamedTuple):
    """A phase of the grasp."""

    name: str
    start: float
    """[s]"""
    end: float
    """[s]"""


def grasp_plot(curves: Curves, stages: list[Stage]) -> bytes:
    """All curves above each other, as PNG."""
    figure = new_figure(6.4, 10.4)
    errors, contacts, forces, rise, wrench = figure.subplots(
        5, 1, sharex=True, gridspec_kw={"height_ratios": (3, 1.5, 3, 2.2, 2.2)}
    )
    t = curves.time
    for k, (name, colour) in enumerate(FINGERS):
        errors.plot(t, 1e3 * curves.tip_error[:, k], color=colour, linewidth=1.6, label=name)
        forces.plot(t, curves.force[:, k], color=colour, linewidth=0.8, alpha=0.35)
        forces.plot(t, curves.felt[:, k], color=colour, linewidth=1.6)
        for flags, height, alpha in ((curves.touching, 0.62, 0.95), (curves.observed, 0.22, 0.4)):
            _bars(contacts, t, flags[:, k], 2 - k + height, colour, alpha)
    errors.set_yscale("log")
    errors.set_ylim(1.0, max(1500.0, 2e3 * float(np.nanmax(curves.tip_error))))
    errors.legend(frameon=False, fontsize=9, loc="upper right", ncols=3)
    contacts.set_ylim(0, 3)
    contacts.set_yticks([0.5, 1.5, 2.5], [name for name, _ in reversed(FINGERS)], fontsize=9)
    forces.set_ylim(0, forces_up_to(curves))
    rise.plot(t, 1e3 * curves.rise, color="#1f2630", linewidth=1.8)
    rise.axhline(_LIFTED_MM, color=GREY, linewidth=0.8, linestyle="--")
    wrench.plot(t, curves.net_force, color="#1f2630", linewidth=1.4, label="force [N]")
    moment = _CM * curves.net_moment
    wrench.plot(t, moment, color="#8a5fbf", linewidth=1.4, label="moment [N cm]")
    wrench.set_ylim(0, wrench_up_to(curves))
    wrench.legend(frameon=False, fontsize=9, loc="upper right", ncols=2)
    wrench.set_xlabel("time [s]", fontsize=9, color=GREY)
    titles = (
        "tips to their targets, then pads to their contacts [mm]",
        "contact: touch (upper bar) and momentum observer (lower)",
        "force: estimated from joint torques, and the simulator's (thin) [N]",
        "rise of the object, and what counts as lifted [mm]",
        "wrench that contacts and weight leave: none while the object hangs still",
    )
    for ax, title in zip((errors, contacts, forces, rise, wrench), titles, strict=True):
        style(ax)
        ax.set_title(title, loc="left", fontsize=10, color=GREY)
        ax.set_xlim(t[0], t[-1])
        for stage in stages:
            ax.axvspan(stage.start, stage.end, color=STAGES[stage.name], zorder=0, linewidth=0)
    return png(figure)


def forces_up_to(curves: Curves) -> float:
    """Top of the axis of forces, above the simulator's and the estimated but for spikes [N]."""
    either = np.stack([curves.force, curves.felt])
    return 1.15 * max(2.0, float(np.nanpercentile(either, 99.5, axis=1).max()))


def wrench_up_to(curves: Curves) -> float:
    """Top of the axis of the wrench: above it but for impacts, and with room for the legend."""
    either = np.stack([curves.net_force, _CM * curves.net_moment])
    return 1.4 * max(1.0, float(np.nanpercentile(either, 99.5, axis=1).max()))


def stage_plot(stages: list[Stage]) -> bytes:
    """When which stage was, as one bar, as PNG."""
    figure = new_figure(6.4, 1.25)
    ax = figure.subplots()
    style(ax)
    ax.grid(False)
    for stage in stages:
        length = stage.end - stage.start
        ax.barh(0, length, left=stage.start, color=STAGES[stage.name], edgecolor="#9aa3b0")
        if length > 0.08 * stages[-1].end:
            words = f"{stage.name}\n{length:.2f} s"
            ax.text(stage.start + 0.5 * length, 0, words, ha="center", va="center", fontsize=9)
    ax.set_yticks([])
    ax.set_xlim(0, stages[-1].end)
    ax.set_xlabel("time [s]", fontsize=9, color=GREY)
    return png(figure)


def _bars(
    ax: Axes,
    t: Float[np.ndarray, " t"],
    flags: Bool[np.ndarray, " t"],
    height: float,
    colour: str,
    alpha: float,
) -> None:
    """A bar wherever flags are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    dt = t[1] - t[0]
    spans = [(t[a], t[b - 1] - t[a] + dt) for a, b in edges.reshape(-1, 2)]
    ax.broken_barh(spans, (height - 0.16, 0.32), color=colour, alpha=alpha, linewidth=0)
