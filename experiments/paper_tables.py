"""The publication's claims, errors of the pose and long holds as tables, beside its figures.

`make_readme.py` puts them in place.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from collect_runs import run_rows
from end_to_end_tables import bar_is_met, best, from_home
from markdown_tables import NOTHING, markdown

from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import Column
from mjx_grasp.evaluation.judging import SameStarts, mean_force, mean_success, resampled
from mjx_grasp.evaluation.results import OUTCOMES, ResultRow, read_results
from mjx_grasp.objects.catalogue import resolve
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table
from mjx_grasp.tasks.config import StartNoise

_FORCE_N = 3.0
"""Of the published squeeze."""
_OFFSET_MM = 5.0
"""Of the trials that stand for the published ones."""
_SQUEEZE = f"squeeze {_FORCE_N:g} N"
_FAILED = {"never_lifted": "never lifted", "not_held": "not held", "slipped": "slipped"}
_PUBLISHED_ELIGIBLE = 28 - paper.WITHOUT_GRASP
_LONG_S = 8.0
"""How long the publication shows a hold."""

Pair = list[list[ResultRow] | None]
"""A policy's rows and a squeeze's, where there are any."""
_OF_THE_EIGHT = ("ours", "ours from states of the published gate", "preset `paper`")
_OF_ALL = ("ours", "preset `paper`")
Cells = dict[tuple[float, ...], dict[str, Any]]


def summed(rows: list[dict[str, Any]], by: tuple[str, ...] = ("offset_mm", "angle_deg")) -> Cells:
    """Success, its bootstrap interval over start states, and the force of each cell.

    Args:
        rows: Of one controller.
        by: What tells cells apart.
    """
    found: Cells = {}
    for at in dict.fromkeys(tuple(row[name] for name in by) for row in rows):
        of = [row for row in rows if tuple(row[name] for name in by) == at]
        lengths = [len(row["outcomes"]) for row in of]
        trials = SameStarts(
            np.array([[c == OUTCOMES["successes"] for row in of for c in row["outcomes"]]]),
            np.array([[f for row in of for f in row["forces_n"]]], float),
            np.repeat(np.arange(len(of)), lengths),
            np.array([start for row in of for start in row["starts"]]),
        )
        weights = resampled(trials)
        success = mean_success(trials, weights)[:, 0]
        low, high = np.percentile(success[1:], (2.5, 97.5))
        force = float(mean_force(trials, weights[:1])[0, 0])
        found[at] = {"success": success[0], "low": low, "high": high, "force": force}
    return found


def cell_text(cell: dict[str, Any]) -> str:
    """Success with its interval, and the force where anything began to be lifted."""
    success = f"{cell['success']:.1f} ({cell['low']:.0f}–{cell['high']:.0f})"
    return success + (f", {cell['force']:.1f} N" if np.isfinite(cell["force"]) else "")


def pose_errors(path: Path) -> str:
    """One line per error, one column per controller."""
    if not path.exists():
        return NOTHING
    content = read_json(path, "a table of pose errors")
    cells = {name: summed(rows) for name, rows in content["controllers"].items()}
    lines = []
    for offset, angle in next(iter(cells.values())):
        published = paper.POSE_ERROR.get((offset, angle))
        shown = (cell_text(of[offset, angle]) for of in cells.values())
        theirs = "" if published is None else f"{published:.1f}"
        lines.append((f"±{offset:g} mm", f"{angle:g}°", *shown, theirs))
    header = ("moved", "turned", *cells, "paper: policy")
    return markdown(Table("Pose errors", header, tuple(lines), names=2))


def stability(path: Path) -> str:
    """How long each controller holds, in the engine's usual friction and in a stiffer one."""
    if not path.exists():
        return NOTHING
    content = read_json(path, "a table of long holds")
    lines = []
    for name, impratio in dict.fromkeys((r["controller"], r["impratio"]) for r in content["rows"]):
        of = [r for r in content["rows"] if (r["controller"], r["impratio"]) == (name, impratio)]
        lifted = [row for row in of if row["held_s"] > 0]
        forces = [row["force_n"] for row in lifted if row["force_n"] is not None]
        lines.append(
            (
                name,
                f"{impratio:g}",
                f"{len(lifted)} of {len(of)}",
                f"{sum(row['held_s'] >= _LONG_S for row in lifted)}",
                f"{sum(row['held_to_the_end'] for row in lifted)}",
                f"{np.median([row['held_s'] for row in lifted]):.1f}" if lifted else "",
                f"{np.mean(forces):.1f}" if forces else "",
            )
        )
    seconds = content["settings"]["seconds"]
    header = (
        *("controller", "impratio", "lifted by 5 cm", f"held {_LONG_S:g} s more"),
        *(f"held to the end of {seconds:g} s", "held s, median", "force N"),
    )
    return markdown(Table("Long holds", header, tuple(lines), names=1))


