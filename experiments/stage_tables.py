"""Tables for the READMEs: heatmaps, start states and the plans that they come from.

Each takes the path of a results file, or several, and gives Markdown; `make_readme.py` puts it in
place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown, read

from mjx_grasp.evaluation.results import OUTCOMES
from mjx_grasp.records.table import Table


def heatmap_oracle(path: Path) -> str:
    """Agreement with the independent implementation."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = tuple(
        (
            backend,
            f"{s['vertices']:,}",
            f"{s['agree']:,}",
            f"{s['least_agree_percent']:.2f}",
            ", ".join(f"{count} {why}" for why, count in s["exceptions"].items()),
        )
        for backend, s in d["summary"].items()
    )
    header = ("backend", "vertices", f"agree to {d['score_tolerance']:g}", "worst scan %", "others")
    return markdown(Table("Oracle", header, rows))


def heatmap_ranking(path: Path) -> str:
    """Where the objects that the publication calls hard stand among all."""
    d = read(path)
    if d is None:
        return NOTHING
    seen = d["watched"]
    rows = tuple(
        (name.replace("_", " "), f"{rank}", f"{seen['rank_by_good_share'][name]}")
        for name, rank in seen["rank_by_best_mean"].items()
    )
    header = (
        f"rank of {seen['of']} by",
        f"mean of the best {100 * d['best_share']:.0f} %",
        f"share above {d['good_score']:g}",
    )
    last = ", ".join(name.replace("_", " ") for name in seen["last_four"])
    return f"{markdown(Table('Ranking', header, rows))}\n\nThe last four: {last}."


def eligibility(path: Path) -> str:
    """Which settings make which objects eligible, and what limits those that are not."""
    d = read(path)
    if d is None:
        return NOTHING
    compared = []
    for row in d["compared"]:
        kept, ranks = row["overlap_of_the_eight"], sorted(row["ranks"].values())
        compared.append(
            (
                row["settings"],
                f"{row['eligible']} of {row['of']}",
                ", ".join(str(rank) for rank in ranks),
                f"{100 * kept['mean']:.0f} ({100 * kept['least']:.0f})",
            )
        )
    header = ("settings", "eligible", "ranks of the four", "kept on the eight, mean (least) %")
    first, last = (d["compared"][k]["settings"] for k in (0, -1))
    limited = tuple(
        (
            row["object"].replace("_", " "),
            row[first]["limit"],
            *(f"{row[first][key]:.3f}" for key in ("best", "best_without_it")),
            *(f"{row[first]['candidates']}", f"{row[last]['candidates']}"),
            *(f"{row[last]['best']:.3f}", f"{100 * row[last]['share']:.1f}"),
        )
        for row in sorted(d["rows"], key=lambda row: row[last]["share"])
    )
    names = ("object", "limited by", "best", "best without it", "candidates")
    titles = (*names, "with the default", "best", "share of the surface %")
    return "\n\n".join(
        (
            markdown(Table("Settings", header, tuple(compared))),
            markdown(Table("Objects", titles, limited, names=2)),
        )
    )


def failing_starts(path: Path) -> str:
    """What tells the start states that always fail from the others, and the reasons."""
    d = read(path)
    if d is None:
        return NOTHING
    refused = {
        name: text
        for name, text in (("lift", "left without lift"), ("lift and reach", "and without reach"))
        if any(part["left_by"][name]["states"] < part["states"] for part in d["parts"])
    }
    rows = []
    for part in d["parts"]:
        left = part["left_by"]
        rows.append(
            (
                part["part"],
                f"{part['failing']} of {part['states']}",
                *(f"{part['auc'][name]:.2f}" for name in part["auc"]),
                *(f"{left[k]['failing']} of {left[k]['states']}" for k in refused),
            )
        )
    told = [{"score": "low score"}.get(name, name) for name in d["parts"][0]["auc"]]
    header = ("states", "always fail", *told, *refused.values())
    reasons, objects = (_counted(row[of] for row in d["rows"]) for of in ("reason", "object"))
    return (
        f"{markdown(Table('Failing starts', header, tuple(rows)))}\n\n"
        f"Of the training states that always fail: {reasons}; {objects}. An arm cannot lift if the "
        f"palm ends more than {1e3 * d['lift_error_m']:.0f} mm from where it should, a finger "
        f"cannot reach if its pad stays more than {1e3 * d['reach_m']:.0f} mm from the contact; "
        f"the least force is that at friction {d['friction']:g}."
    )


def _counted(names: Iterable[str]) -> str:
    """How often each name comes, the most frequent first."""
    counts = Counter(name.replace("_", " ") for name in names)
    return ", ".join(f"{name} {n}" for name, n in counts.most_common())


def plan_weights(path: Path) -> str:
    """What states of plans with other weights are worth."""
    d = read(path)
    if d is None:
        return NOTHING
    lines, named = [], d["variants"].values()
    names = [row["controller"] for row in next(iter(named))["rows"]]
    for name, variant in d["variants"].items():
        factors = ", ".join(f"`{of}` × {by:g}" for of, by in variant["factors"].items())
        cells = (_lifted_at(row) for row in variant["rows"])
        lines.append((name, factors, str(variant["states"]), *cells))
    header = ("plans", "settings", "states", *names)
    trials, name = d["settings"]["episodes"], d["settings"]["object"].replace("_", " ")
    return (
        f"{markdown(Table('Plan weights', header, tuple(lines), names=2))}\n\n"
        f"Success in % and mean force per finger in N of {trials} trials each, {name}."
    )


def _lifted_at(row: dict[str, Any]) -> str:
    """Success, and the force over all trials that begin to lift."""
    forces = [force for force in row["forces_n"] if force is not None]
    lifted = row["outcomes"].count(OUTCOMES["successes"]) / len(row["outcomes"])
    return f"{100 * lifted:.1f} at {sum(forces) / max(len(forces), 1):.2f}"
