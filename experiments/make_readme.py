"""Puts the numbers of experiments/results/*.json into README.md and experiments/README.md.

`python experiments/make_readme.py` rewrites the generated sections; with `--check` it changes
nothing and fails if a section is stale.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import policy_tables
import reach_tables
import simulation_tables
import stage_tables
import tyro
from stage_tables import NOTHING, short_revision

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation import paper
from mjx_grasp.evaluation.results import (
    SCHEMAS,
    ResultRow,
    ThroughputRow,
    read_results,
    schema_of,
)
from mjx_grasp.evaluation.tables import (
    condition_table,
    failure_table,
    force_table,
    paired_table,
    read_groups,
    summary_table,
    throughput_table,
)
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.table import Table

ROOT = Path(__file__).resolve().parent.parent
RUNS_SCHEMA = "mjx_grasp.training_runs/1"
EXPLANATION = (
    "Success in %, with 95 % intervals of the trials in brackets, which take these as independent; "
    "they begin from start states kept out of training, each used again with another offset where "
    "there are fewer than trials. Force is the net contact force per finger from lift onset. The "
    f"last columns are quoted from {paper.CITATION}."
)
PAIRS = (
    "Differences in points of success, with 95 % bootstrap intervals over trials; how many trials "
    "only one of the two lifted, and the chance of so uneven a split if both were equal. Trials "
    "that begin from the same state often end alike: intervals and chances that take them as "
    "independent are too narrow."
)
LAYERS = (
    "Where a control tick goes, in ms, each loop holding the one before it: MuJoCo Warp alone "
    "(CUDA graph), the same called from JAX, the task around it, the policy's own actions and "
    "resets, PPO's updates; then parts of one physics step, of which a tick has five; then the "
    "speed of the whole loop as a share of MuJoCo Warp's:"
)
_STEP_PARTS = {
    "step": "step",
    "collision": "step/forward/fwd_position/collision",
    "solver": "step/forward/solve",
}


@dataclass(frozen=True)
class ReadmeConfig:
    """Writes the generated sections of the READMEs."""

    check: bool = False
    """Change nothing; fail if a generated section does not match the results."""
    root: Path = ROOT
    """The repository."""


def sections(root: Path) -> dict[Path, dict[str, str]]:
    """The text of every generated section, by file and name.

    Raises:
        FileError: A results file is damaged.
    """
    folder = root / "experiments" / "results"
    files = sorted(folder.glob("*.json"))
    schemas = {path: schema_of(path) for path in files}
    results = [p for p in files if schemas[p] == SCHEMAS[ResultRow]]
    throughput = [p for p in files if schemas[p] == SCHEMAS[ThroughputRow]]
    return {
        root / "README.md": {
            "results": _main_results(results),
            "throughput": _throughput(throughput),
            "reach": reach_tables.reach_rates(folder / "reach_sweep_h200.json"),
            "heatmap": stage_tables.heatmap_speed(sorted(folder.glob("heatmap_*.json"))),
        },
        root / "experiments" / "README.md": {
            "tables": _all_tables(results),
            "policy": _shipped_policy(root),
            "runs": _runs([p for p in files if schemas[p] == RUNS_SCHEMA]),
            "policies": policy_tables.policies(folder, root / "assets" / "policy.npz"),
            "oracle": stage_tables.heatmap_oracle(folder / "heatmap_oracle.json"),
            "ranking": stage_tables.heatmap_ranking(folder / "heatmap_ranking.json"),
            "steering": stage_tables.steering(folder / "steering.json"),
            "ablation": reach_tables.reach_ablation(folder / "reach_ablation.json"),
            "limits": reach_tables.reach_limits(
                [folder / f"reach_sweep_{device}.json" for device in ("h200", "cpu")]
            ),
            "qp": reach_tables.qp_speed(folder / "qp_cpu.json"),
            "reach-speed": reach_tables.reach_speed(
                [folder / f"reach_{device}.json" for device in ("cpu", "h200")]
            ),
            "first-run": stage_tables.first_run(folder / "make_train_cpu.json"),
            "tests": stage_tables.tests(folder / "tests_cpu.json"),
            "distances": reach_tables.signed_distances(folder / "signed_distance_scans.json"),
            "convex": simulation_tables.convex_pieces(folder / "convex_pieces.json"),
            "engines": simulation_tables.engines(folder / "engines_cpu.json"),
            "files": _provenance(sorted(folder.rglob("*.json")), folder).markdown(),
        },
    }


def filled(text: str, contents: dict[str, str], path: Path) -> str:
    """A README with its generated sections replaced.

    Raises:
        FileError: The file lacks a pair of markers.
    """
    for name, content in contents.items():
        begin, end = f"<!-- generated:{name} -->", f"<!-- /generated:{name} -->"
        pattern = re.compile(f"({re.escape(begin)}\n).*?({re.escape(end)})", re.DOTALL)
        block = f"{begin}\n{content}\n{end}"
        text, count = pattern.subn(lambda _, block=block: block, text)
        if count != 1:
            raise FileError(path, f"{count} sections {name!r}", f"one pair {begin} … {end}")
    return text


def main(config: ReadmeConfig) -> None:
    """The command."""
    stale = []
    for path, contents in sections(config.root).items():
        old = path.read_text(encoding="utf-8")
        new = filled(old, contents, path)
        if new != old and config.check:
            stale.append(path.relative_to(config.root).as_posix())
        elif new != old:
            with replacing(path) as temporary:
                temporary.write_text(new, encoding="utf-8")
    if stale:
        raise InputError("README sections", stale, "those of the results: run `make readme`")


def _main_results(paths: Sequence[Path]) -> str:
    groups = read_groups(paths)
    if not groups:
        return NOTHING
    condition, columns = next(iter(groups.items()))
    table = condition_table(condition, columns)
    return "\n\n".join([f"{table.title}:", table.markdown(), EXPLANATION])


def _all_tables(paths: Sequence[Path]) -> str:
    groups = read_groups(paths)
    if not groups:
        return NOTHING
    parts = [EXPLANATION]
    if len(groups) > 1:
        parts += ["### All conditions, means over the objects", summary_table(groups).markdown()]
    if (pairs := paired_table(groups)).rows:
        parts += [f"### {pairs.title}", pairs.markdown(), PAIRS]
    for condition, columns in groups.items():
        success = condition_table(condition, columns)
        parts += [f"### {success.title}", success.markdown()]
        for table in (force_table(condition, columns), failure_table(condition, columns)):
            parts += [f"{table.title.partition(':')[0]}:", table.markdown()]
    return "\n\n".join(parts)


def _throughput(paths: Sequence[Path]) -> str:
    if not paths:
        return NOTHING
    files = [read_results(p, ThroughputRow) for p in paths]
    parts = [throughput_table(files).markdown()]
    for file in files:
        apart = [d for d in file.extra.get("details", ()) if "ratio_ppo_to_warp" in d]
        if apart:
            parts += [LAYERS, _layers(apart).markdown()]
    return "\n\n".join(parts)


def _layers(details: Sequence[dict[str, Any]]) -> Table:
    """Milliseconds per control tick of each loop, and of a physics step's parts."""
    rows = []
    for d in details:
        tick, step = d["ms_per_control_tick"], d["warp_step_trace_ms"]
        loops = (tick[name] for name in ("warp", "mjx", "task", "rollout", "ppo"))
        parts = (step.get(name, math.nan) for name in _STEP_PARTS.values())
        times = (f"{ms:.2f}" for ms in (*loops, *parts))
        rows.append((f"{d['worlds']:,}", *times, f"{d['ratio_ppo_to_warp']:.2f}"))
    header = ("worlds", "MuJoCo Warp", "in JAX", "task", "with policy", "PPO", *_STEP_PARTS)
    return Table("Layers", (*header, "PPO / Warp"), tuple(rows))


