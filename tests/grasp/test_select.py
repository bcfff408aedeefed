"""The online selection: an independent oracle, invariances, hysteresis, rejections."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.grasp.candidates import (
    cylinder_candidates,
    evenly_over_directions,
    first_and_rest,
    from_heatmap,
    vertex_candidates,
)
from mjx_grasp.grasp.config import SelectionConfig, TargetConfig
from mjx_grasp.grasp.select import HandPose, select, start_selection
from mjx_grasp.grasp.targets import NONE, admissible, target_options
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.heatmap.steering import steer

CONFIG = SelectionConfig()
SPAN = (0.02, 0.09)


def _hand(rng, centre=(0.5, 0.0, 0.15)):
    tips = np.asarray(centre) + rng.normal(scale=0.06, size=(3, 3))
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return HandPose(*(jnp.asarray(a, jnp.float32) for a in (tips, axes[0], axes[1])))


def _pose(rng, height=0.15):
    R = so3.exp(jnp.asarray(rng.normal(size=3), jnp.float32))
    return jnp.asarray([0.5, 0.0, height], jnp.float32), R


@pytest.fixture(scope="module")
def cylinder():
    return cylinder_candidates(jnp.float32(0.03), jnp.float32(0.06), SPAN)


def _costs(candidates, hand, p, R, config):
    """The objective of method §2 as it is written, one candidate after another, in world."""
    R = np.asarray(R, np.float64)
    candidates = jax.tree.map(np.asarray, candidates)
    tips, opposing = np.asarray(hand.tips, float), np.asarray(hand.opposing, float)
    wraps = tips[1:].mean(axis=0)
    costs = []
    for k in range(len(candidates.score)):
        thumb = p + R @ np.asarray(candidates.thumb[k])
        centre = p + R @ np.asarray(candidates.wrap[k]).mean(axis=0)
        axis = R @ np.asarray(candidates.axis[k])
        angle = min(
            np.arccos(np.clip(axis @ opposing, -1, 1)), np.arccos(np.clip(-axis @ opposing, -1, 1))
        )
        costs.append(
            np.linalg.norm(tips[0] - thumb)
            + np.linalg.norm(wraps - centre)
            + config.angle_weight * angle
            - config.score_weight * float(candidates.score[k])
            + abs(float(candidates.width[k]) - np.linalg.norm(tips[0] - wraps))
        )
    return np.array(costs)


@pytest.mark.parametrize("seed", range(4))
def test_minimum_of_the_written_objective(cylinder, seed):
    rng = np.random.default_rng(seed)
    hand, (p, R) = _hand(rng), _pose(rng, height=1.0)  # far above the table: no rejections
    targets, _ = select(cylinder, start_selection(cylinder, hand, R), hand, p, R, CONFIG)
    costs = _costs(cylinder, hand, np.asarray(p), R, CONFIG)
    admissible = np.asarray(cylinder.score) >= CONFIG.min_score
    best = np.where(admissible, costs, np.inf)
    assert bool(targets.valid)
    assert best[int(targets.candidate)] <= best.min() + 1e-5
    np.testing.assert_allclose(float(targets.cost), best.min(), atol=1e-5)


def test_targets_are_contacts_spread_across_the_reach_direction(cylinder):
    rng = np.random.default_rng(1)
    hand, (p, R) = _hand(rng), _pose(rng)
    state = start_selection(cylinder, hand, R)
    targets, state = select(cylinder, state, hand, p, R, CONFIG)
    k = int(targets.candidate)
    local = (np.asarray(targets.position) - np.asarray(p)) @ np.asarray(R)
    np.testing.assert_allclose(local[0], cylinder.thumb[k], atol=1e-6)
    np.testing.assert_allclose(local[1:].mean(axis=0), cylinder.centre[k], atol=1e-6)
    assert np.linalg.norm(local[1] - local[2]) == pytest.approx(0.04, abs=1e-6)
    # Along unit(u × g), u the object axis nearest to the palm's approach.
    u = np.eye(3)[np.argmax(np.abs(np.asarray(R).T @ np.asarray(hand.approach)))]
    across = np.cross(u, cylinder.axis[k])
    if np.linalg.norm(across) >= 0.1:
        line = (local[1] - local[2]) / 0.04
        assert abs(line @ across / np.linalg.norm(across)) == pytest.approx(1.0, abs=1e-5)
    # The first wrap's target is on the side of the first wrap.
    towards = np.asarray(hand.tips[1] - hand.tips[2])
    assert np.asarray(targets.position[1] - targets.position[2]) @ towards >= 0


def test_moving_the_world_moves_the_targets(cylinder):
    rng = np.random.default_rng(2)
    hand, (p, R) = _hand(rng), _pose(rng)
    turn = so3.exp(jnp.asarray([0.0, 0.0, 1.1]))
    shift = jnp.asarray([0.2, -0.1, 0.0])
    moved = HandPose(hand.tips @ turn.T + shift, turn @ hand.approach, turn @ hand.opposing)
    first, _ = select(cylinder, start_selection(cylinder, hand, R), hand, p, R, CONFIG)
    p2, R2 = turn @ p + shift, turn @ R
    second, _ = select(cylinder, start_selection(cylinder, moved, R2), moved, p2, R2, CONFIG)
    assert int(first.candidate) == int(second.candidate)
    np.testing.assert_allclose(second.position, first.position @ turn.T + shift, atol=1e-5)
    np.testing.assert_allclose(second.normal, first.normal @ turn.T, atol=1e-5)


def test_low_contacts_are_rejected(cylinder):
    rng = np.random.default_rng(3)
    hand = _hand(rng)
    p, R = jnp.asarray([0.5, 0.0, 0.06]), jnp.eye(3)  # upright on the table
    targets, _ = select(cylinder, start_selection(cylinder, hand, R), hand, p, R, CONFIG)
    k = int(targets.candidate)
    heights = np.concatenate([cylinder.thumb[k][None], cylinder.wrap[k], targets.position - p])
    assert np.all(heights[:, 2] + 0.06 >= CONFIG.targets.min_height - 1e-6)


def test_no_admissible_candidate_is_a_result_of_its_own(cylinder):
    rng = np.random.default_rng(4)
    hand = _hand(rng)
    p, R = jnp.asarray([0.5, 0.0, -1.0]), jnp.eye(3)  # under the table
    targets, state = select(cylinder, start_selection(cylinder, hand, R), hand, p, R, CONFIG)
    assert not bool(targets.valid)
    assert int(targets.candidate) == NONE == int(state.candidate)
    assert np.isinf(float(targets.cost)) and np.isfinite(targets.position).all()
    # It recovers when the object comes back.
    back, _ = select(cylinder, state, hand, jnp.asarray([0.5, 0.0, 0.2]), R, CONFIG)
    assert bool(back.valid)


def test_low_scores_and_invalid_candidates_are_rejected(cylinder):
    rng = np.random.default_rng(5)
    hand, (p, R) = _hand(rng), _pose(rng, 1.0)
    state = start_selection(cylinder, hand, R)
    k = int(select(cylinder, state, hand, p, R, CONFIG)[0].candidate)
    for other in (
        cylinder._replace(score=cylinder.score.at[k].set(0.01)),
        cylinder._replace(valid=cylinder.valid.at[k].set(False)),
    ):
        assert int(select(other, state, hand, p, R, CONFIG)[0].candidate) != k


def test_hysteresis_keeps_and_leaves(cylinder):
    rng = np.random.default_rng(6)
    hand, (p, R) = _hand(rng), _pose(rng, 1.0)
    state = start_selection(cylinder, hand, R)
    best = float(select(cylinder, state, hand, p, R, CONFIG)[0].cost)
    costs = _costs(cylinder, hand, np.asarray(p), R, CONFIG)
    costs = np.where(np.asarray(cylinder.score) >= CONFIG.min_score, costs, np.inf)
    near = int(np.argmin(np.abs(costs - best - 0.5 * CONFIG.hysteresis)))
    far = int(np.argmin(np.abs(costs - best - 2.0 * CONFIG.hysteresis)))
    for running, kept in ((near, True), (far, False)):
        again, _ = select(
            cylinder, state._replace(candidate=jnp.int32(running)), hand, p, R, CONFIG
        )
        assert (int(again.candidate) == running) == kept


def test_wraps_swap_only_for_a_clear_improvement(cylinder):
    rng = np.random.default_rng(7)
    hand, (p, R) = _hand(rng), _pose(rng, 1.0)
    targets, state = select(cylinder, start_selection(cylinder, hand, R), hand, p, R, CONFIG)
    along = np.asarray(targets.position[1] - targets.position[2]) / 0.04
    normal = np.cross(along, [0.3, 0.5, 0.8])
    normal /= np.linalg.norm(normal)
    middle = np.asarray(hand.tips[1:]).mean(axis=0)
    # Just past a right angle the order stays, well past it it turns round.
    for angle, swapped in ((0.5 * np.pi + 0.05, False), (0.5 * np.pi + 0.3, True)):
        direction = np.cos(angle) * along + np.sin(angle) * normal
        tips = np.stack([hand.tips[0], middle + 0.02 * direction, middle - 0.02 * direction])
        turned = hand._replace(tips=jnp.asarray(tips, jnp.float32))
        now, _ = select(cylinder, state, turned, p, R, CONFIG)
        assert int(now.candidate) == int(targets.candidate)
        same = np.asarray(now.position[1] - now.position[2]) @ along > 0
        assert same != swapped


def test_batched_is_looped_and_jit_is_eager(cylinder):
    rng = np.random.default_rng(8)
    worlds = [(_hand(rng), *_pose(rng)) for _ in range(16)]

    def one(hand, p, R):
        return select(cylinder, start_selection(cylinder, hand, R), hand, p, R, CONFIG)[0]

    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *worlds)
    together = jax.jit(jax.vmap(one))(*stacked)
    for k, world in enumerate(worlds):
        alone = one(*world)
        assert int(alone.candidate) == int(together.candidate[k])
        np.testing.assert_allclose(alone.position, together.position[k], atol=1e-6)


@pytest.fixture(scope="module")
def mesh_heatmap():
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=32).subdivide_to_size(0.02)
    return compute_heatmap(mesh.vertices, mesh.faces, np.zeros(3), SPAN, 0.5)


def test_closed_form_cylinder_is_the_heatmap_of_its_mesh(mesh_heatmap):
    radius, half = 0.03, 0.06
    from_mesh = jax.tree.map(np.asarray, from_heatmap(mesh_heatmap))
    closed = cylinder_candidates(jnp.float32(radius), jnp.float32(half), SPAN, around=64, along=31)
    closed = jax.tree.map(np.asarray, closed)
    found = 0
    for k in range(len(from_mesh.score)):
        p = from_mesh.thumb[k]
        on_side = np.hypot(p[0], p[1]) > radius - 1e-4 and abs(p[2]) < half - 0.03
        if not on_side or from_mesh.score[k] < 0.3:
            continue
        near = int(np.argmin(np.linalg.norm(closed.thumb - p, axis=1)))
        if np.linalg.norm(closed.thumb[near] - p) > 0.0025:
            continue
        found += 1
        assert closed.score[near] == pytest.approx(from_mesh.score[k], abs=0.12)
        assert closed.axis[near] @ from_mesh.axis[k] > 0.99
        assert closed.width[near] == pytest.approx(from_mesh.width[k], abs=2e-3)
    assert found > 20


def test_best_of_a_heatmap_are_taken_and_filled_up(mesh_heatmap):
    few = from_heatmap(mesh_heatmap, count=10)
    assert np.all(np.diff(np.asarray(few.score)) <= 0)
    assert float(few.score[0]) == pytest.approx(float(np.max(mesh_heatmap.score)))
    many = from_heatmap(mesh_heatmap, count=len(mesh_heatmap.score) + 5)
    assert not np.any(many.valid[-5:])
    with pytest.raises(InputError, match="count"):
        from_heatmap(mesh_heatmap, count=0)
    for wrong in (np.nan, -0.1):
        with pytest.raises(InputError, match="score: found 'NaN, infinity"):
            vertex_candidates(mesh_heatmap, jnp.full(len(mesh_heatmap.score), wrong))


@pytest.mark.parametrize("count", [None, 40])
def test_candidates_that_tie_keep_the_order_of_their_vertices(mesh_heatmap, count):
    vertices = len(mesh_heatmap.score)
    steps = np.random.default_rng(0).integers(0, 4, vertices).astype(np.float32)
    valid = np.arange(vertices) % 5 != 0
    heatmap = mesh_heatmap._replace(valid=jnp.asarray(valid))
    found = jax.jit(partial(from_heatmap, count=count))(heatmap, jnp.asarray(steps))
    order = np.argsort(-np.where(valid, steps, 0), kind="stable")[:count]
    np.testing.assert_array_equal(found.thumb, np.asarray(heatmap.thumb)[order])
    np.testing.assert_array_equal(found.valid, valid[order])
    np.testing.assert_array_equal(found.score, np.where(valid, steps, 0)[order])


@pytest.fixture(scope="module")
def flat_heatmap():
    """Of a box that is best held from above and below, where it lies on a table."""
    mesh = trimesh.creation.box((0.07, 0.08, 0.035)).subdivide_to_size(0.008)
    found = compute_heatmap(mesh.vertices, mesh.faces, np.zeros(3), SPAN, 0.1)
    return found._replace(score=found.score * (0.2 + 0.8 * jnp.abs(found.axis[:, 2])))


def _directions(axes):
    """The nearest of the 26 of a cube, as whole numbers."""
    grid = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1
    unit = grid / np.linalg.norm(grid, axis=1, keepdims=True)
    return [tuple(grid[k]) for k in np.argmax(np.asarray(axes) @ unit.T, axis=1)]


def test_each_direction_has_its_turn_with_its_best_first(flat_heatmap):
    everything = vertex_candidates(flat_heatmap)
    order = np.asarray(jax.jit(evenly_over_directions)(everything))
    scored = np.asarray(everything.valid & (everything.score > 0))
    assert sorted(order) == list(range(len(order)))
    assert np.all(np.diff(scored[order].astype(int)) <= 0), "those without a score come last"
    order = order[: scored.sum()]
    score, directions = np.asarray(everything.score)[order], _directions(everything.axis[order])
    several = len(set(directions))
    assert several >= 6
    assert len(set(directions[:several])) == several
    turns = [directions[:k].count(directions[k]) for k in range(len(order))]
    assert np.all(np.diff(turns) >= 0)
    for direction in set(directions):
        own = score[[d == direction for d in directions]]
        assert np.all(np.diff(own) <= 0)


@pytest.mark.long
def test_an_object_on_its_best_faces_has_candidates_among_the_rest(flat_heatmap):
    lying, config = (jnp.asarray([0.5, 0.0, 0.0175]), jnp.eye(3)), TargetConfig()

    def to_be_had(candidates):
        options = target_options(candidates, config)
        return np.asarray(options.candidate)[admissible(candidates, options, *lying, config)]

    best, mixed = from_heatmap(flat_heatmap, count=96), first_and_rest(flat_heatmap, None, 64, 96)
    assert len(to_be_had(best)) == 0
    assert len(to_be_had(mixed)) > 0 and np.all(to_be_had(mixed) >= 64)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:64], b[:64]), mixed, best)
    assert np.all(np.asarray(mixed.score[64:]) == 0) and np.all(mixed.valid)
    places = np.concatenate([mixed.thumb, mixed.axis], axis=1)
    assert len(np.unique(places.round(6), axis=0)) == 96, "none twice"


def test_of_a_small_mesh_there_are_as_many_as_there_are(flat_heatmap):
    """None twice, none of those that the score says nothing of before the others, the rest void."""
    scored = np.asarray(flat_heatmap.valid & (flat_heatmap.score > 0))
    near = scored & (np.arange(len(scored)) % 3 == 0)
    score, sizes = jnp.asarray(near, jnp.float32), (len(scored), 2 * len(scored))
    found = first_and_rest(flat_heatmap, score, *sizes)
    again = first_and_rest(flat_heatmap, score, *sizes, rest_scored=True)
    jax.tree.map(np.testing.assert_array_equal, again, found)
    assert int(found.valid.sum()) == scored.sum()
    np.testing.assert_array_equal(found.score[: near.sum()], 1.0)
    np.testing.assert_array_equal(found.score[near.sum() :], 0.0)
    kept = np.asarray(found.thumb)[np.asarray(found.valid)]
    assert sorted(map(tuple, kept)) == sorted(map(tuple, np.asarray(flat_heatmap.thumb)[scored]))


def test_from_an_anchor_to_targets_in_one_jitted_tick(mesh_heatmap):
    """Nothing goes through the host, and each part gives what it gives alone."""
    rng = np.random.default_rng(9)
    hand, (p, R) = _hand(rng), _pose(rng, height=0.2)

    def tick(heatmap, anchor, hand, p, R):
        candidates = from_heatmap(heatmap, steer(heatmap, anchor), count=64)
        state = start_selection(candidates, hand, R)
        return candidates, select(candidates, state, hand, p, R, CONFIG)[0]

    anchor = jnp.asarray([0.03, 0.0, 0.03])
    candidates, targets = jax.jit(tick)(mesh_heatmap, anchor, hand, p, R)
    apart, alone = tick(mesh_heatmap, anchor, hand, p, R)
    np.testing.assert_allclose(candidates.score, apart.score, rtol=1e-6)
    assert bool(targets.valid) and int(targets.candidate) == int(alone.candidate)
    np.testing.assert_allclose(targets.position, alone.position, atol=1e-6)
