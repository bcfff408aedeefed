"""Tables of closing, for the READMEs: success and force, speed, training runs, start states.

`make_readme.py` puts them in place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from collect_runs import run_rows
from markdown_tables import NOTHING, markdown, read, short_revision

from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.conditions import Column, Condition, Groups, read_groups
from mjx_grasp.evaluation.front_tables import (
    budget_table,
    equal_force_table,
    object_budget_table,
)
from mjx_grasp.evaluation.handoff_tables import tip_error_table
from mjx_grasp.evaluation.judging import gain, mean_force, mean_success, resampled, same_starts
from mjx_grasp.evaluation.results import Results, ThroughputRow, read_results
from mjx_grasp.evaluation.tables import condition_table, failure_table, force_table
from mjx_grasp.handoff.report import ObjectReport
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.model import GRAVITY
from mjx_grasp.records.table import Table

CITATION = (
    "*Steerable and Reactive Grasping Through Modular Design with a Three-Point Interface*: "
    f"8 selected objects, {paper.EPISODES} episodes per object and condition"
)
EXPLANATION = (
    "Success in %, with 95 % intervals in brackets. Those of means draw the start states anew, "
    "which are kept out of training and used again with other offsets where there are fewer states "
    "than trials; those of single objects treat trials as independent. Force is the net contact "
    "force per finger from the onset of the lift. The last columns are quoted from "
    f"{CITATION}."
)
EQUAL_FORCE = (
    "Differences in percentage points, with 95 % bootstrap intervals over start states. A "
    "baseline's results at several commanded forces, or frictions μ₀, are joined by straight "
    "lines, without those that a lighter one beats, and read at the controller's own mean force. "
    "Below its lightest setting the line goes down to no success at no force, and beyond its "
    "hardest it stays level: differences there are extrapolated, not measured. *Most possible* is "
    "the share of trials in which the baseline fails at this force: nobody can gain more on it. "
    "The peak is the largest force on a finger."
)
WITHIN_BUDGET = (
    "The share of all trials that are lifted and whose mean force per finger stays within the "
    "budget, and differences of it in percentage points with the same intervals. Each controller "
    "at the best of its settings for each budget; *best of each trial* is the share of trials for "
    "which at least one of all these controllers and settings did it, which bounds what any choice "
    "among them can reach."
)
BY_OBJECT = (
    "The same two shares for each object, the policy at the best of its settings for it: what is "
    "missing within a budget is mostly of the objects whose weight alone asks for as much, or "
    "nearly (next table)."
)
ON_WALLS = (
    "What the weight alone asks of three contacts on upright walls that share it: a contact that "
    "carries as much friction as it can, μ times its normal force, has a net force of "
    "m·g·√(1 + μ²) / 3μ. To lift faster, or with contacts that are not ideal, takes more; contacts "
    "under a slope take less."
)
_BUDGETS_N = (3.0, 4.0)
_MARGINS = (0.0, 0.1, 0.2)
LAYERS = (
    "Where a control tick goes, in ms. Each loop contains the one before it: MuJoCo Warp alone (as "
    "a CUDA graph), the same called from JAX, the task around it, the policy's actions, PPO's "
    "updates. All but PPO go through the states of one rollout of a training. Then parts of one "
    "physics step, and the speed of the whole loop as a share of MuJoCo Warp's:"
)
_WALL_FRICTIONS = (1.1, 0.8, 0.5, 0.4)
_ENGINES = {"mujoco": "native MuJoCo", "mjx": "MJX"}
_STEP_PARTS = {
    "step": "step",
    "collision": "step/forward/fwd_position/collision",
    "solver": "step/forward/solve",
}


def counted(number: int, noun: str) -> str:
    """A number of things."""
    return f"{number} {noun}{'s' * (number != 1)}"


def means(paths: Sequence[Path]) -> str:
    """Success and force of every controller under the first condition, means over the objects."""
    groups = read_groups(paths)
    if not groups:
        return NOTHING
    condition, columns = next(iter(groups.items()))
    rows = []
    for column in columns:
        force, _ = column.forces()
        mean, (low, high) = column.mean()
        cells = f"{mean:.1f}", f"{low:.1f}–{high:.1f}", "" if force is None else f"{force:.1f}"
        rows.append((column.label, *cells))
    quoted = ""
    if condition.objects == paper.OBJECTS.keys():
        rows += [
            ("publication: policy", f"{paper.MEAN.ours:.1f}", "", ""),
            ("publication: squeeze 3 N", f"{paper.MEAN.squeeze:.1f}", "", ""),
        ]
        quoted = f" The last rows are quoted from {CITATION}."
    header = ("controller", "lifted and held %", "95 % interval", "contact force N")
    table = Table("Means", header, tuple(rows))
    episodes = " or ".join(map(str, sorted({r.episodes for c in columns for r in c.rows.values()})))
    objects = counted(len(condition.objects), "object")
    return (
        f"{objects} ({condition.meshes}), {episodes} trials each in "
        f"{condition.short()}:\n\n{markdown(table)}\n\n"
        "Means over the objects; their intervals draw the start states anew. ± is how far the "
        "object may be from where the controller believes it to be; the force is that of one "
        f"finger on the object, averaged over the lift.{quoted}"
    )


def all_conditions(paths: Sequence[Path], more: Sequence[Path] = ()) -> str:
    """Every condition: means, pairs, and the tables per object, folded away.

    Args:
        paths: The results files.
        more: Others with more settings of the baselines, which the pairs are to hold out against.
    """
    groups = read_groups(paths)
    if not groups:
        return NOTHING
    wider = with_more(groups, read_groups(more))
    parts = [EXPLANATION]
    parts += ["### Means over the objects", *_means_by_engine(groups)]
    for make, text in (
        (equal_force_table, EQUAL_FORCE),
        (budget_table, WITHIN_BUDGET),
        (object_budget_table, BY_OBJECT),
    ):
        if (table := make(wider)).rows:
            parts += [f"### {table.title}", text, markdown(table)]
    table = least_forces(sorted({name for group in groups for name in group.objects}))
    parts += [f"### {table.title}", ON_WALLS, markdown(table)]
    parts += ["### Object by object", *(_folded(*group) for group in groups.items())]
    return "\n\n".join(parts)


def trials(folder: Path, names: Sequence[str]) -> str:
    """Of how many trials results are.

    Args:
        folder: Of results.
        names: Of the files.
    """
    lines = []
    for path in (folder / f"{name}.json" for name in names):
        counts = sorted(_trials_in(read(path) or {}))
        if counts:
            said = "–".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
            lines.append((path.relative_to(folder).as_posix(), said))
    header = ("results", "trials of an object and condition", "published")
    every = tuple((*line, str(paper.EPISODES)) for line in lines)
    return markdown(Table("Trials", header, every)) if lines else NOTHING


def _trials_in(record: Any) -> set[int]:
    """Of one object and condition each, wherever rows are in a record."""
    if isinstance(record, dict):
        if "object" in record and ("episodes" in record or "outcomes" in record):
            return {record["episodes"] if "episodes" in record else len(record["outcomes"])}
        summed = record.get("objects")
        if isinstance(summed, dict) and "rows" in record:  # whole grasps
            return {of["trials"] for of in summed.values()}
        return set().union(*map(_trials_in, record.values()))
    return set().union(*map(_trials_in, record)) if isinstance(record, list) else set()


def with_more(groups: Groups, more: Groups) -> Groups:
    """Controllers by condition, and behind them those of the same condition that are new."""

    def joined(condition: Condition, columns: Sequence[Column]) -> list[Column]:
        there = {column.label for column in columns}
        return [*columns, *(c for c in more.get(condition, ()) if c.label not in there)]

    return {condition: joined(condition, columns) for condition, columns in groups.items()}


def conditions(folder: Path) -> str:
    """Policy and grip against the baselines at equal force, one condition after the other.

    Args:
        folder: The results files.
    """
    groups = read_groups(sorted(folder.glob("*.json")))
    if not groups:
        return NOTHING
    table = equal_force_table(groups)
    engine = _common(next(iter(groups)))
    rows = tuple((row[0].removeprefix(engine), *row[1:]) for row in table.rows)
    objects = counted(len(next(iter(groups)).objects), "object")
    return f"{objects}, {engine.rstrip(', ')}:\n\n" + markdown(replace(table, rows=rows))


def grip_sweep(path: Path) -> str:
    """The answering grip over its least force and the friction that it counts on."""
    if not path.exists():
        return NOTHING
    lines: dict[tuple[float, float], list[str]] = {}
    header = ["least force N", "counts on friction"]
    for condition, columns in read_groups([path]).items():
        header.append(condition.short().removeprefix(_common(condition)))
        for column in columns:
            row = next(iter(column.rows.values()))
            at = row.grip_force_n, row.grip_friction
            mean, (low, high) = column.mean()
            force, _ = column.forces()
            said = f"{mean:.1f} ({low:.0f}–{high:.0f}) at {force:.1f}"
            lines.setdefault(at, [f"{at[0]:g}", f"{at[1]:g}"]).append(said)
    rows = tuple(tuple(line) for _, line in sorted(lines.items()))
    return markdown(Table("Grip", tuple(header), rows, names=0))


def engines_agree(paths: Sequence[Path]) -> str:
    """The same trials of controllers in both engines, side by side.

    Args:
        paths: Results of both.
    """
    groups = read_groups(path for path in paths if path.exists())
    rows, apart, same = [], [], []
    for condition, columns in groups.items():
        others = {c.label: c for c in groups.get(condition._replace(engine="mjx"), ())}
        for column in columns if condition.engine == "mujoco" else ():
            if column.label not in others:
                continue
            pair = column, others[column.label]
            trials = same_starts([list(each.rows.values()) for each in pair])
            weights = resampled(trials)
            native, other = mean_success(trials, weights)[0]
            forces = mean_force(trials, weights)[0]
            apart.append(other - native)
            same.append(100.0 * (trials.success[0] == trials.success[1]).mean())
            short = condition.short().removeprefix(_common(condition))
            cells = f"{native:.1f}", f"{other:.1f}", gain(trials, weights, 1, 0).text()
            cells += f"{same[-1]:.1f}", f"{forces[0]:.2f}", f"{forces[1]:.2f}"
            rows.append((short, column.label, *cells))
    if not rows:
        return NOTHING
    header = ("condition", "controller", "native %", "MJX %", "MJX − native, points")
    header += ("same outcome %", "native N", "MJX N")
    table = markdown(Table("Engines", header, tuple(rows), names=2))
    said = (
        f"Success differs by {min(apart):+.1f} to {max(apart):+.1f} points, {np.mean(apart):+.2f} "
        f"in the mean of {len(rows)} settings; {min(same):.1f} to {max(same):.1f} % of their "
        "trials have the same outcome."
    )
    title = "controller by controller, with 95 % intervals over start states"
    return f"{said}\n\n<details><summary>{title}</summary>\n\n{table}\n\n</details>"


def _common(condition: Condition) -> str:
    """What a condition's words begin with: engine and start states."""
    return condition.short().partition("±")[0]


