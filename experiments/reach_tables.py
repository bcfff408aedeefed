"""Tables of reaching, for the READMEs: sweep, limits, ablation, speed, distances.

Each takes the path of one results file and gives Markdown; `make_readme.py` puts it in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown, read

from mjx_grasp.evaluation.reach.record import BUDGETS
from mjx_grasp.evaluation.reach.results import PAPER_HANDOFF_MM, PAPER_RATE
from mjx_grasp.records.table import Table


def reach_rates(path: Path, presets: Path) -> str:
    """The sweep and the preset `paper` beside the publication's, and the tip errors at handoff.

    Args:
        path: The sweep.
        presets: The ablation, one of whose rows is the preset, of its own number of poses. Without
            it the preset is left out.
    """
    d, others = read(path), read(presets)
    if d is None:
        return NOTHING
    sweeps, poses = {"ours": d}, f"{d['poses']:,} random cylinder poses"
    if others is not None and "paper" in others["rows"]:
        sweeps["preset `paper`"] = others["rows"]["paper"]
        if others["poses"] != d["poses"]:
            poses += f" (preset: {others['poses']:,})"
    names = " / ".join((*sweeps, "published"))
    columns = *(sweep["rate_percent"] for sweep in sweeps.values()), d["paper_rate_percent"]
    budgets = list(next(iter(columns[0].values())))
    rows = tuple(
        (f"{mm} mm", *(" / ".join(f"{rate[mm][b]:.1f}" for rate in columns) for b in budgets))
        for mm in columns[0]
    )
    rates = Table("Reach", ("tolerance", *(f"{b} s" for b in budgets)), rows)
    safe, started = d["limits"]["safe"], d["rate_percent_since_start"]["20"]
    errors = []
    for name, published in PAPER_HANDOFF_MM.items():
        tips = [sweep["handoff_mm"][name] for sweep in sweeps.values()]
        spreads = *((tip["mean"], tip["std"]) for tip in tips), published
        errors.append(f"{name} {' / '.join(f'{mean:.1f} ± {std:.1f}' for mean, std in spreads)}")
    return "\n\n".join(
        (
            f"Reaches that converged, in % ({names}), of {poses}, by tolerance and "
            "fine-adjustment time; a solution exists for "
            f"{d['solvable_percent']['20']:.1f} %. That timer runs while all tips are within "
            "140 mm, and the hand aligns before it comes so near. Counted from the start of the "
            f"motion, {started['1']:.1f} % are within 20 mm after 1 s, {started['2']:.1f} % after "
            f"2 s and {started['3']:.1f} % after 3 s; from "
            "when the tips were first within 140 mm, with a timer that a retreat does not set "
            f"back, {d['rate_percent_since_first_near']['20']['3']:.1f} %:",
            markdown(rates),
            f"Tip errors at handoff in mm ({names}): {'; '.join(errors)}.",
            f"Of {safe['reaches']:,} reaches that started at a safe distance none came nearer to "
            f"the object than {safe['least_object_distance_mm']:.1f} mm on any tick ("
            f"{1e3 * asked_clearance(d):.0f} mm are asked for), "
            f"no two fingers nearer than {safe['least_finger_distance_mm']:.1f} mm, and no joint "
            f"was faster than {safe['largest_speed_over_limit']:.2f} of its limit.",
        )
    )


def asked_clearance(d: dict[str, Any]) -> float:
    """What a sweep kept from the object, by its settings of today or of its time, [m]."""
    limits = d["settings"]["reach"]["limits"]
    return limits["clearances"]["object"] if "clearances" in limits else limits["object_clearance"]


def reach_limits(path: Path) -> str:
    """The worst of every tick of the sweep, by how a reach started."""
    d = read(path)
    if d is None:
        return NOTHING
    names = {
        "safe": "as far as asked or farther",
        "near": "nearer",
        "in_contact": "in contact, up to {:.0f} mm deep",
    }
    rows = []
    for kind, name in names.items():
        worst = d["limits"][kind]
        rows.append(
            (
                name.format(worst["deepest_start_mm"]),
                f"{worst['reaches']:,}",
                f"{worst['ticks']:,}",
                f"{worst['largest_speed_over_limit']:.2f}",
                f"{worst['farthest_beyond_joint_limit_rad']:.2f}",
                f"{worst['least_object_distance_mm']:.2f}",
                f"{worst['most_object_distance_lost_mm']:.3f}",
                f"{worst['least_table_height_over_asked_mm']:.2f}",
                f"{worst['least_finger_distance_mm']:.2f}",
                f"{worst['least_arm_to_itself_mm']:.1f}",
                f"{worst['ticks_infeasible']}",
            )
        )
    header = (
        *("start", "reaches", "ticks", "speed over its limit", "beyond a joint limit rad"),
        *("to object mm", "lost of it mm", "over the table's mm", "between fingers mm"),
        *("arm to itself mm", "infeasible ticks"),
    )
    return markdown(Table("Limits", header, tuple(rows)))


def reach_ablation(path: Path) -> str:
    """The published controller and each addition to it."""
    d = read(path)
    if d is None or "default" not in d["rows"]:  # it is made last
        return NOTHING
    shown = markdown(ablation_table(d["rows"]))
    solvable = d["rows"]["default"]["solvable_percent"]["20"]
    made: dict[str, list[str]] = {}
    for name, row in d["rows"].items():
        made.setdefault(row["provenance"]["device"], []).append(name)
    devices = "; ".join(f"{', '.join(names)} on {device}" for device, names in made.items())
    return (
        f"Reaches converged, in %, of {d['poses']:,} poses, for {solvable:.1f} % of which a "
        f"solution exists within 20 mm ({devices}):\n\n{shown}"
    )


def ablation_table(rows: dict[str, dict[str, Any]]) -> Table:
    """Rates of each preset's sweep beside the published ones, by tolerance and time.

    With errors of the wraps at handoff (index/middle), and how long half of the reaches took.
    """
    header = (
        "",
        *(f"{t} mm, {b} s" for t in (20, 10) for b in (1, 3, 7)),
        "wraps mm, median",
        "wraps mm, mean",
        "median s to 20 mm",
    )
    cells = []
    for name, row in rows.items():
        rate = [row["rate_percent"][t][b] for t in ("20", "10") for b in ("1", "3", "7")]
        wraps = [
            "/".join(f"{row['handoff_mm'][finger][kind]:.1f}" for finger in ("index", "middle"))
            for kind in ("median", "mean")
        ]
        seconds = row["seconds_to_20mm"]["50"]
        shown = "" if seconds is None else f"{seconds:.2f}"
        cells.append((name, *(f"{v:.1f}" for v in rate), *wraps, shown))
    paper = {t: dict(zip(BUDGETS, PAPER_RATE[t], strict=True)) for t in ("20", "10")}
    published = [f"{paper[t][b]:.1f}" for t in ("20", "10") for b in (1.0, 3.0, 7.0)]
    errors = "/".join(f"{PAPER_HANDOFF_MM[finger][0]:.1f}" for finger in ("index", "middle"))
    cells.append(("published", *published, "", errors, ""))
    return Table("Reaches converged [%], each row with one addition", header, tuple(cells))


def reach_speed(paths: Sequence[Path]) -> str:
    """Control ticks, and reaches one after another beside mink's."""
    ticks, reaches = [], []
    for path in paths:
        d = read(path)
        device = "" if d is None else d["provenance"]["device"]
        if d and d["processor_cores"] == 1:
            device = device.replace("2 cores", "1 of 2 cores")
        for row in d["rows"] if d else ():
            if "worlds" in row:
                shown = f"{row['ms_per_tick']:.2f}", f"{row['robot_ticks_per_s']:,.0f}"
                ticks.append((device, row["controller"], f"{row['worlds']:,}", *shown))
                continue
            if "converged_reaches_per_s" not in row:  # no comparison, for want of mink
                continue
            plan, whole = row.get("ms_per_plan"), row.get("reaches_per_s_with_planning")
            shown = (
                f"{row['longest_s']:g}",
                f"{row['converged_percent']:.0f}",
                f"{row['ms_per_tick']:.2f}",
                "" if not plan else f"{plan:.0f}",
                f"{row['reaches_per_s']:.1f}" if not plan else f"{whole:.1f}",
                f"{row['converged_reaches_per_s']:.1f}",
            )
            reaches.append((device, row["controller"], f"{row['reaches']}", *shown))
    if not ticks:
        return NOTHING
    header = ("device", "controller", "robots", "ms per tick", "robot ticks/s")
    others = (
        *("device", "controller", "reaches", "s at most", "converged %", "ms per tick"),
        *("ms per plan", "reaches/s with planning", "converged reaches/s"),
    )
    return (
        markdown(Table("Ticks", header, tuple(ticks), names=2))
        + "\n\nOne robot, one reach after another, until every tip is within 20 mm or time is "
        "up:\n\n" + markdown(Table("Reaches", others, tuple(reaches), names=2))
    )


