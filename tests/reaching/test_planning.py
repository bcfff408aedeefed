"""Plans: inverse kinematics from a library of starts, and the guides made of them."""

from dataclasses import replace
from functools import partial

import handmade
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.evaluation.reach.poses import draw_poses
from mjx_grasp.evaluation.reach.sweep import candidates_of, plan_all
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Cylinder, Sphere
from mjx_grasp.posture.body import FINGERS, PALM
from mjx_grasp.posture.config import StartConfig
from mjx_grasp.posture.ik import TipGoals
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.command import half_spaces
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.fields import pad_goals
from mjx_grasp.reaching.guide import Tracked, follow, track
from mjx_grasp.reaching.plan_costs import asked_of, closing_costs, light_enough, slip_costs
from mjx_grasp.reaching.planning import Planner, start_library
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.sim.collision import CollisionChecker
from mjx_grasp.sim.scene import build_scene

COUNT = 6


@pytest.fixture(scope="module")
def planned(body):
    settings = reach_preset("default")
    reacher = Reacher(body, settings.reach, settings.selection)
    plan = replace(settings.plan, library=8000, starts=StartConfig(near=256, count=16))
    poses = draw_poses(COUNT, seed=21)
    library = start_library(body, plan)

    def search(poses):
        return plan_all(Planner(reacher, plan), library, poses, COUNT)

    return reacher, plan, poses, search(poses), search


def _world(poses, k):
    shape = Cylinder(jnp.float32(poses.radius[k]), jnp.float32(poses.half_length[k]))
    return Surroundings.still(shape, jnp.asarray(poses.p_wo[k]), jnp.asarray(poses.R_wo[k]))


def test_plans_put_the_tips_at_their_standoffs_clear_of_everything(planned):
    reacher, plan, poses, found, _ = planned
    body, config = reacher.body, reacher.config

    @jax.jit
    def state(q, around):
        motion = body.kinematics.motion(q)
        _, bound, _ = half_spaces(body, motion, around, config)
        return motion.pos[:FINGERS], jnp.max(bound) * config.limits.horizon

    good = 0
    for k in range(COUNT):
        around = _world(poses, k)
        candidates = candidates_of(reacher, around.shape)
        c, q = int(found.plans.candidate[k, 0]), jnp.asarray(found.plans.guide.q[k, 0, 0])
        assert np.all(q >= body.lower) and np.all(q <= body.upper)
        centre, spread = candidates.centre[c], found.plans.spread[k, 0]
        offset = reacher.selection.targets.wrap_spread * spread
        contacts = jnp.stack([candidates.thumb[c], centre + offset, centre - offset])
        wrap = candidates.wrap_normal[c]
        normals = jnp.stack([candidates.normal[c], wrap, wrap])
        standoff = np.array([0.025, 0.040, 0.040])[:, None]
        goals = around.p_wo + (contacts + standoff * normals) @ around.R_wo.T
        tips, missing = state(q, around)
        error = np.linalg.norm(tips - goals, axis=1).max()
        good += error < plan.tolerance + 1e-3 and missing < 2e-3
    assert good >= COUNT - 1
    assert np.all(found.least_error < 0.02)


def test_an_object_that_is_nowhere_gets_no_plan_and_leaves_the_others_theirs(planned):
    _, _, poses, found, search = planned
    lost = poses.p_wo.copy()
    lost[2] = np.nan
    without = search(poses._replace(p_wo=lost))
    assert not np.any(without.plans.guide.known[2]) and without.least_error[2] == np.inf
    others = np.arange(COUNT) != 2
    np.testing.assert_array_equal(
        without.plans.guide.known[others], found.plans.guide.known[others]
    )
    np.testing.assert_array_equal(without.plans.guide.q[others], found.plans.guide.q[others])


def test_plans_are_free_of_self_collisions_by_mujoco(planned):
    reacher, _, _, found, _ = planned
    checker = CollisionChecker(build_scene([handmade.ball()], reacher.body.robot))
    away, upright = np.array([10.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0])
    reasons = [checker.reason(q, away, upright) for q in found.plans.guide.q[:, 0, 0]]
    assert reasons.count(None) >= COUNT - 1