def least_forces(names: Sequence[str]) -> Table:
    """What the objects' weights ask of contacts on upright walls, heaviest first."""
    rows = []
    catalogue = load_catalogue()
    known = [catalogue[name] for name in names if name in catalogue]
    for info in sorted(known, key=lambda info: -info.mass):
        shares = [GRAVITY * info.mass * math.hypot(1.0, mu) / (3.0 * mu) for mu in _WALL_FRICTIONS]
        label = info.name.replace("_", " ")
        rows.append((label, f"{1e3 * info.mass:.0f}", *(f"{share:.1f}" for share in shares)))
    header = ("object", "mass g", *(f"N at friction {mu:g}" for mu in _WALL_FRICTIONS))
    return Table("Least force per finger on upright walls", header, tuple(rows), names=1)


def least_by_contacts(path: Path) -> str:
    """What the contacts of the start states ask for, and a bound on success within a mean force.

    The last lines are the means for forces that are above the least by some shares.
    """
    record = read(path)
    if record is None:
        return NOTHING
    rows = record["rows"]
    frictions = list(dict.fromkeys(row["friction"] for row in rows))
    cells: dict[str, list[str]] = {}
    every: list[np.ndarray] = []
    for row in rows:
        forces = np.array([np.inf if x is None else x for x in row["forces_n"]])
        within = _shares_within(forces)
        every.append(forces)
        low, median, high = (
            f"{x:.1f}" for x in np.percentile(forces, (5, 50, 95), method="nearest")
        )
        label = row["object"].replace("_", " ")
        own = cells.setdefault(label, [f"{1e3 * row['mass_kg']:.0f}"])
        own += [f"{median} ({low}–{high})", *(f"{share:.0f}" for share in within)]
    lines = [(label, *own) for label, own in cells.items()]
    means = []
    for margin in _MARGINS:
        shares = [_shares_within((1.0 + margin) * forces) for forces in every]
        parts = np.reshape(shares, (len(frictions), len(cells), len(_BUDGETS_N))).mean(axis=1)
        label = f"mean, {100 * margin:.0f} % above" if margin else "mean"
        last = [x for part in parts for x in ("", *(f"{share:.1f}" for share in part))]
        means.append((label, "", *last))
    header = ["object", "mass g"]
    for mu in frictions:
        header += [f"friction {mu:g}: N", *(f"within {b:g} N %" for b in _BUDGETS_N)]
    rows = (*lines, *means)
    return markdown(Table("Contacts", tuple(header), rows, names=1, summary=len(means)))


