"""What whole grasps are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console

from mjx_grasp.errors import InputError
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.records.settings import Count, Positive, Seed, Suffix
from mjx_grasp.records.spread import Spread
from mjx_grasp.sim.engines import Engine
from mjx_grasp.tasks.assemble import has_gpu

ClosingController = Literal["policy", "grip"]
"""what closes: a policy on top of a grip that answers to load, or that grip alone"""
BUDGET_N = 8.0
"""Force budget of whole grasps by default, among those of the shipped policy's training [N]."""


def warn_without_gpu(engine: Engine, console: Console) -> None:
    """Says that MJX without a GPU is slow."""
    if engine == "mjx" and not has_gpu():
        slow = "no GPU: MJX runs on this machine's cores, many times slower than --engine mujoco"
        console.print(f"[yellow]{slow}[/yellow]")


def check_closing(
    controller: ClosingController, policy: Path | None, budget: float = BUDGET_N
) -> None:
    """Refuses what is a policy's beside the grip alone.

    Raises:
        InputError: There is a policy, or a force budget.
    """
    if controller == "grip" and policy is not None:
        raise InputError("--policy", policy, "none beside --controller grip")
    if controller == "grip" and budget != BUDGET_N:
        raise InputError("--force-budget", budget, "none beside --controller grip")


@dataclass(frozen=True, kw_only=True)
class GraspsConfig(ObjectsConfig):
    """Which grasps from home, whoever makes them."""

    scenarios: tuple[str, ...] = ("all",)
    """scenarios by name, all of them, or files of your own (.yaml)"""
    episodes: Count = 8
    """of each object in each scenario; one that names objects of its own has as many trials in all,
    shared among those, at least one of each [-]"""
    engine: Engine = "mujoco"
    """what steps the physics: mujoco (native, in threads) or mjx (Warp, on a GPU)"""
    seed: Seed = 0
    """of the poses, the plans and what happens"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    force_budget: Positive = BUDGET_N
    """mean force per finger that a policy which knows a budget may take; light objects get less of
    it, as far as their weight is known [N]"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""


@dataclass(frozen=True, kw_only=True)
class ScenariosConfig(GraspsConfig, Spread):
    """Grasps from home in physics, while this or that happens."""

    out: Annotated[Path, Suffix((".json",))]
    """results file (.json); one that an interrupted run left is gone on with"""
    controller: ClosingController = "policy"
    """what closes: a policy on top of a grip that answers to load, or that grip alone"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_closing(self.controller, self.policy, self.force_budget)