def _runs(paths: Sequence[Path]) -> str:
    """One line per training run."""
    rows = [r for path in paths for r in json.loads(path.read_text())["rows"]]
    if not rows:
        return NOTHING
    lines = tuple(
        (
            r["run"],
            str(r["provenance"]["device"]),
            f"{r['worlds']:,} × {r['unroll']}",
            r["residual"],
            "privileged" if r["privileged_critic"] else "66 observations",
            " ".join(r["objects"]),
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
    return Table("Training runs", header, lines, names=6).markdown()


def _shipped_policy(root: Path) -> str:
    """The command behind the policy in assets."""
    path = root / "assets" / "policy.npz"
    if not path.exists():
        return NOTHING
    meta = load_policy(path).meta
    made = meta["provenance"]
    return (
        f"`assets/policy.npz` has seen {meta['env_steps'] / 1e6:.1f} M steps on "
        f"{len(meta['objects'])} objects; made on {made['device']} at {short_revision(made)} by\n\n"
        f"```sh\n{made['command']}\n```"
    )


def _provenance(paths: Sequence[Path], folder: Path) -> Table:
    rows = []
    for path in paths:
        name = path.relative_to(folder).as_posix()
        made = json.loads(path.read_text()).get("provenance", {})
        versions = made.get("versions", {})
        shown = ", ".join(f"{n} {versions[n]}" for n in ("jax", "mujoco") if n in versions)
        rows.append(
            (
                f"[{name}](results/{name})",
                f"`{made.get('command', '')}`",
                short_revision(made),
                str(made.get("device", "")),
                shown,
                str(made.get("seed", "")),
            )
        )
    header = ("file", "command", "git", "device", "versions", "seed")
    return Table("Results files", header, tuple(rows), names=5)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ReadmeConfig, description=__doc__, args=sys.argv[1:])))