class Claim(NamedTuple):
    """A sentence of the publication that can be tested, and what came of it."""

    says: str
    published: str
    ours: str
    holds: bool
    why: str

    def row(self) -> tuple[str, ...]:
        """A line of the table."""
        return self.says, self.published, self.ours, "holds" if self.holds else "does not", self.why


def claims(folder: Path) -> str:
    """The publication's claims beside our figures, those for which there are results."""
    found = [claim for of in _CLAIMS if (claim := of(folder)) is not None]
    if not found:
        return NOTHING
    header = ("claim", "published", "here", "", "why, as far as we know")
    return markdown(Table("Claims", header, tuple(claim.row() for claim in found), names=5))


def eight(folder: Path) -> str:
    """Success on the eight objects and how trials fail: ours, the published setting, published.

    Ours are in `beside`, from planned states and from those of the published gate; from the latter
    the preset `paper` has a policy of its own in `paper_preset`, with squeezes in its task.
    """
    files = ("beside/planned.json", "beside/gate.json", "paper_preset/eight.json")
    return _beside([_pair(folder / name) for name in files], _OF_THE_EIGHT, each=True)


def all_objects(folder: Path) -> str:
    """The same over all training objects that have start states, as means."""
    path = folder / "objects" / "reached.json"
    ours: Pair = [None, None]
    if path.exists():
        training = set(resolve(("train",)))
        rows = [r for r in read_results(path).rows if r.object in training]
        ours = [_nominal(rows, name, _FORCE_N) for name in ("policy", "squeeze")]
    preset = _pair(folder / "paper_preset" / "objects.json")
    return _beside([ours, preset], _OF_ALL, each=False)


def _pair(path: Path) -> Pair:
    """Policy and squeeze of a file."""
    if not path.exists():
        return [None, None]
    rows = list(read_results(path).rows)
    return [_nominal(rows, name, _FORCE_N) for name in ("policy", "squeeze")]


def _nominal(rows: list[ResultRow], controller: str, force: float) -> list[ResultRow] | None:
    """A controller's rows at ±5 mm: a policy, with this budget if it knows any, or a squeeze."""
    found = [r for r in rows if r.controller == controller and r.offset_mm == _OFFSET_MM]
    if controller == "squeeze":
        found = [r for r in found if r.squeeze_force_n == force and r.squeeze_split == "even"]
    else:
        found = [r for r in found if r.force_budget_n in (None, force)]
    return [r for r in found if r.friction == StartNoise().friction[0]] or None


def _beside(pairs: Sequence[Pair], names: Sequence[str], each: bool) -> str:
    """Policies, then squeezes, of each setting, the published ones last.

    Args:
        pairs: Policy and squeeze of each.
        names: What they are called.
        each: Whether object by object; else means and published means alone.
    """
    if any(rows is None for pair in pairs for rows in pair):
        return NOTHING
    policies, squeezes = zip(*pairs, strict=True)
    columns = [rows for rows in (*policies, *squeezes) if rows]

    def line(name: str, cells: Sequence[str], published: Sequence[str]) -> tuple[str, ...]:
        half = len(pairs)
        return (name, *cells[:half], published[0], *cells[half:], published[1])

    lines = []
    for name, of in paper.OBJECTS.items() if each else ():
        cells = [f"{_mean([r for r in rows if r.object == name]):.1f}" for rows in columns]
        lines.append(line(name, cells, (f"{of.ours:.1f}", f"{of.squeeze:.1f}")))
    means = (paper.MEAN.ours, paper.MEAN.squeeze) if each else paper.ALL_ELIGIBLE
    summed = [Column("", {row.object: row for row in rows}).mean() for rows in columns]
    cells = [f"**{mean:.1f}** ({low:.1f}–{high:.1f})" for mean, (low, high) in summed]
    lines.append(line("**mean**", cells, [f"**{mean:.1f}**" for mean in means]))
    for failure, word in _FAILED.items():
        theirs = [f"{of[failure]:.1f}" if each else "" for of in paper.FAILURES.values()]
        lines.append(line(word, [f"{_mean(rows, failure):.1f}" for rows in columns], theirs))
    forces = ([r.force_mean_n for r in rows if r.force_mean_n is not None] for rows in columns)
    lines.append(line("force per finger", [f"{np.mean(of):.1f} N" for of in forces], ("", "")))
    trials = [", ".join(map(str, sorted({r.episodes for r in rows}))) for rows in columns]
    lines.append(line("trials of each", trials, 2 * [str(paper.EPISODES)]))
    whole = str(len(paper.OBJECTS)) if each else str(_PUBLISHED_ELIGIBLE)
    lines.append(line("objects", [str(len(rows)) for rows in columns], 2 * [whole]))
    titles = [f"{who}, {name}" for who in ("policy", "squeeze 3 N") for name in names]
    header = line("", titles, ("policy, published", "squeeze 3 N, published"))
    return markdown(Table("Beside the publication", header, tuple(lines)))