def test_plans_of_one_pose_differ(planned):
    _, plan, _, found, _ = planned
    guide = found.plans.guide
    for k in range(COUNT):
        first, second = (
            (guide.palm_pos[k, i, 0], guide.palm_mat[k, i, 0], found.cost[k, i]) for i in (0, 1)
        )
        assert first[2] <= second[2]
        turn = np.linalg.norm(so3.log(jnp.asarray(first[1] @ second[1].T)))
        assert np.linalg.norm(first[0] - second[0]) + plan.lever * turn > 0.9 * plan.differs


def _guide(planned, k=0):
    reacher, _, poses, found, _ = planned
    guide = jax.tree.map(lambda leaf: jnp.asarray(leaf[k, 0]), found.plans.guide)
    return reacher, guide, jnp.asarray(poses.p_wo[k]), jnp.asarray(poses.R_wo[k])


def test_guides_stay_while_the_object_does_and_track_it_when_it_moves(planned):
    reacher, guide, p, R = _guide(planned)
    body, config = reacher.body, reacher.config.guide
    step = jax.jit(lambda q, p, R: track(body, guide, q, p, R, config))
    q, astray = step(guide.q, p, R)
    np.testing.assert_allclose(q, guide.q, atol=1e-6)
    assert float(astray) < 0.01
    p_new = p + jnp.asarray([0.0, 0.03, 0.0])
    R_new = so3.exp(jnp.asarray([0.0, 0.0, 0.1])) @ R
    for _ in range(30):
        q, astray = step(q, p_new, R_new)
    motion = body.kinematics.motion(q[0])
    wanted = p_new + R_new @ guide.palm_pos[0]
    assert np.linalg.norm(motion.pos[PALM] - wanted) < 2e-3
    assert float(astray) < 0.01
    hand = ~body.arm
    np.testing.assert_allclose(q[:, hand], guide.q[:, hand], atol=1e-6)


def test_the_hand_comes_in_only_when_it_is_aligned(planned):
    reacher, guide, _, _ = _guide(planned)
    body, config, around = reacher.body, reacher.config.guide, _world(planned[2], 0)

    def one(q, left):
        tracked = Tracked(guide.q, jnp.float32(0))
        return follow(guide, tracked, left, body.kinematics.motion(q), around, config, 0.01)

    outside = jnp.float32(1.0)
    goal, left = one(guide.q[1], outside)  # at the retreated pose
    assert left < 1.0 and np.all(np.isfinite(goal.palm_pos))
    _, far = one(jnp.asarray(body.home), outside)
    assert far == 1.0
    # Spoilt on the way, it backs out; at the end it stays.
    _, back = one(jnp.asarray(body.home), jnp.float32(0.5))
    assert back > 0.5
    goal, done = one(guide.q[0], jnp.float32(0.0))
    assert done == 0.0
    np.testing.assert_allclose(goal.offset, 0.0, atol=1e-7)
    np.testing.assert_allclose(goal.q, guide.q[0], atol=1e-6)