def _shares_within(forces: np.ndarray) -> list[float]:
    """How many of them are within each budget [%]."""
    return [100.0 * float(np.mean(forces <= budget)) for budget in _BUDGETS_N]


def by_condition(paths: Sequence[Path]) -> str:
    """Means of controllers, a column per condition."""
    if not all(path.exists() for path in paths):
        return NOTHING
    return "\n\n".join(_means_by_engine(read_groups(paths)))


def _means_by_engine(groups: Groups) -> list[str]:
    """A table per engine and set of objects: controllers against conditions."""
    blocks: dict[str, dict[str, dict[str, str]]] = {}
    for condition, columns in groups.items():
        engine, _, errors = condition.short().partition(", ")
        objects = counted(len(condition.objects), "object")
        title = f"{engine}, {objects} ({condition.meshes})"
        for column in columns:
            (mean, (low, high)), (force, _) = column.mean(), column.forces()
            cell = f"{mean:.1f} ({low:.0f}–{high:.0f})"
            cell += "" if force is None else f", {force:.1f} N"
            blocks.setdefault(title, {}).setdefault(column.label, {})[errors] = cell
    parts = []
    for title, lines in blocks.items():
        conditions = tuple(dict.fromkeys(errors for line in lines.values() for errors in line))
        rows = tuple((name, *(line.get(c, "") for c in conditions)) for name, line in lines.items())
        parts += [f"{title}:", markdown(Table(title, ("controller", *conditions), rows))]
    return parts


