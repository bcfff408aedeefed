"""Every number of the handoff dataset, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from mjx_grasp.errors import InputError
from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.grasp.wrench_margin import ContactConfig
from mjx_grasp.heatmap.config import HeatmapConfig
from mjx_grasp.objects.config import ObjectsConfig
from mjx_grasp.posture.config import ClearanceConfig, IkConfig, StartConfig
from mjx_grasp.records.settings import (
    Count,
    NonNegative,
    Positive,
    PositiveOrNever,
    Range,
    Seed,
    Settings,
    Share,
    Suffix,
)
from mjx_grasp.records.spread import Spread
from mjx_grasp.sim.scene import ObjectArea

HandoffKind = Literal["ik", "reached", "mixed"]
HandoffGate = Literal["default", "paper", "converged"]


@dataclass(frozen=True)
class SamplingConfig(Settings):
    """Object poses on the table and the candidates tried on them (method §0, §4)."""

    area: ObjectArea = field(default_factory=ObjectArea)
    """where objects lie"""
    standing: Share = 0.0
    """share of the poses in which objects stand as they were scanned, besides where they come to
    rest by themselves; for objects that do stand so, such as tall cans [-]"""
    poses_per_round: Count = 128
    """object poses drawn at a time [-]"""
    candidates_per_pose: Count = 3
    """heatmap candidates tried on each [-]"""
    min_score: Share = 0.05
    """candidates below this are not used, as in the selection; for reached states, as in whole
    grasps, where no other can be [-]"""
    temperature: Positive = 0.2
    """candidates are drawn with weight exp(score/temperature) [-]"""
    min_distance: NonNegative = 0.008
    """of the candidates of one pose, thumb contacts are at least this far apart [m]"""


@dataclass(frozen=True)
class PostureConfig(Settings):
    """The search for a posture at each candidate."""

    library: Count = 60_000
    """configurations from which the starts are taken [-]"""
    grid: Annotated[int, Range(2)] = 64
    """points along each edge of the grid of distances to the object [-]"""
    tolerance: Positive = 0.005
    """a larger tip error rejects [m]"""
    starts: StartConfig = field(
        default_factory=lambda: StartConfig(
            near=4096, count=4, direction_scale=0.05, chance=0.0, time_scale=0.0, overlap_weight=5.0
        )
    )
    """where the solver starts"""
    ik: IkConfig = field(default_factory=lambda: IkConfig(idle_weight=None, clearance_weight=1.0))
    """the solver; fingers that take no part in a grasp stay as they are"""
    clearances: ClearanceConfig = field(
        default_factory=lambda: ClearanceConfig(
            object=0.003, hand_table=0.003, arm_table=0.003, fingers=0.003, arm=0.003
        )
    )
    """what the solver keeps apart; what is refused is for MuJoCo's collisions to say"""
    lift_height: NonNegative = 0.15
    """that the palm is to rise straight up from a posture [m]"""
    lift_error: Annotated[float, Range(0, finite=False)] = 0.03
    """a posture from which it ends farther from there is refused; inf refuses none, as published:
    joint limits in the lift were what most start states failed by that always did [m]"""
    touch_error: Annotated[float, Range(0, finite=False)] = 0.022
    """a posture from which a closing finger stays farther from its contact is refused; inf refuses
    none, as published [m]"""
    must_hold: PositiveOrNever = ContactConfig().friction
    """friction with which the contacts have to hold the object by what the thumb's motors can
    press, or the posture is refused; inf refuses none, as published [-]"""


@dataclass(frozen=True)
class HandoffConfig(ObjectsConfig, Spread):
    """Settings of `python -m mjx_grasp.handoffs`."""

    out: Annotated[Path, Suffix((".npz",))]
    """the handoff set to write (.npz); a report (.json) is written beside it"""
    update: tuple[Path, ...] = ()
    """earlier sets, each with its report: what they have of other objects is taken over, of an
    object that several have from the last of them"""
    robot: str = "rizon4_hx5d20"
    """name or description file of the robot"""
    per_object: Count = 128
    """pre-grasps wanted of each object [-]"""
    kind: HandoffKind = "ik"
    """what states are: ik, postures in front of drawn candidates; reached, where the reaching
    controller really comes to with the candidate that it selects, from home and without physics;
    or a mixture of both"""
    reached_share: Annotated[float, Range(0, 1)] = 0.5
    """of each object's states in a mixture [-]"""
    gate: HandoffGate = "default"
    """when a reach hands off: default, the controller's own; paper, as soon as the midpoint of the
    tips is near; converged, when every tip is within 20 mm and slow"""
    gate_midpoint: Positive | None = None
    """midpoint error below which the gate opens, instead of its own [m]"""
    fix_idle_fingers: bool = True
    """whether fingers that take no part in a grasp stay at zero while the others reach, which
    trainings that fix them need; else they make way, as on the robot"""
    max_rounds: Count = 20
    """rounds of sampling before an object is left with what it has [-]"""
    max_per_candidate: Count = 4
    """pre-grasps that may share one heatmap candidate [-]"""
    seed: Seed = 0
    """of everything random; an object's states do not depend on the other objects"""
    heatmap: HeatmapConfig = field(default_factory=HeatmapConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    posture: PostureConfig = field(default_factory=PostureConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind == "ik" and (self.gate != "default" or self.gate_midpoint is not None):
            name = "gate" if self.gate != "default" else "gate_midpoint"
            expected = "with --kind reached or mixed alone: inverse kinematics has no gate"
            raise InputError(self.name_of(name), getattr(self, name), expected)
        if self.kind != "mixed" and self.reached_share != type(self).reached_share:
            expected = f"with --kind mixed alone: all or none are reached with --kind {self.kind}"
            raise InputError(self.name_of("reached_share"), self.reached_share, expected)
        if self.kind == "mixed" and 0 in self.shares(self.per_object):
            expected = f"a share of {self.per_object} states per object with one of each kind"
            raise InputError(self.name_of("reached_share"), self.reached_share, expected)

    def shares(self, states: int) -> tuple[int, int]:
        """How many of an object's states are of inverse kinematics, and how many reached."""
        share = {"ik": 0.0, "reached": 1.0, "mixed": self.reached_share}[self.kind]
        reached = round(share * states)
        return states - reached, reached