@pytest.mark.long
def test_without_additions_everything_is_pursued_as_before(planned):
    reacher, plan, poses, _, _ = planned
    library = start_library(reacher.body, plan)
    plain = replace(plan, finalists=None, retreat_steps=None, way_samples=0)
    one = jax.tree.map(lambda leaf: leaf[:1], poses)

    def search(plan):
        return plan_all(Planner(reacher, plan), library, one, 1)

    # All attempts as finalists leave none behind, whatever the first steps would be.
    everyone = replace(plain, finalists=plain.starts.count, first_steps=1)
    all_steps = replace(plain, retreat_steps=plain.ik.iterations, way_weight=1e3)
    for other in (everyone, all_steps):
        for a, b in zip(*map(jax.tree.leaves, (search(plain), search(other))), strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_guide_leads_straight_up_where_the_way_out_is_blocked(planned):
    """A ball on the way out of one tip; without `way_out`, and where nothing is, it stays."""
    reacher, plan, poses, found, _ = planned
    guide = jax.tree.map(lambda leaf: jnp.asarray(leaf[0, 0]), found.plans.guide)
    tips = reacher.body.kinematics.motion(guide.q[0]).pos[:FINGERS]
    wanted, R = TipGoals(tips, pad_goals(tips)), jnp.asarray(poses.R_wo[0])
    sideways = np.asarray(R @ guide.tip_shift / jnp.linalg.norm(guide.tip_shift))
    assert abs(sideways[2]) < 0.9, "it can be told from straight up"
    ball = Sphere(jnp.asarray(0.02))
    there = Surroundings.still(ball, tips[1] + 0.1 * jnp.asarray(sideways), jnp.eye(3))
    nowhere = there._replace(p_wo=jnp.asarray([0.0, 0.0, 5.0]))

    def shift(way_out, around):
        planner = Planner(reacher, replace(plan, way_out=way_out, retreat_steps=None))
        _, made = jax.jit(planner._solved)(wanted, guide.q[0], around)
        return np.asarray(around.R_wo @ made.tip_shift) / np.linalg.norm(made.tip_shift)

    assert shift(0.02, there)[2] > 0.95
    for way_out, around in ((0.0, there), (0.02, nowhere)):
        assert shift(way_out, around) @ sideways > 0.9


@pytest.mark.long
def test_what_is_in_the_way_and_a_detour_cost_time(planned):
    reacher, plan, poses, found, _ = planned
    planner = Planner(reacher, replace(plan, way_samples=4))
    cost = jax.jit(planner._way_cost)
    guide = jax.tree.map(lambda leaf: jnp.asarray(leaf[0, 0]), found.plans.guide)
    around, home = _world(poses, 0), jnp.asarray(reacher.body.home)
    away = around._replace(p_wo=jnp.asarray([0.0, 0.0, 5.0]))
    # An object where the hand begins its way in, and one that is nowhere.
    outside = reacher.body.kinematics.motion(guide.q[1]).pos[PALM]
    there = around._replace(p_wo=outside)
    assert cost(guide, home, there) > cost(guide, home, away) + 0.1
    # Farther out than there is a way for is a detour.
    limit = jnp.asarray(reacher.body.velocity_limit)
    far = guide._replace(q=guide.q.at[1].add(0.5 * limit * jnp.sign(guide.q[1] - home)))
    longer = cost(far, home, away) - cost(guide, home, away)
    assert longer > 0.4
    hasty = jax.jit(replace(planner, config=replace(planner.config, haste=3.0))._way_cost)
    in_haste = hasty(far, home, away) - hasty(guide, home, away)
    assert in_haste - longer > 2.0 * 0.4  # of the detour's seconds, three for one


@pytest.mark.long
def test_contacts_cost_by_the_force_they_ask_for_and_by_the_edges_near_them(planned):
    """On an upright cylinder, its three contacts at heights below the upper rim."""
    _, plan, _, _, _ = planned
    radius, half, friction = 0.03, 0.05, 0.4
    shape = Cylinder(jnp.float32(radius), jnp.float32(half))
    out = jnp.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    spread = jnp.array([[0.0, 0, 0], [0, 0.01, 0], [0, -0.01, 0]])
    turn = so3.exp(jnp.array([0.0, 0.0, 0.7]))
    place = jnp.array([0.4, 0.1, half])

    def cost(below_rim, com=(0.0, 0.0, 0.0), at=radius * out, **weights):
        config = replace(plan, hold_friction=friction, **weights)
        around = Surroundings.still(shape, place, turn, jnp.array(com))
        local = at.at[:, 2].add(half - below_rim)
        contacts = place + local @ turn.T
        given = contacts[None], (out @ turn.T)[None]
        asked = asked_of(config, *given, around)
        return float(slip_costs(config, *given, asked, around)[0])

    assert cost(0.002) == 0.0
    # The circle's highest point is beyond the rim by what the contact is too near to it.
    near, far = (cost(below, edge_weight=1.0, edge_radius=0.01) for below in (0.002, 0.03))
    around_wall = np.hypot(radius, 0.01) - radius
    assert near == pytest.approx(0.008, abs=1e-4) and far == pytest.approx(around_wall, abs=1e-4)
    # Upright walls beside the centre of mass ask for what they are compared with.
    cost = partial(cost, at=radius * out + spread)
    level = cost(half, hold_weight=1.0)
    assert level == pytest.approx(0.0, abs=0.03)
    lower = cost(half, (0.0, 0.02, 0.0), hold_weight=1.0)
    assert lower > level + 0.05
    assert cost(half, (0.0, 0.02, 0.0), hold_weight=3.0) == pytest.approx(3 * lower, rel=1e-3)

    # Seen from above, the middle is half thumb, half wraps.
    assert cost(half, (0.02, 0.0, 0.03), lever_weight=2.0) == pytest.approx(0.04, abs=1e-5)
    assert cost(half, (0.0, 0.0, 0.03), lever_weight=2.0) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.long
def test_plans_hold_an_object_where_its_weight_is_if_force_counts(planned):
    """By friction alone: the nearer the contacts are to the centre of mass, the less force."""
    reacher, plan, poses, _, _ = planned
    library = start_library(reacher.body, plan)
    planner = Planner(reacher, replace(plan, hold_weight=30.0))
    home, key = jnp.asarray(reacher.body.home), jax.random.key(0)

    @jax.jit
    def contacts(around):
        candidates = candidates_of(reacher, around.shape)
        plans = planner.search(library, candidates, around, home, key).plans
        pick = plans.candidate[0]
        return 0.5 * (candidates.thumb[pick] + candidates.centre[pick])

    ends = [jnp.array([0.0, 0.0, side * 0.05]) for side in (-1.0, 1.0)]
    shift = []
    for k in range(COUNT):
        low, high = (contacts(_world(poses, k)._replace(com=com))[2] for com in ends)
        shift.append(float(high - low))
    assert np.median(shift) > 0.01 and min(shift) >= -1e-3


@pytest.mark.long
def test_plans_use_contacts_that_can_hold_alone(planned):
    """Of candidates whose wraps were turned to another face none is planned for.

    Nor are they searched: where they are nearly all there is, the few others are found.
    """
    reacher, plan, poses, _, _ = planned
    library = start_library(reacher.body, plan)
    home, key = jnp.asarray(reacher.body.home), jax.random.key(0)

    def turned(candidates, which):
        up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), candidates.wrap_normal.shape)
        normal = jnp.where(which[:, None], up, candidates.wrap_normal)
        return candidates._replace(wrap_normal=normal)

    @partial(jax.jit, static_argnames="must_hold")
    def search(must_hold, around, which):
        candidates = turned(candidates_of(reacher, around.shape), which)
        planner = Planner(reacher, replace(plan, must_hold=must_hold))
        return planner.search(library, candidates, around, home, key).plans

    count = candidates_of(reacher, _world(poses, 0).shape).score.shape[0]
    for k in range(2):
        around = _world(poses, k)
        first = search(float("inf"), around, jnp.zeros(count, bool))
        bad = jnp.zeros(count, bool).at[first.candidate].set(True)
        plans = search(0.8, around, bad)
        assert plans.guide.known[0] and not bad[plans.candidate[0]]
        assert not search(0.8, around, jnp.ones(count, bool)).guide.known.any()
    nearly_all = jnp.ones(count, bool).at[::15].set(False)
    for k in range(COUNT):
        plans = search(0.8, _world(poses, k), nearly_all)
        assert plans.guide.known.all() and not nearly_all[plans.candidate].any()


