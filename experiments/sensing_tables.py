"""Tables of `sensed_forces.py`, for the terminal and the README."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown

from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

Row = dict[str, Any]
SHORT = (0, -2, -1)
"""Of the conditions, those that shorter tables show: exact torques, then all errors at once."""


def sensed_forces(path: Path) -> str:
    """Everything that the README says of felt forces and contacts."""
    if not path.exists():
        return NOTHING
    d = read_json(path, "a results file")
    rows, settings = d["rows"], d["settings"]
    return "\n\n".join(
        (
            f"{rows[0]['trials']} grasps of {len(d['objects'])} objects in native MuJoCo under "
            "each condition, all ticks with more than "
            f"{settings['contact_n']:g} N on the finger (median / 95th percentile, N). *Out of "
            "reach* is the part of the error that exact torques of the same force at the pad would "
            "leave: a direction in which the finger's joints have no lever, damping, stops. "
            "*Free* is what is felt before anything is touched. The delay is from the solver's to "
            f"the estimate's crossing of {settings['crossing_n']:g} N, in the first contact that "
            f"lasts {settings['lasting_ticks']} ticks; *early* are those that the estimate had "
            "crossed before:",
            markdown(forces_table(rows)),
            "By phase of the grasp, for the grip with exact torques:",
            markdown(_phases_table(rows)),
            "Contact flags, tick by tick until the object is lost; delays are from the first "
            "contact that lasts, of those that were not flagged before it (early) or not at all:",
            markdown(flags_table(rows)),
            *(_calibration(d["calibration"], settings) if "calibration" in d else ()),
        )
    )


def forces_table(rows: Sequence[Row]) -> Table:
    """Errors of the forces, one line per controller, condition and finger."""
    header = (
        *("controller", "torques", "finger", "true", "norm error", "vector error"),
        *("out of reach", "free", "delay ms", "early %"),
    )
    cells = tuple(
        (
            row["controller"],
            row["condition"],
            finger,
            _pair(one["contact"]["true_n"]),
            _pair(one["contact"]["norm_error_n"]),
            _pair(one["contact"]["vector_error_n"]),
            _pair(one["contact"]["out_of_reach_n"]),
            _pair(one["free_motion_n"]),
            _pair(one["crossing"]["delay_ms"], 0),
            _of(one["crossing"], "early"),
        )
        for row in rows
        for finger, one in row["fingers"].items()
    )
    return Table("Felt forces", header, cells, names=3)


def flags_table(rows: Sequence[Row]) -> Table:
    """Contact flags, one line per controller, condition and finger."""
    header = (
        *("controller", "torques", "finger", "precision %", "recall %", "delay ms"),
        *("early %", "missed %", "contacts"),
    )
    conditions = list(dict.fromkeys(row["condition"] for row in rows))
    short = {conditions[k] for k in SHORT}
    cells = tuple(
        (
            row["controller"],
            row["condition"],
            finger,
            _percent(one["flag"]["precision"]),
            _percent(one["flag"]["recall"]),
            _pair(one["flag"]["delay_ms"], 0),
            _of(one["flag"], "early"),
            _of(one["flag"], "missed"),
            f"{one['flag']['contacts']:,}",
        )
        for row in rows
        if row["condition"] in short
        for finger, one in row["fingers"].items()
    )
    return Table("Contact flags", header, cells, names=3)


def _phases_table(rows: Sequence[Row]) -> Table:
    header = ("finger", "phase", "ticks", "true", "norm error", "vector error")
    cells = tuple(
        (
            finger,
            phase,
            f"{part['ticks']:,}",
            *(_pair(part[k]) for k in ("true_n", "norm_error_n", "vector_error_n")),
        )
        for finger, one in rows[0]["fingers"].items()
        for phase, part in one["phases"].items()
    )
    return Table("Phases", header, cells, names=2)


def _calibration(d: dict[str, Any], settings: dict[str, Any]) -> tuple[str, str]:
    """The sweep of thresholds: all torques at the default's speed and at the chosen one's."""
    best, now = d["chosen"], d["default"]
    asked = f"{100 * settings['precision']:g} %"
    found = (
        f"no setting reaches {asked}"
        if best is None
        else f"{best['contact_torque']:g} N m under {best['stall_speed']:g} rad/s, with "
        f"{_percent(best['precision'])} % and {_percent(best['recall'])} %"
    )
    speeds = {now["stall_speed"], *([] if best is None else [best["stall_speed"]])}
    conditions = list(dict.fromkeys(r["condition"] for r in d["rows"]))
    shown = [r for r in d["rows"] if r["stall_speed"] in speeds]
    header = (
        *("torque N m", "speed rad/s"),
        *(f"{what}, {c}" for c in conditions for what in ("precision / recall %", "delay ms")),
    )
    cells = []
    for torque, speed in dict.fromkeys((r["contact_torque"], r["stall_speed"]) for r in shown):
        same = [r for r in shown if (r["contact_torque"], r["stall_speed"]) == (torque, speed)]
        parts = []
        for r in same:
            parts += [
                f"{_percent(r['precision'])} / {_percent(r['recall'])}",
                _pair(r["delay_ms"], 0),
            ]
        cells.append((f"{torque:g}", f"{speed:g}", *parts))
    text = (
        f"Thresholds swept on the training states of {len(d['objects'])} training objects "
        f"({settings['calibration_episodes']} grasps each), the grip's own flags being those of "
        f"the default ({now['contact_torque']:g} N m under {now['stall_speed']:g} rad/s). Of those "
        f"with a precision of {asked} or more under every condition, the one of most recall "
        f"(precision and recall under the worst): {found}."
    )
    return text, markdown(Table("Thresholds", header, tuple(cells), names=2))


def _pair(values: Sequence[float | None], digits: int = 2) -> str:
    return " / ".join("–" if v is None else f"{v:.{digits}f}" for v in values)


def _of(onsets: dict[str, Any], what: str) -> str:
    return _percent(onsets[what] / onsets["contacts"] if onsets["contacts"] else None)


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"
