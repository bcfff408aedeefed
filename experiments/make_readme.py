"""Puts the numbers of experiments/results/*.json into README.md and experiments/README.md.

`python experiments/make_readme.py` rewrites the generated sections; with `--check` it changes
nothing and fails if a section is stale.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import closing_tables
import end_to_end_tables
import grasp_tables
import object_tables
import paper_ablation_tables
import paper_tables
import pipeline_tables
import policy_tables
import reach_constants_tables
import reach_tables
import sensing_tables
import sensitivity_tables
import simulation_tables
import speed_tables
import stage_tables
import steering_tables
import tyro
from markdown_tables import markdown, short_revision
from paper_parts import PARTS

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.results import SCHEMAS, ResultRow, ThroughputRow, schema_of
from mjx_grasp.records.atomic import replacing
from mjx_grasp.records.settings import CommandSettings
from mjx_grasp.records.table import Table

ROOT = Path(__file__).resolve().parent.parent
_COUNTED = (
    *("beside/planned", "beside/gate", "eight_native", "conditions/exact", "conditions/noisy"),
    *("pose_error", "objects/reached", "sensitivity", "grasps_all", "scenarios"),
)
"""results that stand beside published ones, and are of fewer trials"""
RUNS_SCHEMA = "mjx_grasp.training_runs/1"


@dataclass(frozen=True)
class ReadmeConfig(CommandSettings):
    """Writes the generated sections of the READMEs."""

    check: bool = False
    """change nothing; fail if a generated section does not match the results"""
    root: Path = ROOT
    """the repository"""


def sections(root: Path) -> dict[Path, dict[str, str]]:
    """The text of every generated section, by file and name.

    Raises:
        FileError: A results file is damaged.
    """
    folder = root / "experiments" / "results"
    files = sorted(folder.glob("*.json"))
    schemas = {path: schema_of(path) for path in files}
    results = [p for p in files if schemas[p] == SCHEMAS[ResultRow]]
    on_devices = sorted(folder.glob("devices_*.json"))
    scenarios = folder / "scenarios.json"
    throughput = [p for p in files if schemas[p] == SCHEMAS[ThroughputRow]]
    return {
        root / "README.md": {
            "grasps": grasp_tables.grasps_in_short(scenarios, folder / "grasps_all.json"),
            "results": closing_tables.means(results),
        },
        root / "docs" / "reproduction.md": {
            "claims": paper_tables.claims(folder),
            "eight": paper_tables.eight(folder),
            "all-objects": paper_tables.all_objects(folder),
            "times": speed_tables.paper_times(folder / "paper_times.json", PARTS),
            "trials": closing_tables.trials(folder, _COUNTED),
        },
        root / "experiments" / "README.md": {
            "tables": closing_tables.all_conditions(
                results, sorted((*folder.glob("squeezes/*.json"), *folder.glob("not_kept/*.json")))
            ),
            "least-force": closing_tables.least_by_contacts(folder / "least_force.json"),
            "conditions": closing_tables.conditions(folder / "conditions"),
            "engines-agree": closing_tables.engines_agree(
                [folder / "eight_native.json", folder / "engines" / "eight.json"]
            ),
            "policy": closing_tables.shipped_policy(root / "assets" / "policy.npz"),
            "earlier": policy_tables.earlier(folder, root / "assets" / "policy.npz"),
            "runs": closing_tables.runs([p for p in files if schemas[p] == RUNS_SCHEMA]),
            "handoffs": closing_tables.shipped_handoffs(folder),
            "failing": stage_tables.failing_starts(folder / "failing_starts.json"),
            "plan-weights": stage_tables.plan_weights(folder / "plan_weights.json"),
            "failing-before": stage_tables.failing_starts(
                folder / "starts" / "failing_before.json"
            ),
            "throughput": closing_tables.throughput(throughput),
            "devices": speed_tables.devices(on_devices),
            "seeds-together": speed_tables.together(sorted(folder.glob("seeds_*.json"))),
            "tuned": speed_tables.tuned(sorted(folder.glob("tune_*.json")), on_devices),
            "heatmap": speed_tables.heatmap_speed(sorted(folder.glob("heatmap_*.json"))),
            "reach": reach_tables.reach_rates(
                folder / "reach_sweep_cpu.json", folder / "reach_ablation.json"
            ),
            "objects": object_tables.objects(folder / "objects" / "reached.json"),
            "objects-trained": object_tables.trained(
                folder / "objects" / "evaluation_states.json",
                sorted((folder / "trained").glob("*.json")),
            ),
            "statics": object_tables.statics(folder / "objects" / "least_force.json"),
            "heavy": object_tables.heavy(folder / "heavy_objects.json"),
            "policies": policy_tables.policies(folder, root / "assets" / "policy.npz"),
            "choice": policy_tables.choice(folder / "choice", folder / "training_runs.json"),
            "choice-planned": policy_tables.choice(
                folder / "choice" / "planned", folder / "training_runs.json"
            ),
            "choice-points": policy_tables.points([folder / "choice" / "planned"]),
            "choice-points-robust": policy_tables.points(
                [folder / "choice" / name for name in ("planned", "robust")]
            ),
            "choice-points-all": policy_tables.points(
                [folder / "choice" / name for name in ("planned", "all")]
            ),
            "choice-all": policy_tables.choice(
                folder / "choice" / "all", folder / "training_runs.json"
            ),
            "keeping": policy_tables.keeping(folder),
            "kept-in-training": policy_tables.kept_in_training(folder),
            "told": policy_tables.told(folder),
            "newcomers": policy_tables.newcomers(folder),
            "policy-ablation": policy_tables.ablation(folder / "policy_ablation.json"),
            "paper-conditions": closing_tables.by_condition(
                [folder / "paper_preset" / f"{name}.json" for name in ("eight", "conditions")]
            ),
            "grip-sweep": closing_tables.grip_sweep(folder / "grip" / "sweep.json"),
            "paper-ablation": paper_ablation_tables.paper_ablation(folder / "paper_ablation.json"),
            "end-to-end-runs": end_to_end_tables.trainings(folder),
            "end-to-end": end_to_end_tables.success_from_home(folder),
            "pose-errors": paper_tables.pose_errors(folder / "pose_error.json"),
            "sensitivity": sensitivity_tables.sensitivity(folder / "sensitivity.json"),
            "drawn-stiffness": sensitivity_tables.drawn_stiffness(
                folder / "sensitivity_not_kept.json", folder / "sensitivity_fixed.json"
            ),
            "stability": paper_tables.stability(folder / "lift_stability.json"),
            "sensing": sensing_tables.sensed_forces(folder / "sensed_forces.json"),
            "oracle": stage_tables.heatmap_oracle(folder / "heatmap_oracle.json"),
            "ranking": stage_tables.heatmap_ranking(folder / "heatmap_ranking.json"),
            "eligibility": stage_tables.eligibility(folder / "eligibility.json"),
            "steering": steering_tables.steering(folder / "steering_numbers.json"),
            "steering-parts": steering_tables.parts(folder / "steering_numbers.json"),
            "steered-grasps": steering_tables.executed(folder / "steered_grasps.json"),
            "ablation": reach_tables.reach_ablation(folder / "reach_ablation.json"),
            "reach-constants": reach_constants_tables.constants(folder / "reach_constants.json"),
            "limits": reach_tables.reach_limits(folder / "reach_sweep_cpu.json"),
            "qp": reach_tables.qp_speed(folder / "qp_cpu.json"),
            "reach-speed": reach_tables.reach_speed(
                [folder / f"reach_{device}.json" for device in ("cpu", "h200")]
            ),
            "grasps": grasp_tables.whole_grasps(scenarios),
            "grasps-all": grasp_tables.grasps_by_split(folder / "grasps_all.json"),
            "scenarios": grasp_tables.scenarios(scenarios),
            "scenarios-engines": grasp_tables.scenarios_by_engine(
                scenarios, folder / "engines" / "scenarios.json"
            ),
            "pipeline-ablation": pipeline_tables.pipeline_ablation(
                folder / "pipeline_ablation.json"
            ),
            "steering-adds": pipeline_tables.steering_adds(folder / "steered_grasps.json"),
            "walls": pipeline_tables.pipeline_ablation(folder / "pipeline_ablation_walls.json"),
            "foreign": grasp_tables.foreign_meshes(folder / "foreign_meshes.json"),
            "grasper": speed_tables.grasper_speed(
                [folder / f"grasper_{device}.json" for device in ("cpu", "h200_host")]
            ),
            "grasper-worlds": speed_tables.grasper_worlds(
                sorted(folder.glob("grasper_worlds_*.json"))
            ),
            "route": grasp_tables.route(folder / "route.json"),
            "first-run": speed_tables.first_run(folder / "make_train_cpu.json"),
            "tests": speed_tables.tests(folder / "tests_cpu.json"),
            "distances": reach_tables.signed_distances(folder / "signed_distance_scans.json"),
            "convex": simulation_tables.convex_pieces(folder / "convex_pieces.json"),
            "engines": simulation_tables.engines(folder / "engines_cpu.json"),
            "files": markdown(_provenance(sorted(folder.rglob("*.json")), folder)),
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


def _provenance(paths: Sequence[Path], folder: Path) -> Table:
    rows = []
    for path in paths:
        name = path.relative_to(folder).as_posix()
        content, what = json.loads(path.read_text()), ""
        left = [content.get("provenance", {}) | {"known": content.get("known")}]
        while left:
            made = left.pop(0)
            versions = made.get("versions", {})
            shown = ", ".join(f"{n} {versions[n]}" for n in ("jax", "mujoco") if n in versions)
            rows.append(
                (
                    f"[{name}](results/{name}){what}",
                    f"`{made.get('command', '')}`",
                    short_revision(made),
                    str(made.get("device", "")),
                    shown,
                    str(made.get("seed", "")),
                )
            )
            known, what = made.get("known") or [], ": taken over"
            left += [known] if isinstance(known, dict) else known
    header = ("file", "command", "git", "device", "versions", "seed")
    return Table("Results files", header, tuple(rows), names=5)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ReadmeConfig, description=__doc__, args=sys.argv[1:])))