def _folded(condition: Condition, columns: Sequence[Column]) -> str:
    success = condition_table(condition, columns)
    parts = [f"<details><summary>{success.title}</summary>", markdown(success)]
    for table in (force_table(condition, columns), failure_table(condition, columns)):
        parts += [f"{table.title.partition(':')[0]}:", markdown(table)]
    return "\n\n".join([*parts, "</details>"])


def throughput(paths: Sequence[Path]) -> str:
    """Speed and memory, and where the time of a control tick goes."""
    if not paths:
        return NOTHING
    files = [read_results(p, ThroughputRow) for p in paths]
    layers = _layers(files)
    parts = [LAYERS, markdown(layers)] if layers.rows else []
    return "\n\n".join([markdown(throughput_table(files)), *parts])


def throughput_table(files: Sequence[Results[ThroughputRow]]) -> Table:
    """Speed and memory against worlds, device by device."""
    rows = []
    for file in files:
        unroll = {d["worlds"]: d["unroll"] for d in file.extra.get("details", ())}
        for row in sorted(file.rows, key=lambda r: (r.loop, r.engine, r.worlds)):
            whole = row.loop.startswith("ppo")
            ticks = f" × {unroll[row.worlds]}" if whole and unroll else ""
            rows.append(
                (
                    str(file.provenance["device"]),
                    str(file.provenance["git"])[:7],
                    _loop_name(row),
                    f"{row.objects}",
                    f"{row.worlds:,}{ticks}",
                    f"{row.control_steps_per_s:,.0f}",
                    "" if row.memory_gib is None else f"{row.memory_gib:.1f}",
                )
            )
    memory = "JAX's memory GiB"
    header = ("device", "code", "loop", "objects", "worlds (× unroll)", "control steps/s", memory)
    return Table("Speed and memory", header, tuple(rows), names=3)


def _loop_name(row: ThroughputRow) -> str:
    """A loop and the engine that it is around."""
    if row.loop == "mujoco_warp":
        return "MuJoCo Warp alone"
    loop = "ppo over a mesh of one device" if row.loop == "ppo_sharded" else row.loop
    return f"{loop}, {_ENGINES[row.engine]}"


