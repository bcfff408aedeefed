"""Trained policies side by side, for the READMEs and the figure of success against force.

A file of results says in its command which run's policy it evaluated; the table of the runs says
how that one was trained.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from choose_policy import points_table, ranked
from collect_runs import run_rows
from jaxtyping import Float
from markdown_tables import NOTHING, markdown

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.conditions import POLICIES, Column, Condition, Groups, read_groups
from mjx_grasp.evaluation.judging import (
    gains_within,
    resampled,
    same_starts,
    success_within,
)
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.provenance import file_digests
from mjx_grasp.records.table import Table


class Evaluated(NamedTuple):
    """One policy under one condition, and how it was trained."""

    run: str
    setting: str
    """Worlds × unroll and the number of steps, in words."""
    seed: int
    condition: Condition
    column: Column


def comparisons(folder: Path) -> list[Path]:
    """The results files that have policy and squeeze from the same states."""
    return sorted(folder.glob("eight_*.json"))


def evaluated_policies(folder: Path, shipped: Path) -> list[Evaluated]:
    """The evaluated policies whose training is in the table of runs, in that table's order.

    All of them were told their budget alone.

    Args:
        folder: The results files; those of policies are in its `seeds`, the shipped one's in its
            `not_kept`.
        shipped: The policy that an evaluation takes if its command names none.

    Raises:
        FileError: A file cannot be read.
    """
    table = folder / "training_runs.json"
    trained = {row["run"]: row for row in run_rows(table)} if table.exists() else {}
    found = []
    for path in sorted((*folder.glob("not_kept/*.json"), *folder.glob("seeds/*.json"))):
        own = [
            (condition, column)
            for condition, columns in read_groups([path]).items()
            for column in columns
            if column.family in POLICIES
        ]
        if own and (run := _run_of(path, shipped)) in trained:
            row = trained[run]
            found += [Evaluated(run, _setting(row), row["seed"], *part) for part in own]
    runs = list(trained)

    def order(policy: Evaluated) -> tuple[int, bool, float, float]:
        c = policy.condition
        return runs.index(policy.run), c.engine != "mujoco", -c.friction, c.offset_mm

    return sorted(found, key=order)


def squeezes_by_condition(folder: Path) -> Groups:
    """The squeezes that the policies are compared with."""
    return {
        condition: [c for c in columns if c.family == "squeeze"]
        for condition, columns in read_groups(comparisons(folder)).items()
    }


def squeeze_at(force: float, squeezes: Sequence[Column]) -> str:
    """Mean success of a squeeze with so much contact force [%], on straight lines between those.

    Beyond the hardest it says from where on; empty below the lightest.
    """
    points = sorted((c.forces()[0] or 0.0, c.success()) for c in squeezes)
    if not points or force < points[0][0]:
        return ""
    hardest, most = points[-1]
    if force > hardest:
        return f"{most:.1f} at {hardest:.1f} N"
    return f"{np.interp(force, *zip(*points, strict=True)):.1f}"


def policies(folder: Path, shipped: Path) -> str:
    """One line per policy and condition, beside the squeeze of the same contact force.

    The squeeze is that from the same start states, where there is one.
    """
    squeezes = squeezes_by_condition(folder)
    lines = []
    for run, setting, seed, condition, column in evaluated_policies(folder, shipped):
        force, _ = column.forces()
        mean, (low, high) = column.mean()
        paired = [s for s in squeezes.get(condition, ()) if s.draws == column.draws]
        lines.append(
            (
                run,
                setting,
                str(seed),
                condition.short(),
                str(sum(r.episodes for r in column.rows.values())),
                f"{mean:.1f} ({low:.0f}–{high:.0f})",
                "" if force is None else f"{force:.1f}",
                "" if force is None else squeeze_at(force, paired),
            )
        )
    header = (
        *("run", "worlds × unroll", "seed", "condition", "episodes"),
        *("success %", "force N", "squeeze at this force %"),
    )
    return markdown(Table("Policies", header, tuple(lines), names=4)) if lines else NOTHING


_COMMON = ("preset", "objects-dir", "evaluation-episodes", "loop.checkpoint-every-s")
_COMMON += ("handoffs", "seed", "out")
"""flags of a training that do not tell one from another here"""


def choice(folder: Path, runs: Path) -> str:
    """Policies from states of the training set, among which one to ship is chosen.

    Args:
        folder: Comparisons from the same states, by the run's name.
        runs: The table of runs.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        return NOTHING
    trained = {row["run"]: row for row in run_rows(runs)}
    lines, conditions = [], sorted({c for p in paths for c in read_groups([p])}, key=_ease)
    for path in sorted(paths, key=lambda p: list(trained).index(p.stem)):
        row, groups = trained[path.stem], read_groups([path])
        for columns in zip(*(groups[c] for c in conditions), strict=True):
            (budget,) = {r.force_budget_n for c in columns for r in c.rows.values()}
            if budget is None:
                raise FileError(path, "a policy without a force budget", "one that is given some")
            cells = (f"{c.success():.1f} at {c.forces()[0]:.2f}" for c in columns)
            lines.append((path.stem, _flags(row), str(row["seed"]), f"{budget:g}", *cells))
    header = (
        "run",
        "its own flags",
        "seed",
        "budget N",
        *(c.short() for c in conditions),
    )
    return markdown(Table("Choice", header, tuple(lines), names=2))