def qp_speed(path: Path) -> str:
    """Solvers on the problems of the published and of the default controller's reaches."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = []
    for name in ("paper", "default"):
        for row in d[name]["rows"]:
            setup, kkt = row.get("problems_per_s_with_setup"), row.get("kkt_p99")
            errors = row["errors"]
            rows.append(
                (
                    name,
                    row["solver"],
                    f"{row['problems_per_s']:,.0f}"
                    + ("" if setup is None else f" ({setup:,.0f} with set-up)"),
                    *(f"{errors['velocity'][p]:.1e}" for p in ("p50", "p99")),
                    f"{errors['objective']['p99']:.1e}",
                    f"{errors['violation']['p99']:.1e}",
                    "" if kkt is None else f"{max(kkt.values()):.1e}",
                )
            )
    header = (
        *("reaches of", "solver", "problems/s", "error of q̇ rad/s, median", "99 %"),
        *("objective gap, 99 %", "violation m/s, 99 %", "largest KKT residual, 99 %"),
    )
    size = d["default"]
    return (
        f"{d['paper']['problems']:,} and {size['problems']:,} problems of {size['variables']} "
        f"variables and {size['half_spaces']} half-spaces, {size['together']:,} at once, on "
        f"{d['provenance']['device']}; the exact answers are qpax's in float64:\n\n"
        + markdown(Table("QP", header, tuple(rows), names=2))
    )


def signed_distances(path: Path) -> str:
    """Errors of the distance grids."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = d["rows"]
    worst = max(rows, key=lambda r: r["worst_mm"])
    percentile = sorted(r["percentile_95_mm"] for r in rows)[len(rows) // 2]
    return (
        f"Of {d['points']:,} points on and within {d['near_mm']:.0f} mm of each of {len(rows)} "
        f"objects, the signed distance by a grid of {d['spacing_mm']:g} mm is off by at most "
        f"{worst['worst_mm']:.2f} mm ({worst['object'].replace('_', ' ')}); for the median object "
        f"95 % are within {percentile:.2f} mm. For the worst object "
        f"{min(r['right_signs_percent'] for r in rows):.2f} % of the signs are right, half a cell "
        "and more from the surface." + _normals(d)
    )


def _normals(d: dict[str, Any]) -> str:
    """One sentence about the gradients; none about a file from before they were compared."""
    rows = d["rows"]
    if "points_normals" not in d:
        return ""

    def median(name: str, percentile: str) -> float:
        return sorted(r[name][percentile] for r in rows)[len(rows) // 2]

    slope, normal = "normal_to_finite_differences_deg", "normal_to_trimesh_deg"
    length = "normal_length_off_by"
    worst = max(rows, key=lambda r: r[normal]["95"])
    left_out = sorted(r["normals_left_out_percent"] for r in rows)[len(rows) // 2]
    return (
        f" At {d['points_normals']:,} of the points near it, less those within half a cell of the "
        f"surface or one of the medial axis ({left_out:.0f} % for the median object), the gradient "
        f"is within {max(r[slope]['95'] for r in rows):.1g}° of central finite differences for "
        f"95 % on every object, and {median(normal, '50'):.1f}° (median) and "
        f"{median(normal, '95'):.1f}° (95 %) from trimesh's direction for the median object, "
        f"{worst[normal]['95']:.1f}° (95 %) for the worst ({worst['object'].replace('_', ' ')}); "
        f"its length is off 1 by {median(length, '50'):.3f} (median) and "
        f"{median(length, '95'):.3f} (95 %), at worst {max(r[length]['95'] for r in rows):.3f} "
        "(95 %)."
    )