def _layers(files: Sequence[Results[ThroughputRow]]) -> Table:
    """Milliseconds per control tick of each loop, and of a physics step's parts."""
    rows = []
    for file in files:
        for d in file.extra.get("details", ()):
            if "ratio_ppo_to_warp" not in d:
                continue
            tick, step = d["ms_per_control_tick"], d["warp_step_trace_ms"]
            loops = (tick[name] for name in ("warp", "mjx", "task", "rollout", "ppo"))
            parts = (step.get(name, math.nan) for name in _STEP_PARTS.values())
            times = (f"{ms:.2f}" for ms in (*loops, *parts))
            which = str(file.provenance["device"]), str(file.provenance["git"])[:7]
            rows.append((*which, f"{d['worlds']:,}", *times, f"{d['ratio_ppo_to_warp']:.2f}"))
    header = ("device", "code", "worlds", "MuJoCo Warp", "in JAX", "task", "with policy", "PPO")
    return Table("Layers", (*header, *_STEP_PARTS, "PPO / Warp"), tuple(rows), names=3)


def _beginning(run: dict[str, Any]) -> str:
    """Which policy a training went on from; older tables have only such as began with none."""
    return f", from {run['start_from']}" if run.get("start_from") else ""


def runs(paths: Sequence[Path]) -> str:
    """One line per training run of the closing task."""
    rows = [r for path in paths for r in run_rows(path) if r["task"] == "closing"]
    if not rows:
        return NOTHING
    lines = tuple(
        (
            r["run"],
            str(r["provenance"]["device"]),
            f"{r['worlds']:,} × {r['unroll']}",
            r["residual"],
            "privileged" if r["privileged_critic"] else "66 observations",
            " ".join(r["objects"]) + _beginning(r),
            str(r["seed"]),
            f"{r['env_steps'] / 1e6:.1f}",
            f"{r['seconds_with_compilation']:.0f}",
            f"{r['steps_per_s']:,.0f}",
            f"{r['training_success_percent']:.1f}",
            f"{r['training_force_n']:.1f}",
            short_revision(r["provenance"]),
        )
        for r in rows
    )
    header = (
        *("run", "device", "worlds × unroll", "residual", "critic sees", "objects", "seed"),
        *("M steps", "s", "steps/s", "success %", "force N", "git"),
    )
    return markdown(Table("Training runs", header, lines, names=6))


def shipped_policy(path: Path) -> str:
    """The command behind the policy in assets."""
    if not path.exists():
        return NOTHING
    meta = load_policy(path).meta
    made = meta["provenance"]
    return (
        f"`assets/policy.npz` has seen {meta['env_steps'] / 1e6:.1f} M steps on "
        f"{len(meta['objects'])} objects; made on {made['device']} at {short_revision(made)} by\n\n"
        f"```sh\n{made['command']}\n```"
    )


def shipped_handoffs(folder: Path) -> str:
    """What the shipped sets of start states hold, and every command that made them."""
    parts = []
    for name in ("reached", "standins", "cube"):
        d = read(folder / f"handoffs_{name}.json")
        if d is None:
            continue
        have = [row for row in d["objects"] if row["eligible"]]
        without = ", ".join(name.replace("_", " ") for name in d["not_eligible"])
        steps = [*d.get("earlier", ()), d["provenance"]]
        parts += [
            f"`assets/handoffs_{name}.npz`: {sum(row['kept'] for row in have):,} states of "
            f"{counted(len(have), 'object')}"
            + (f"; no pre-grasp was found for {without}" if without else "")
            + f". Made in {counted(len(steps), 'step')}:",
            "\n".join(
                f"{k}. `{made['command']}` at {short_revision(made)} on {made['device']}, "
                f"JAX {made['versions']['jax']}"
                for k, made in enumerate(steps, start=1)
            ),
        ]
    by_its = "; by the publication's gate"
    gates = {"reached": "", "paper_gate": by_its, "paper_near": f"{by_its}, set to its midpoint"}
    for name, gate in gates.items():
        if (d := read(folder / f"handoffs_{name}.json")) is not None:
            told = ("name", "kind", "tip_error_mm")
            reports = [
                ObjectReport(**{field: row[field] for field in told})
                for row in d["objects"]
                if row["name"] in paper.OBJECTS
            ]
            table = tip_error_table(reports)
            parts += [f"{table.title}{gate}:", markdown(table)]
    return "\n\n".join(parts) if parts else NOTHING
