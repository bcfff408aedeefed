"""What `paper.py` makes: the publication's tables and figures, and more, by commands."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

TRIALS, FEWER = "TRIALS:", "FEWER:"
CORES, SHARERS, GRASPS = "CORES", "SHARERS", "GRASPS"
REACHED = "assets/handoffs_reached.npz"
FOLDER = "runs/paper"
"""of what is no result: states and policies on the way, and what is done"""
STATES = (
    "-m mjx_grasp.handoffs --kind reached --gate paper --objects train --per-object 42 "
    f"--max-rounds 4 --objects-dir SCANS --processes SHARERS --out {FOLDER}/handoffs.npz"
)
JUDGES = (
    "-m mjx_grasp.handoffs --kind reached --gate paper --objects eight --per-object 64 "
    f"--seed 4 --objects-dir SCANS --processes SHARERS --out {FOLDER}/judges.npz"
)
"""States of the published gate that no training has seen."""
NEAR = "--gate paper --gate-midpoint 0.0055"
"""How near its gate waits for is not published, but how near the midpoint is at its handoffs."""
END_TO_END = "-m mjx_grasp.train --preset end-to-end --objects-dir SCANS --evaluation-episodes 0"
AS_PUBLISHED = f"{END_TO_END} --handoffs {FOLDER}/handoffs.npz --scene.physics-dt 0.005"
OURS = (
    f"{END_TO_END} --objects eight --handoffs {REACHED} "
    "--scene.physics-dt 0.005 --scene.fix-idle-fingers "
    "--ppo.worlds 8192 --ppo.unroll 32 --ppo.tuning 0 --ppo.averaged 0.1 "
    "--ppo.privileged-critic --ppo.critic-rate 3e-4 --ppo.value-clip 0.5 --ppo.hidden 256 256 "
    "--ppo.action-std 0.15 --task.action.others --task.reach-rate 2 --task.action.arm-rate 0.15 "
    "--task.action.residual leaky --task.given-up 0.08 --task.raised 0.15 "
    "--task.curriculum.kind measured --task.curriculum.until 0.8 --task.curriculum.step 0.05 "
    "--task.curriculum.window 4000 --task.curriculum.frontier 0.5 "
    "--task.reward.reach 0 --task.reward.way-left 300 --task.reward.posture 100 "
    "--task.reward.held 4 --task.reward.hard -0.2 --task.observation.normals "
    "--task.observation.arm --task.observation.others --task.observation.forces "
    "--task.grip.force 2.5 --task.grip.split balanced --task.grip.direction line "
    "--task.grip.follow 0.05 --task.grip.settles --task.grip.friction 0.4 "
    "--task.grip.arrival 0.005 --task.grip.approach-s None --task.grip.freezes "
    "--task.grip.together --task.lift.delay-s 0.5"
)
"""end to end with our critic, grip, rewards and way home, all joints and a faster arm"""
HELPED = "--task.assisted --task.within 0.04"
"""guidance moves the fingers too, once they are near"""
PACED = "--task.reach-rate 1"
"""the arm as fast as reaching keeps to"""


def _paced(word: str, more: str, alone: bool = True) -> dict[str, str]:
    """Trainings with the arm at that speed: two that are guided, and one that is not."""
    ours = f"{OURS} {more}"
    helped = {f"e2e-paced{word}-{k}": f"{ours} {HELPED} {PACED} --seed {k}" for k in (0, 1)}
    return helped | ({f"e2e-paced-alone{word}-0": f"{ours} {PACED}"} if alone else {})


SHORTER = _paced("", "--ppo.iterations 1500")
LONGER = _paced("-long", "--ppo.iterations 2300")
EARLIER = _paced("-early", "--ppo.iterations 2300 --task.curriculum.until 0.4", alone=False)
"""As long, but forced to the whole way after half as many iterations."""
END_TO_END_RUNS = {
    **{f"e2e-paper-{k}": f"{AS_PUBLISHED} --seed {k}" for k in (0, 1)},
    **{f"e2e-helped-{k}": f"{OURS} --ppo.iterations 1500 {HELPED} --seed {k}" for k in (0, 1)},
    "e2e-alone-0": f"{OURS} --ppo.iterations 1500",
}
"""As published, and the best; how each is trained."""
END_TO_END_VARIANTS = {
    **SHORTER,
    **LONGER,
    **EARLIER,
    "e2e-slow-0": (
        f"{OURS} --ppo.iterations 620 {HELPED} --task.reach-rate 0.5 "
        "--task.action.no-others --task.observation.no-others"
    ),
    "e2e-straight-0": (
        f"{OURS} --ppo.iterations 620 {HELPED} --task.raised 0 --task.reward.posture 0"
    ),
}
"""With a slower arm, or without what made the best."""
DRAWN = [run for run in END_TO_END_VARIANTS if run not in SHORTER | EARLIER]
"""Those of them whose curves join the others: of those with the slower arm the long ones."""


@dataclass(frozen=True)
class Part:
    """One table or figure of the publication."""

    name: str
    shows: str
    commands: tuple[str, ...]
    """relative to the repository; `SCANS` stands for the folder of scans, `CORES` for the number of
    cores, fewer beside a GPU, `SHARERS` for that of processes that share a GPU, or without one the
    cores; `TRIALS:56` for as many trials as published in MJX on a GPU, or without one 56 in native
    MuJoCo; `GRASPS` for whole grasps in MJX on a GPU that some processes share, or in native
    MuJoCo; `128|32` for 128, or 32 with `--quick`"""
    without_gpu: str | None = None
    """what it takes without a GPU, where that is too much; None: every machine can do it"""
    not_quick: str | None = None
    """why `--quick` leaves it out; None: it does not"""
    if_named: str | None = None
    """what it takes, where that is so much that it is only made if it is named"""


def fewer(command: str) -> str:
    """A command as `--quick` makes it; what is so already stays.

    Start states and whole grasps, few of which take a GPU as long as many, are made on the cores.
    """
    command = command.replace(TRIALS, FEWER).replace(GRASPS, f"--processes {CORES}")
    return re.sub(r"\b\d+\|(\d+)\b", r"\1", command.replace(SHARERS, CORES))


def _end_to_end(trainings: dict[str, str], drawn: Iterable[str]) -> tuple[str, ...]:
    """Trains, tries and notes policies from home to the lift."""
    return (
        *(f"{train} --out {FOLDER}/{run}" for run, train in trainings.items()),
        *(
            "experiments/evaluate_controllers.py --objects-dir SCANS "
            f"--policy {FOLDER}/{run}/policy.npz --force-budgets 3 --squeeze-forces "
            f"--episodes 32 --processes CORES --out experiments/results/end_to_end/{run}.json"
            for run in trainings
        ),
        *(
            f"experiments/{script} " + " ".join(f"{FOLDER}/{run}" for run in runs)
            for script, runs in (
                ("collect_runs.py --replace", trainings),
                ("learning_curves.py", drawn),
            )
        ),
    )


PARTS = (
    Part(
        "heatmaps",
        "heatmaps of the 28 objects, which can be grasped, and their ranking",
        (
            "experiments/heatmap_figure.py --objects-dir SCANS",
            "experiments/heatmap_ranking.py --objects-dir SCANS",
            "experiments/eligibility.py --objects-dir SCANS",
        ),
    ),
    Part(
        "steering",
        "default against anchored selection, and the grasps that come of it",
        (
            "experiments/steering_figure.py --objects-dir SCANS",
            "experiments/steered_trials_figure.py --objects-dir SCANS",
            "experiments/steering_numbers.py --objects-dir SCANS",
            "experiments/steered_grasps.py --objects-dir SCANS --poses 4|1 GRASPS",
        ),
    ),
    Part(
        "reach",
        "convergence of reaching over tolerance and time",
        (
            "-m mjx_grasp.sweep_reach --poses 2752|688 --processes CORES "
            "--out experiments/results/reach_sweep_cpu.json --plot docs/reach_sweep.png",
        ),
    ),
    Part(
        "handoffs",
        "tip errors at handoffs that the reaching controller comes to",
        (
            "-m mjx_grasp.handoffs --kind reached --objects train held_out --objects-dir SCANS "
            "--per-object 128 --max-rounds 5 --processes SHARERS "
            "--out experiments/results/handoffs_reached.npz",
            "-m mjx_grasp.handoffs --kind reached --gate paper --objects eight --objects-dir SCANS "
            "--per-object 64 --max-rounds 3 --processes SHARERS "
            "--out experiments/results/handoffs_paper_gate.npz",
            f"-m mjx_grasp.handoffs --kind reached {NEAR} --objects eight --objects-dir SCANS "
            "--per-object 64 --max-rounds 3 --processes SHARERS "
            "--out experiments/results/handoffs_paper_near.npz",
        ),
        not_quick="start states are shipped, and `objects` makes some of all objects",
    ),
    Part(
        "eight",
        "success, forces and failure classes on the eight objects, policy and squeeze",
        (
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions nominal hard "
            "--force-budgets 1.5 2 2.5 3 3.5 4 6 8 12 --squeeze-forces 1 2 3 4 5 7 10 "
            "--grip-frictions 0.4 0.5 --episodes 128 "
            "--processes CORES --out experiments/results/eight_native.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --no-with-policy "
            "--conditions nominal hard --squeeze-splits even balanced "
            "--squeeze-forces 1 2 3 4 5 6 7 8 9 10 11 12 --episodes 128 "
            "--known experiments/results/eight_native.json "
            "--processes CORES --out experiments/results/squeezes/eight.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions nominal hard "
            "--force-budgets 1.5 2 2.5 3 3.5 4 6 8 12 --keeping-gain 0 --squeeze-forces "
            "--episodes 128 --processes CORES --out experiments/results/not_kept/eight.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions nominal "
            "--force-budgets 3 --squeeze-forces 3 --episodes 448 "
            "--processes CORES --out experiments/results/beside/planned.json",
            JUDGES,
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions nominal "
            f"--handoffs {FOLDER}/judges.npz --states all "
            "--force-budgets 3 --squeeze-forces 3 10 --episodes 448 "
            "--processes CORES --out experiments/results/beside/gate.json",
            "experiments/force_figure.py",
        ),
        not_quick="native MuJoCo takes most of an hour for them; `engines` has them in MJX",
    ),
    Part(
        "conditions",
        "not of it: misplaced, slippery, light and heavy objects, and noisy torques",
        (
            "experiments/evaluate_controllers.py --objects-dir SCANS --conditions offset10 "
            "offset20 friction04 friction05 friction11 light heavy --force-budgets 3 8 "
            "--squeeze-forces 2 3 5 8 12 --grip-frictions 0.4 "
            "TRIALS:64 --out experiments/results/conditions/exact.json",
            "experiments/evaluate_controllers.py --objects-dir SCANS --noisy-torque --conditions "
            "nominal offset10 offset20 friction04 friction05 friction11 light heavy hard "
            "--force-budgets 3 8 --squeeze-forces 3 5 8 --grip-frictions 0.4 "
            "TRIALS:32 --out experiments/results/conditions/noisy.json",
            "experiments/least_force.py --objects-dir SCANS",
        ),
    ),
    Part(
        "engines",
        "not of it: the same trials of closing in native MuJoCo and in MJX",
        (
            "experiments/evaluate_controllers.py --engine mjx --objects-dir SCANS "
            "--conditions nominal hard --force-budgets 1.5 2 2.5 3 3.5 4 6 8 12 "
            "--squeeze-forces 1 2 3 4 5 7 10 --grip-frictions 0.4 0.5 --episodes 128 "
            "--out experiments/results/engines/eight.json",
        ),
        without_gpu="MJX takes days for them on a few cores",
    ),
    Part(
        "objects",
        "success on all objects that have start states, held-out ones too",
        (
            "-m mjx_grasp.handoffs --kind reached --objects train held_out --per-object 96|8 "
            "--max-rounds 3 --seed 11 --objects-dir SCANS --processes SHARERS "
            f"--out {FOLDER}/reached_all.npz",
            "experiments/evaluate_controllers.py --objects-dir SCANS --objects train held_out "
            f"--handoffs {FOLDER}/reached_all.npz --states all --force-budgets 3 6 12 "
            "--squeeze-forces 3 --grip-frictions 0.4 "
            "TRIALS:24 --out experiments/results/objects/reached.json",
            "experiments/least_force.py --objects-dir SCANS --objects train held_out "
            f"--handoffs {FOLDER}/reached_all.npz --frictions 0.8 "
            "--out experiments/results/objects/least_force.json",
            f"experiments/heavy_objects.py --objects-dir SCANS --handoffs {FOLDER}/reached_all.npz "
            "--processes CORES",
        ),
    ),
    Part(
        "pose-error",
        "success over errors of the object's pose at the handoff",
        (
            "experiments/pose_error.py --objects-dir SCANS TRIALS:56",
            "experiments/pose_error_figure.py",
        ),
    ),
    Part(
        "sensitivity",
        "success where friction, mass, finger stiffness or torque limits are not as modelled",
        (
            "experiments/sensitivity.py --objects-dir SCANS TRIALS:16",
            "experiments/sensitivity_figure.py",
        ),
    ),
    Part(
        "stability",
        "rise, forces and the wrench that is left while an object is held",
        ("experiments/lift_stability.py --objects-dir SCANS --processes CORES",),
    ),
    Part(
        "grasps",
        "not of it: whole grasps from home of all objects, held-out ones too",
        (
            "-m mjx_grasp.scenarios --objects-dir SCANS --objects train held_out "
            "--scenarios nominal --episodes 64 --seed 9 "
            "--processes CORES --out experiments/results/grasps_all.json",
        ),
        not_quick="native MuJoCo takes a quarter of an hour for them",
    ),
    Part(
        "scenarios",
        "whole grasps from home, with what the hardware demonstrations show",
        (
            "-m mjx_grasp.scenarios --objects-dir SCANS --objects eight --episodes 64|8 --seed 9 "
            "--processes CORES --out experiments/results/scenarios.json",
        ),
    ),
    Part(
        "scenarios-engines",
        "not of it: the same whole grasps in native MuJoCo and in MJX",
        (
            "-m mjx_grasp.scenarios --objects-dir SCANS --objects eight --episodes 64 --seed 9 "
            "GRASPS --out experiments/results/engines/scenarios.json",
        ),
        without_gpu="MJX takes days for them on a few cores",
        not_quick="planning is compiled for minutes, and anew for each kind of scenario",
    ),
    Part(
        "ablation",
        "whole grasps without one part of the method each, and a policy that only knows its budget",
        (
            "experiments/pipeline_ablation.py --objects-dir SCANS --episodes 64 GRASPS",
            "experiments/pipeline_ablation.py --objects-dir SCANS --objects bowl toy_airplane "
            "pitcher_base mug cracker_box --variants full sideways walls-alike --scenarios nominal "
            "--episodes 24 GRASPS "
            "--out experiments/results/pipeline_ablation_walls.json",
        ),
        not_quick="every variant is compiled by itself",
    ),
    Part(
        "paper-policy",
        "a policy trained as published, for the rows of the preset `paper`",
        (
            STATES,
            "-m mjx_grasp.train --preset paper --objects-dir SCANS "
            f"--handoffs {FOLDER}/handoffs.npz --evaluation-episodes 0 --out {FOLDER}/seed0",
            f"experiments/collect_runs.py --replace {FOLDER}/seed0",
        ),
        without_gpu="its 31 M steps take days on a few cores",
        not_quick="it trains",
    ),
    Part(
        "paper-ablation",
        "not of it: trainings in the published setting but for one thing, four seeds of each",
        (
            STATES,
            f"-m mjx_grasp.handoffs --kind reached {NEAR} --objects train --per-object 42 "
            f"--max-rounds 4 --objects-dir SCANS --processes SHARERS --out {FOLDER}/near.npz",
            JUDGES,
            f"-m mjx_grasp.tune experiments/paper_ablation.yaml --out {FOLDER}/ablation --together "
            "--flags='--objects-dir SCANS'",
            f"experiments/policy_ablation.py {FOLDER}/ablation --objects-dir SCANS --as-trained "
            f"--handoffs {FOLDER}/judges.npz --budgets 3 --squeezes 1 2 3 5 "
            "--out experiments/results/paper_ablation.json",
        ),
        without_gpu="some weeks of a few cores",
        not_quick="it trains",
        if_named="an hour and a half of one H200",
    ),
    Part(
        "policy-ablation",
        "not of it: trainings of the preset `gpu` but for one thing, three seeds of each",
        (
            f"-m mjx_grasp.tune experiments/policy_ablation.yaml --out {FOLDER}/policy-ablation "
            "--together --gpus 0.5 --flags='--objects-dir SCANS'",
            f"experiments/policy_ablation.py {FOLDER}/policy-ablation --objects-dir SCANS "
            "--budgets 3 12 --episodes 16",
        ),
        without_gpu="some weeks of a few cores",
        not_quick="it trains",
        if_named="half an hour of one H200",
    ),
    Part(
        "end-to-end",
        "the baseline: one policy from home to the lift, as published and with our settings",
        (STATES, *_end_to_end(END_TO_END_RUNS, drawn=END_TO_END_RUNS)),
        without_gpu="its trainings of 31 to 393 M steps take weeks on a few cores",
        not_quick="it trains",
    ),
    Part(
        "end-to-end-variants",
        "not of it: what the baseline of `end-to-end` needs, by trainings without it",
        _end_to_end(END_TO_END_VARIANTS, drawn=DRAWN),
        without_gpu="its trainings of 162 to 603 M steps take weeks on a few cores",
        not_quick="it trains",
        if_named="three hours of training",
    ),
)
