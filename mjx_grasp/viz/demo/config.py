"""What a demo is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.config import BUDGET_N, ClosingController, check_closing
from mjx_grasp.evaluation.grasps.scenario import NOMINAL
from mjx_grasp.heatmap.meshes import Point
from mjx_grasp.heatmap.steering import Steering
from mjx_grasp.objects.config import Weight
from mjx_grasp.records.settings import CommandSettings, Positive, Seed


@dataclass(frozen=True)
class DemoConfig(CommandSettings):
    """One grasp from home, from a mesh and an instruction to a film and a page."""

    object: Annotated[str, tyro.conf.Positional] = "tomato_soup_can"
    """an object of the catalogue, or a mesh of your own (.obj, .ply, .stl, .glb, .off; metres)"""
    instruction: str | None = None
    """which part or side of it: "by the cap"; by default anywhere good"""
    anchor: Point = None
    """or the point itself, in the object frame: axes of the mesh, from the middle of its box [m]"""
    steering: Steering = "contacts"
    """what has to be near that: all three contacts, the grasp's axis (the publication's formula),
    or the middle of the grasp, between the contacts"""
    sigma: Positive | None = None
    """how near; by default 0.03, or as a named part is large [m]"""
    scenario: str = NOMINAL
    """what happens meanwhile: a scenario by name, or a file of your own (.yaml)"""
    seed: Seed = 0
    """of where the object lies, and of the plans"""
    out: Path = Path("demo")
    """folder to write grasp.mp4, result.json and index.html into"""
    objects_dir: Path | None = None
    """folder of real scans of the catalogue's objects; parametric stand-ins without one"""
    mass: Positive | None = None
    """of a mesh of your own [kg]"""
    density: Positive | None = None
    """of a mesh of your own, instead of a mass; 500 if neither is given [kg/m^3]"""
    controller: ClosingController = "policy"
    """what closes: a policy on top of a grip that answers to load, or that grip alone"""
    policy: Path | None = None
    """policy file; the shipped one by default"""
    force_budget: Positive = BUDGET_N
    """mean force per finger that a policy which knows a budget may take; light objects get less of
    it, as far as their weight is known [N]"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""

    def __post_init__(self) -> None:
        super().__post_init__()
        Weight(self.mass, self.density)  # refuses both
        check_closing(self.controller, self.policy, self.force_budget)
        if self.instruction is not None and self.anchor is not None:
            raise InputError("--instruction and --anchor", "both", "one of them at most")
        if not self.steers and (self.sigma is not None or self.steering != "contacts"):
            expected = "an --anchor or an --instruction with it"
            raise InputError("--steering or --sigma", "no place to steer to", expected)

    @property
    def steers(self) -> bool:
        """Whether it is said where to grasp."""
        return self.instruction is not None or self.anchor is not None

    @property
    def weight(self) -> Weight:
        """What a mesh of the user weighs."""
        return Weight(self.mass, self.density)