def _both(folder: Path) -> tuple[list[ResultRow], list[ResultRow]] | None:
    """The policy with the budget of the published squeeze, and that squeeze."""
    policy, squeeze = _pair(folder / "beside" / "planned.json")
    return None if policy is None or squeeze is None else (policy, squeeze)


def _mean(rows: Sequence[ResultRow], what: str = "successes") -> float:
    return float(np.mean([100 * getattr(row, what) / row.episodes for row in rows]))


def _lifts_more(folder: Path) -> Claim | None:
    both = _both(folder)
    if both is None:
        return None
    policy, squeeze = map(_mean, both)
    return Claim(
        "the policy lifts more often than a squeeze of 3 N",
        f"{paper.MEAN[0]:.1f} % against {paper.MEAN[1]:.1f} %",
        f"{policy:.1f} % against {squeeze:.1f} %",
        policy > squeeze,
        "what counts is success at the same force",
    )


def _squeeze_lifts_as_often(folder: Path) -> Claim | None:
    both, (_, same) = _both(folder), _pair(folder / "beside" / "gate.json")
    if both is None or same is None:
        return None
    planned, alike = _mean(both[1]), _mean(same)
    return Claim(
        "a squeeze of 3 N lifts a little more than half of the trials",
        f"{paper.MEAN.squeeze:.1f} %",
        f"{alike:.1f} % from states of the published gate, {planned:.1f} % from planned ones",
        abs(alike - paper.MEAN.squeeze) < 5.0,
        "hand, objects and friction are near enough to the publication's",
    )


def _fair_opponent(folder: Path) -> Claim | None:
    both = _both(folder)
    if both is None:
        return None
    forces = [[r.force_mean_n for r in rows if r.force_mean_n is not None] for rows in both]
    if not all(forces):
        return None
    policy, squeeze = (float(np.mean(of)) for of in forces)
    fair = abs(policy - squeeze) < 0.1 * policy
    return Claim(
        "a squeeze of 3 N is the opponent to compare with",
        "no forces given",
        f"{policy:.1f} N per finger against {squeeze:.1f} N",
        fair,
        "so much of this budget is what the policy happens to spend"
        if fair
        else "commanded force is not contact force: the squeeze is a spring that lets go",
    )


def _slips(folder: Path) -> Claim | None:
    both = _both(folder)
    if both is None:
        return None
    ours, theirs = (_mean(rows, "slipped") for rows in both)
    lost = _mean(both[1], "never_lifted")
    return Claim(
        "the squeeze slips ten times as often as the policy",
        f"{paper.FAILURES['squeeze']['slipped']:.1f} % against "
        f"{paper.FAILURES['ours']['slipped']:.1f} %",
        f"{theirs:.1f} % against {ours:.1f} %",
        theirs >= 10 * max(ours, 0.1),
        f"here a weak squeeze does not lift at all ({lost:.1f} %)",
    )


def _sugar_box(folder: Path) -> Claim | None:
    both = _both(folder)
    if both is None:
        return None
    gains = {
        row.object: 100 * row.successes / row.episodes - 100 * other.successes / other.episodes
        for row, other in zip(*(sorted(rows, key=lambda r: r.object) for rows in both), strict=True)
    }
    most = max(gains, key=lambda name: gains[name])
    published = paper.OBJECTS["sugar_box"]
    return Claim(
        "the gain is largest on the sugar box",
        f"{published[0] - published[1]:+.1f} points",
        f"{gains['sugar_box']:+.1f} points; largest on the {most.replace('_', ' ')}",
        most == "sugar_box",
        "of the eight it is the heaviest",
    )


def _margin(folder: Path) -> Claim | None:
    path = folder / "pose_error.json"
    if not path.exists():
        return None
    rows = read_json(path, "a table of pose errors")["controllers"]
    policy = next((summed(of) for name, of in rows.items() if name.startswith("policy")), None)
    squeeze = summed(rows[_SQUEEZE]) if _SQUEEZE in rows else None
    if policy is None or squeeze is None:
        return None
    first, last = min(policy), max(policy)
    margins = [policy[at]["success"] - squeeze[at]["success"] for at in (first, last)]
    return Claim(
        "the margin over the squeeze narrows as the error of the pose grows",
        "as a figure",
        f"{margins[0]:+.1f} points without an error, {margins[1]:+.1f} at ±{last[0]:g} mm and "
        f"{last[1]:g}°",
        margins[1] < margins[0],
        "a grip that feels adapts to where the object is",
    )