def test_contacts_that_ask_for_little_more_than_the_least_are_light_enough(planned):
    """Upright walls ever farther beside the centre of mass."""
    _, plan, _, _, _ = planned
    out, aside = jnp.array([[-0.03, 0, 0], [0.03, 0.01, 0], [0.03, -0.01, 0]]), jnp.arange(8) * 0.01
    contacts = out + aside[:, None, None] * jnp.array([0.0, 1.0, 0.0])
    around = Surroundings.still(Sphere(jnp.float32(0.03)), jnp.zeros(3), jnp.eye(3))
    every = jnp.ones(8, bool)

    def light(heavier, admissible=every):
        return np.asarray(light_enough(plan, heavier, admissible, contacts, around)).tolist()

    assert all(light(float("inf")))
    few, more = light(1.5), light(3.0)
    assert few[0] and not few[-1] and sum(more) > sum(few)
    assert few == sorted(few, reverse=True)
    beside = light(1.5, every.at[:4].set(False))
    assert beside[4] and sum(beside) > sum(few), "the least of those that may be used counts"


@pytest.mark.long
def test_postures_cost_by_what_the_thumb_cannot_press(planned):
    """Only of a known weight, and in proportion beyond what it can."""
    reacher, plan, _, _, _ = planned
    body = reacher.body
    plan = replace(plan, press_weight=2.0, hold_most=100.0)
    q = jnp.asarray(body.home)[None]
    out = jnp.array([[-1.0, 0, 0], [1, 0, 0], [1, 0, 0]])
    contacts = (0.03 * out + jnp.array([[0.0, 0, 0], [0, 0.01, 0], [0, -0.01, 0]]))[None]

    def cost(weight):
        around = Surroundings.still(Sphere(jnp.float32(0.03)), jnp.zeros(3), jnp.eye(3))
        around = around._replace(weight=None if weight is None else jnp.float32(weight))
        asked = asked_of(plan, contacts, out[None], around)
        return float(closing_costs(body, plan, q, contacts, out[None], asked, around)[0])

    assert cost(None) == cost(0.0) == cost(1.0) == 0.0
    # The thumb bears half of it, by friction.
    more = cost(60.0) - cost(40.0)
    assert more == pytest.approx(2.0 * 0.5 * 20.0 / plan.press_friction, rel=0.02)
    inf = replace(body, torque_limit=np.full_like(body.torque_limit, np.inf))
    around = Surroundings.still(Sphere(jnp.float32(0.03)), jnp.zeros(3), jnp.eye(3))
    around = around._replace(weight=jnp.float32(60.0))
    asked = asked_of(plan, contacts, out[None], around)
    assert float(closing_costs(inf, plan, q, contacts, out[None], asked, around)[0]) == 0.0