def points(folders: Sequence[Path]) -> str:
    """How policies rank by the rule by which one is chosen to be shipped.

    Args:
        folders: Comparisons from the same states, a file per policy in each.
    """
    if not all(any(folder.glob("*.json")) for folder in folders):
        return NOTHING
    return markdown(points_table(folders, ranked(folders)))


def told(folder: Path) -> str:
    """A policy that reads what only a simulator knows beside one trained alike that does not.

    Args:
        folder: The results files; that of the one is in its `told`, that of the other, `longer`, in
            its `seeds`, from the same start states.
    """
    path = folder / "told" / "native.json"
    if not path.exists():
        return NOTHING
    knowing, sensing = read_groups([path]), read_groups([folder / "seeds" / "longer.json"])
    lines = []
    for condition in sorted(knowing, key=_ease):
        beside = {_budget(column): column for column in sensing[condition]}
        for column in sorted(knowing[condition], key=_budget):
            for name, of in (("told", column), ("longer", beside[_budget(column)])):
                trials = sum(row.episodes for row in of.rows.values())
                lines.append(
                    (
                        condition.short(),
                        f"{_budget(column):g}",
                        name,
                        f"{trials:,}",
                        f"{of.success():.1f} at {of.forces()[0]:.2f}",
                        *(f"{_within(of, force):.1f}" for force in (3.0, 4.0)),
                    )
                )
    header = ("condition", "budget N", "policy", "trials", "success % at N")
    header += ("within 3 N %", "within 4 N %")
    return markdown(Table("Told the truth", header, tuple(lines), names=3))


def keeping(folder: Path) -> str:
    """What it brings that the shipped policy is held to its budget, from the same trials.

    Args:
        folder: The results files; where it is told the budget alone they are in its `not_kept`.
    """
    paths = folder / "not_kept" / "eight.json", folder / "eight_native.json"
    return _within_own_budget(paths, ("told alone", "held to it"))


def kept_in_training(folder: Path) -> str:
    """The shipped policy beside one that went on training while it was held to its budget.

    Args:
        folder: The results files; theirs are in its `kept_training`.
    """
    paths = (folder / "kept_training" / f"{name}.json" for name in ("shipped", "further"))
    return _within_own_budget(tuple(paths), ("shipped", "trained further"))


def _within_own_budget(paths: tuple[Path, Path], names: tuple[str, str]) -> str:
    """Two policies, each of one file, by condition and budget; trials are the same."""
    if not all(path.exists() for path in paths):
        return NOTHING
    first, second = (_by_budget(path) for path in paths)
    lines = []
    for at in (at for at in first if at in second):
        condition, budget = at
        pair = first[at], second[at]
        trials = same_starts([list(column.rows.values()) for column in pair])
        (gain,) = gains_within(trials, resampled(trials), [1], [0], np.array([budget]))
        cells = []
        for column in pair:
            cells += [
                f"{column.success():.1f} at {column.forces()[0]:.2f}",
                f"{_within(column, budget):.1f}",
            ]
        count = f"{trials.success.shape[1]:,}"
        lines.append((condition.short(), f"{budget:g}", count, *cells, gain.text()))
    header = ("condition", "budget N", "trials")
    for name in names:
        header += (f"{name}: success % at N", "within its budget %")
    header += ("gain within it, points",)
    return markdown(Table("Held to a budget", header, tuple(lines), names=2))


def _by_budget(path: Path) -> dict[tuple[Condition, float], Column]:
    """The policies of a file by condition and budget, the easiest condition first."""
    groups = read_groups([path])
    return {
        (condition, _budget(column)): column
        for condition in sorted(groups, key=_ease)
        for column in sorted(groups[condition], key=_budget)
        if column.family in POLICIES
    }


