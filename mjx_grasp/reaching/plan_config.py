"""Settings of the search for plans."""

from __future__ import annotations

from dataclasses import dataclass, field

from mjx_grasp.posture.config import IkConfig, StartConfig
from mjx_grasp.reaching.approach import Approach
from mjx_grasp.records.settings import (
    Count,
    NonNegative,
    Positive,
    PositiveOrNever,
    Seed,
    Settings,
    WholeNumber,
)
from mjx_grasp.sim.scene import ObjectArea


@dataclass(frozen=True)
class PlanConfig(Settings):
    """How hard a solution is looked for, and which one is preferred."""

    library: Count = 60_000
    """configurations from which the starts are taken [-]"""
    kept: Count = 3
    """plans that differ, for re-selection [-]"""
    differs: NonNegative = 0.05
    """palm poses this far apart differ, a turn counting with the lever below [m]"""
    lever: NonNegative = 0.1
    """of the palm's turn against its displacement [m/rad]"""
    haste: NonNegative = 1.0
    """cost of a second on the way, in the seconds in which all costs are given [-]"""
    tolerance: Positive = 0.005
    """largest tip error of a solution to be reached for [m]"""
    lift_height: Positive = 0.15
    """that the palm is to rise straight up afterwards [m]"""
    lift_error: PositiveOrNever = float("inf")
    """from where that should bring it to where it does; a posture with more comes after all others,
    by default lifting is not looked at [m]"""
    touch_error: PositiveOrNever = float("inf")
    """the same of the finger that stays farthest from its contact when it closes [m]"""
    touch_weight: NonNegative = 0.0
    """time that such a distance below that bound counts as, where the bound is finite [s/m]"""
    pad_weight: NonNegative = 0.0
    """time that a radian counts as by which the closed finger that faces its contact least is
    turned beyond the angle below, and touches with its side; by default not at all [s/rad]"""
    pad_angle: NonNegative = 0.8
    """[rad]"""
    lever_weight: NonNegative = 0.0
    """time that a metre counts as between the middle of the contacts and the centre of mass, seen
    from above: the object hangs askew there and turns; by default not at all [s/m]"""
    hold_weight: NonNegative = 0.0
    """time that a force of once the object's weight counts as, where its contacts ask for so much
    more to hold it than two upright walls would; by default that is not looked at [s]"""
    hold_friction: Positive = 0.4
    """of the contacts in that force [-]"""
    hold_most: Positive = 5.0
    """contacts that ask for more force, or cannot hold the object, count as this much [-]"""
    must_hold: PositiveOrNever = float("inf")
    """friction with which the contacts have to oppose each other, and to hold the object by what
    the thumb's motors can press, or the attempt is none; by default that is not looked at [-]"""
    press_weight: NonNegative = 0.0
    """time that a newton counts as by which the thumb's motors press less than the contacts ask for
    to hold an object of known weight; by default that is not looked at [s/N]"""
    press_friction: Positive = 0.5
    """of the contacts in that force [-]"""
    heavier: PositiveOrNever = float("inf")
    """contacts that ask for no more than so many times the least force, by an estimate, are looked
    for first; by default all are [-]"""
    edge_weight: NonNegative = 0.0
    """time that it counts as where the surface falls away near a contact, by the largest distance
    to it on a circle around the contact in its tangent plane; by default not at all [s/m]"""
    edge_radius: Positive = 0.010
    """of that circle: about half the width of a fingertip [m]"""
    at_least: tuple[Count, ...] = ()
    """of the candidates that can be used where the object lies, so many of the highest scores are
    looked at, those with the selection's least score among them; where there is no good posture for
    them, more, one number after the other; by default those with that score alone [-]"""
    easily: PositiveOrNever = float("inf")
    """after the first number, and first of all after a try that failed, comes as many again of the
    contacts that ask for no more than so many times the least force of all that can be used, by an
    estimate; by default not [-]"""
    far_weight: NonNegative = 0.0
    """where `at_least` so many are looked at: time that it counts as to have the lowest of the
    scores that can be used instead of the highest, and in between by rank; half as much after each
    failure, see `Planner.search`; by default none [s]"""
    lesser_scores: tuple[NonNegative, ...] = ()
    """where no good posture is found for candidates of the selection's least score: the least
    scores with which they are looked for then, one after the other [-]"""
    lesser_cost: Positive = 15.0
    """cost from which a posture is not good enough to stop looking; a millimetre of tip error or of
    missing clearance costs one, and `far_weight` counts too [s]"""
    approach: Approach = "any"
    """where the palm is to come from: straight from above or level, give or take the angle below"""
    approach_angle: Positive = 0.8
    """[rad]"""
    seed: Seed = 0
    """of the library"""
    area: ObjectArea = field(default_factory=ObjectArea)
    """over which the library's hands are about to grasp something"""
    starts: StartConfig = field(default_factory=StartConfig)
    """where the solver starts"""
    ik: IkConfig = field(default_factory=IkConfig)
    """the solver; clearances are the controller's"""
    finalists: Count | None = None
    """attempts that go on after the first steps, the most promising; None: all [-]"""
    first_steps: Count = 6
    """that every attempt gets where some are left behind, beside the solver's own [-]"""
    retreat_steps: Count | None = None
    """of the solver for the retreated posture; None: as many as its own [-]"""
    way_out: NonNegative = 0.0
    """where tips come nearer to the object than this on the way out, along the normal of the plane
    of grasp axis and wraps, the hand retreats straight up if they keep farther away then; 0: never
    [m]"""
    way_samples: WholeNumber = 0
    """postures on the straight way to the retreated posture, and as many on the way in from it,
    whose clearances count; 0: plans are chosen by where they end alone [-]"""
    way_weight: NonNegative = 10.0
    """time that a clearance missing on these ways counts as, and a retreat that comes short
    [s/m]"""