def test_postures_cost_by_the_finger_that_faces_its_contact_least(planned):
    """As its normal turns away from where the pad points, beyond a bound."""
    reacher, plan, _, _, _ = planned
    body = reacher.body
    q = jnp.asarray(body.home)
    motion = body.kinematics.motion(q)
    pads, facing = motion.pos[FINGERS:PALM], -motion.mat[FINGERS:PALM, :, 0]
    aside = motion.mat[FINGERS:PALM, :, 1]
    around = Surroundings.still(Sphere(jnp.float32(0.03)), jnp.zeros(3), jnp.eye(3))

    def cost(angles, weight=2.0):
        angles = jnp.array(angles)[:, None]
        normals = jnp.cos(angles) * facing + jnp.sin(angles) * aside
        config = replace(plan, pad_weight=weight, pad_angle=0.8)
        given = pads[None], normals[None]
        asked = asked_of(config, *given, around)
        return float(closing_costs(body, config, q[None], *given, asked, around)[0])

    assert cost((0.0, 0.5, 0.75)) == pytest.approx(0.0, abs=1e-3)
    assert cost((0.0, 1.3, 0.9)) == pytest.approx(2.0 * 0.5, abs=5e-3)
    assert cost((1.0, 0.0, 0.0), 4.0) == pytest.approx(4.0 * 0.2, abs=1e-2)