def _budget(column: Column) -> float:
    """That the column's policy was given; 0 of a controller that knows none [N]."""
    (budget,) = {row.force_budget_n for row in column.rows.values()}
    return budget or 0.0


def _within(column: Column, force: float) -> float:
    """Share of trials that are lifted with at most a mean force per finger, over objects [%]."""
    trials = same_starts([list(column.rows.values())])
    weights = resampled(trials, resamples=0)
    return float(success_within(trials, weights, [0], np.array([force]))[0, 0])


def newcomers(folder: Path) -> str:
    """Short trainings on one object, and the policy that they began with, from the same trials.

    Args:
        folder: The results files; theirs are in its `newcomer`, a policy under one budget each.
    """
    paths = sorted((folder / "newcomer").glob("*.json"))
    if not paths:
        return NOTHING
    trained = {row["run"]: row for row in run_rows(folder / "training_runs.json")}
    found = {}
    for path in paths:
        ((column,),) = read_groups([path]).values()
        (budget,) = {row.force_budget_n for row in column.rows.values()}
        found[named_run(path) or "", budget] = column
    budgets = sorted({budget for _, budget in found})
    lines = []
    for run in sorted({run for run, _ in found}):
        row, cells = trained.get(run), []
        for column in (found[run, budget] for budget in budgets):
            peaks = [f"{row.force_peak_p99_n:.0f}" for row in column.rows.values()]
            cells += [f"{column.success():.1f} at {column.forces()[0]:.2f}", ", ".join(peaks)]
        flags, seed = (_flags(row), str(row["seed"])) if row else ("as it begins", "")
        lines.append((run or "none", flags, seed, *cells))
    header = ("run", "its own flags", "seed")
    for budget in budgets:
        header += (f"budget {budget:g} N: success % at N", "peak N, 99th percentile")
    return markdown(Table("Newcomer's trainings", header, tuple(lines), names=2))


def _ease(condition: Condition) -> tuple[float, float]:
    return -condition.friction, condition.offset_mm


def _flags(row: dict[str, Any]) -> str:
    """The flags of a training's command that are its own."""
    words = shlex.split(row["provenance"]["command"])
    parts = " ".join(words[words.index("mjx_grasp.train") + 1 :]).split("--")[1:]
    own = (part.strip() for part in parts if part.split()[0] not in _COMMON)
    return ", ".join(f"`{part}`" for part in own)


_OF_THEIR_OWN = ("seeds", "choice", "told", "newcomer", "end_to_end", "trained")
"""folders of results whose policies are named where they are shown"""


def earlier(folder: Path, shipped: Path) -> str:
    """Which results are of a policy that was shipped before, by the hash of its file.

    Args:
        folder: The results files; policies shipped before are in its `seeds`, by the run's name.
        shipped: The policy that is shipped now.
    """
    if not shipped.exists():
        return NOTHING
    names = {d: p.stem for p in sorted((folder / "seeds").glob("*.json")) if (d := _policy_of(p))}
    names[file_digests(policy=shipped)["policy"]] = ""
    old: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("*.json")):
        within = path.relative_to(folder)
        if within.parts[0] in _OF_THEIR_OWN or (digest := _policy_of(path)) is None:
            continue
        if name := names.get(digest, "an earlier one"):
            old.setdefault(name, []).append(f"[{within}](results/{within})")
    if not old:
        return "All results of a policy that is not named are of the shipped one."
    said = "; ".join(
        f"{', '.join(files)} of {name if ' ' in name else f'`{name}`'}"
        for name, files in old.items()
    )
    return f"Still of policies that were shipped before: {said}."


def _policy_of(path: Path) -> str | None:
    """The hash of the policy that a results file names as the one it evaluated."""
    return read_json(path, "a results file").get("sha256", {}).get("policy")


_ABLATION = (
    "Trainings of the preset `gpu` with {steps:.1f} M steps, half of its own, {seeds} seeds of "
    "each, that differ from it as the first column says. Each policy lifts in native MuJoCo in "
    "steps of 2 ms from {trials} starts of the training set per condition and budget: success % of "
    "all seeds (of each) at the mean force in N; then how many points that is above the preset at "
    "the same force, which is read off straight lines between its own budgets, where it lies "
    "between them. Success rises ever more slowly with force, so that these lines lie below what "
    "the preset reaches there: a gain is at most as large, a loss at least. *Hard* is ±10 mm with "
    "friction 0.5; *other robot* has position gains off by up to three tenths and commands up "
    "to 20 ms late. The starts are shared; seeds of one setting differ by {apart:.1f} points in "
    "the mean of all columns."
)