def _holds_longer(folder: Path) -> Claim | None:
    path = folder / "lift_stability.json"
    if not path.exists():
        return None
    rows = read_json(path, "a table of long holds")["rows"]

    def kept(who: str, stiff: bool) -> tuple[int, int]:
        """Of those that the first such controller lifted: held to the end, and all of them."""
        level = (max if stiff else min)(row["impratio"] for row in rows)
        name = next(r["controller"] for r in rows if r["controller"].startswith(who))
        of = [r for r in rows if (r["impratio"], r["controller"]) == (level, name)]
        lifted = [row for row in of if row["held_s"] > 0]
        return sum(row["held_to_the_end"] for row in lifted), len(lifted)

    (soft, n), (stiff, m) = (kept("squeeze", friction) for friction in (False, True))
    held, of = kept("policy", False)
    return Claim(
        "a squeezed object comes loose after some seconds, one that the policy holds does not",
        "one trial of each",
        f"held to the end: {soft} of {n} squeezed and {held} of {of} by the policy; {stiff} of {m} "
        "squeezed ones with stiffer friction",
        held == of and soft < n and stiff < m,
        "the engine's friction gives way while it bears a load, whoever holds",
    )


def _no_pre_grasp(folder: Path) -> Claim | None:
    path = folder / "eligibility.json"
    if not path.exists():
        return None
    compared = {row["settings"]: row for row in read_json(path, "eligibility")["compared"]}
    published = compared["published"]
    usual = [row for name, row in compared.items() if name.startswith("default")]
    ours = max((row["eligible"] for row in usual), default=published["eligible"])
    return Claim(
        "four of the 28 objects have no pre-grasp",
        f"{paper.WITHOUT_GRASP}",
        f"{published['of'] - published['eligible']} with the published scores, "
        f"{published['of'] - ours} with ours",
        published["of"] - published["eligible"] == paper.WITHOUT_GRASP,
        "wrap contacts closer together suit small balls and thin walls",
    )


def _more_time(folder: Path) -> Claim | None:
    path = folder / "reach_sweep_cpu.json"
    if not path.exists():
        return None
    d = read_json(path, "a reach sweep")
    ours, published = d["rate_percent"]["20"], d["paper_rate_percent"]["20"]
    if not {"3", "7"} <= ours.keys():
        return None
    return Claim(
        "more than 3 s for fine adjustment helps little",
        f"{published['3']:.1f} % after 3 s, {published['7']:.1f} % after 7 s",
        f"{ours['3']:.1f} % after 3 s, {ours['7']:.1f} % after 7 s",
        ours["7"] - ours["3"] < 2.0,
        "what is not reached by then is not within reach on this way; a new plan helps",
    )


def _as_published(folder: Path) -> Claim | None:
    """Trainings of the preset `paper`: the one with most success in training, and all of them."""
    files = sorted((folder / "seeds").glob("published-*.json"))
    table = folder / "training_runs.json"
    if not files or not table.exists():
        return None
    rows = {path.stem: read_results(path).rows for path in files}
    trained = {row["run"]: row["training_success_percent"] for row in run_rows(table)}
    chosen = max(rows, key=lambda run: trained[run])
    lifted = {run: _mean(of) for run, of in rows.items()}
    most = max(rows, key=lambda run: lifted[run])
    force = float(np.mean([row.force_mean_n for row in rows[most]]))
    return Claim(
        "of several trainings as published the best in training lifts the eight",
        f"{paper.MEAN[0]:.1f} %, of eighteen",
        f"{lifted[chosen]:.1f} % (`{chosen}`), of {len(rows)}, which lift "
        f"{min(lifted.values()):.1f} to {lifted[most]:.1f} %, the most of them at {force:.1f} N",
        lifted[chosen] >= paper.MEAN[0],
        "seeds end far apart, and success in training does not tell which is the best",
    )


def _end_to_end(folder: Path) -> Claim | None:
    judged = from_home(folder)
    if not judged:
        return None
    met = bar_is_met(judged)
    shown = dict.fromkeys((next(iter(judged)), best(judged)[0]))  # the first is as published
    return Claim(
        "a policy that also reaches does not learn to grasp from home",
        f"{paper.END_TO_END:g} %",
        ", ".join(f"{judged[run].mean()[0]:.1f} % (`{run}`)" for run in shown),
        not met,
        "not as published; with a way that leads over the object, a faster arm, actions for all "
        "joints and many more steps it does"
        if met
        else "beside the object it learns; the farther away episodes begin, the fewer succeed",
    )


_CLAIMS = (
    *(_lifts_more, _squeeze_lifts_as_often, _fair_opponent, _slips, _sugar_box, _margin),
    *(_holds_longer, _no_pre_grasp, _more_time, _as_published, _end_to_end),
)