def ablation(path: Path) -> str:
    """What each part of the training adds, one line per setting."""
    if not path.exists():
        return NOTHING
    rows = read_json(path, "an ablation table")["rows"]
    asked = [(e["condition"], e["budget_n"]) for e in rows[0]["evaluations"]]
    settings: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        settings.setdefault(row["run"].rsplit("-seed", 1)[0], []).append(row)
    if "preset" not in settings:
        raise FileError(path, f"runs of {', '.join(settings)}", "some of `preset` among them")
    counts, lengths = {len(of) for of in settings.values()}, {row["env_steps"] for row in rows}
    if len(counts) > 1 or len(lengths) > 1:
        found = f"{sorted(counts)} seeds of {sorted(lengths)} steps"
        raise FileError(path, found, "as many seeds of each, all of the same length")
    found = {name: _by_question(of) for name, of in settings.items()}
    fronts = {
        condition: sorted(
            (e[0], e[1].mean()) for key, e in found["preset"].items() if key[0] == condition
        )
        for condition, _ in asked
    }
    lines = []
    for name in sorted(settings, key=lambda name: name != "preset"):
        of = settings[name]
        words = ", ".join(f"`{k}` {in_words(value)}" for k, value in _differs(of[0]).items())
        cells = [_cell(*found[name][key], fronts[key[0]], name == "preset") for key in asked]
        lines.append((f"`{name}`" + (f": {words}" if words else ""), *cells))
    spread = [np.ptp(e[1]) for of in found.values() for e in of.values()]
    said = _ABLATION.format(
        steps=1e-6 * lengths.pop(),
        seeds=counts.pop(),
        trials=rows[0]["evaluations"][0]["trials"],
        apart=np.mean(spread),
    )
    header = ("setting", *(f"{name}, {budget:g} N" for name, budget in asked))
    return f"{said}\n\n{markdown(Table('Ablation', header, tuple(lines), names=1))}"


def _by_question(
    rows: Sequence[dict[str, Any]],
) -> dict[tuple[str, float], tuple[float, Float[np.ndarray, " s"]]]:
    """Under each condition and budget the mean force of a setting's seeds, and their successes."""
    found: dict[tuple[str, float], list[tuple[float, float]]] = {}
    for row in rows:
        for e in row["evaluations"]:
            key = (e["condition"], e["budget_n"])
            found.setdefault(key, []).append((e["force_mean_n"], e["success_percent"]))
    table = {key: np.array(of) for key, of in found.items()}
    return {key: (float(of[:, 0].mean()), of[:, 1]) for key, of in table.items()}


def _cell(
    force: float,
    successes: Float[np.ndarray, " s"],
    front: Sequence[tuple[float, float]],
    is_front: bool,
) -> str:
    """Success at a force, and what it is above a front where that reaches so far."""
    each = ", ".join(f"{share:.0f}" for share in sorted(successes, reverse=True))
    said = f"{successes.mean():.1f} ({each}) at {force:.1f}"
    if is_front or not front[0][0] <= force <= front[-1][0]:
        return said
    above = successes.mean() - np.interp(force, *zip(*front, strict=True))
    return f"{said}: {above:+.1f}"


def _differs(row: dict[str, Any]) -> dict[str, Any]:
    """The settings that a run changed, but for what all share: its length, how often it is kept."""
    shared = ("ppo.iterations", "loop.checkpoint_every_s")
    return {k: v for k, v in row["changes"].items() if k not in shared}


def in_words(value: Any) -> str:
    """A setting's value, as tables show it."""
    if isinstance(value, list):
        parts = [*dict.fromkeys(f"{part:g}" for part in value)]
        return (" to " if len(parts) == 2 else ", ").join(parts)
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _setting(run: dict[str, Any]) -> str:
    published = ", preset paper" if run["preset"] == "paper" else ""
    return f"{run['worlds']:,} × {run['unroll']}, {run['env_steps'] / 1e6:.0f} M steps{published}"


def named_run(path: Path) -> str | None:
    """The name of the run whose policy the command of a results file names."""
    words = shlex.split(str(read_results(path).provenance["command"]))
    return Path(words[words.index("--policy") + 1]).parent.name if "--policy" in words else None


def _run_of(path: Path, shipped: Path) -> str:
    """The same; where no policy is named that of the file, or of the policy that is shipped now."""
    if (run := named_run(path)) is not None:
        return run
    if path.parent.name == "seeds":  # shipped before
        return path.stem
    made = shlex.split(str(load_policy(shipped).meta["provenance"]["command"]))
    if "--out" not in made:
        raise FileError(shipped, "a command without --out", "the run that made the policy")
    return Path(made[made.index("--out") + 1]).name
