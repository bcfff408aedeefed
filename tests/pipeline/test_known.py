"""What a grasp has to know of an object: its candidates, by default and near an anchor."""

from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.grasp.candidates import first_and_rest
from mjx_grasp.grasp.targets import admissible, target_options
from mjx_grasp.heatmap.compute import heatmap_of
from mjx_grasp.heatmap.meshes import heatmap_of_mesh
from mjx_grasp.objects.model import load_objects
from mjx_grasp.pipeline import known as known_module
from mjx_grasp.pipeline.assemble import whole_grasps
from mjx_grasp.pipeline.known import (
    CANDIDATES,
    LEVERED,
    STEERED_AT_LEAST,
    STEERED_CANDIDATES,
    STEERED_SCORE,
    check_graspable,
    known_object,
    known_objects,
    steered_candidates,
    steered_scores,
)


@pytest.mark.parametrize("upside", [1.0, -1.0])
def test_a_flat_can_on_its_face_has_contacts_at_its_side_that_the_hand_can_use(robot, upside):
    """Its best contacts, and most of all others, are too near the table."""
    (can,) = load_objects(("tuna_fish_can",))
    candidates, targets = known_object(can, robot).candidates, whole_grasps().selection.targets
    R_wo = jnp.diag(jnp.array([1.0, upside, upside]))
    p_wo = jnp.array([0.5, 0.0, -float((upside * can.mesh.vertices[:, 2]).min())])
    options = target_options(candidates, targets)
    usable = np.asarray(options.candidate)[admissible(candidates, options, p_wo, R_wo, targets)]
    around = np.linalg.norm(np.asarray(candidates.axis)[usable, :2], axis=1) > 0.9
    assert len(np.unique(usable[around])) > 10


@pytest.mark.long
def test_objects_are_known_together_as_one_by_one_and_of_the_best_candidates(robot):
    objects = load_objects(["rubiks_cube", "tuna_fish_can"])
    for obj, found in zip(objects, known_objects(objects, robot), strict=True):
        alone = known_object(obj, robot)
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), found, alone)
        # The heatmap's own choice, without what sizes are filled up with.
        heatmap = heatmap_of(obj, robot.hand)
        plain = first_and_rest(heatmap, None, CANDIDATES - CANDIDATES // 4, CANDIDATES)
        ours = alone.candidates
        kept = np.asarray(ours.valid)
        assert kept.sum() == plain.valid.sum() and not np.asarray(ours.score)[~kept].any()
        np.testing.assert_allclose(ours.thumb[kept], plain.thumb[plain.valid])
        np.testing.assert_allclose(ours.score[kept], plain.score[plain.valid], atol=1e-6)


@pytest.mark.wrong_types
def test_a_heatmap_of_something_else_and_scores_of_another_are_refused(robot, tmp_path):
    brick, can = load_objects(["foam_brick", "tuna_fish_can"])
    heatmap = heatmap_of(brick, robot.hand)
    with pytest.raises(InputError, match=r"heatmap: .* one of tuna_fish_can in the object frame"):
        known_object(can, robot, heatmap)
    with pytest.raises(InputError, match=r"score: found 'shape \(3,\)', expected one of each"):
        known_object(brick, robot, heatmap, np.ones(3))
    elsewhere = brick.mesh.copy()
    elsewhere.apply_translation([0.5, 0.2, 1.0])
    grip = robot.hand.span, robot.hand.scoring_friction
    stored = heatmap_of_mesh("brick", elsewhere, grip).heatmap
    with pytest.raises(InputError, match="heatmap: found 'one of a surface from"):
        known_object(brick, robot, stored)


def test_a_bowls_wall_may_be_gripped_at_two_heights(robot):
    """As it stands, the finger inside is higher. What has no thin wall has no such candidate."""
    bowl, brick = load_objects(["bowl", "foam_brick"])
    heatmap = heatmap_of(bowl, robot.hand)
    steered = known_object(bowl, robot, heatmap, heatmap.score)
    for known, count in ((known_object(bowl, robot), CANDIDATES), (steered, STEERED_CANDIDATES)):
        further = jax.tree.map(lambda leaf, count=count: np.asarray(leaf)[count:], known.candidates)
        assert len(further.score) == LEVERED and further.valid.sum() > 30
        stands = jax.tree.map(lambda leaf: leaf[::4], further)  # the first of four ways up
        wraps = stands.wrap.mean(axis=1)
        higher = stands.thumb[:, 2] - wraps[:, 2]
        out = np.sum(stands.axis[:, :2] * stands.thumb[:, :2], axis=1)  # the thumb is inside
        upright = stands.valid & (np.abs(stands.axis[:, 2]) < 0.8)
        assert upright.sum() > 5 or known is steered
        assert np.all(np.sign(higher[upright]) == np.sign(out[upright]))
        assert np.all(np.abs(higher[upright]) > 0.005)
    assert not np.asarray(known_object(brick, robot).candidates.valid)[CANDIDATES:].any()


@pytest.mark.wrong_types
def test_steered_scores_count_from_half_of_the_best_and_no_fewer_than_some():
    heatmap = SimpleNamespace(valid=jnp.arange(200) != 3)
    few = jnp.exp(-0.2 * jnp.arange(200.0)).at[3].set(5.0)
    scaled = np.asarray(steered_scores(heatmap, few))
    assert (scaled[np.arange(200) != 3] >= STEERED_SCORE).sum() == STEERED_AT_LEAST[0]
    assert scaled.max() == 1 and (np.diff(np.delete(scaled, 3)) <= 0).all()
    many = jnp.linspace(0.2, 0.1, 200)
    np.testing.assert_allclose(steered_scores(heatmap, many), many / 0.2, rtol=1e-6)
    assert not np.any(steered_scores(heatmap, jnp.zeros(200)))
    # Where there are fewer, they keep their order, however many have none.
    scored = jnp.where((jnp.arange(200) < 21) & heatmap.valid, few, 0.0)
    scaled = np.asarray(steered_scores(heatmap, scored))
    assert (scaled >= STEERED_SCORE).sum() == 20 and len(np.unique(scaled[scaled < 1])) > 3


class _Seen(NamedTuple):
    """What candidates are made of."""

    thumb: jax.Array
    normals: jax.Array
    wrap: jax.Array
    wrap_normals: jax.Array
    axis: jax.Array
    width: jax.Array
    score: jax.Array
    valid: jax.Array


@pytest.mark.wrong_types
def test_most_of_a_steered_grasps_candidates_are_the_anchors_best(monkeypatch):
    monkeypatch.setattr(known_module, "STEERED_CANDIDATES", 16)
    monkeypatch.setattr(known_module, "STEERED_AT_LEAST", (1,))
    n, some = 40, jnp.arange(40)
    points = jnp.stack([some, 0 * some, 0 * some], axis=1).astype(jnp.float32)
    wrap = jnp.broadcast_to(points[:, None], (n, 2, 3))
    own = jnp.linspace(0.1, 1.0, n)  # the anchor is at the other end
    heatmap = _Seen(points, points, wrap, wrap, points, jnp.ones(n), own, some != 39)
    found = steered_candidates(heatmap, own[::-1] ** 40)
    chosen = np.asarray(found.thumb[:, 0]).astype(int)
    assert chosen.tolist() == [*range(12), *range(38, 34, -1)] and np.all(found.valid)
    assert found.score[0] == 1 and np.all(np.diff(found.score[:12]) < 0)
    rest = np.asarray(found.score[12:])
    assert np.all(rest < found.score[11]) and np.all(np.diff(rest) > 0), "the nearer, the higher"


def test_an_object_that_can_be_grasped_nowhere_is_refused_by_name_with_the_hands_span(robot):
    check_graspable("a mug", 0.1, robot.hand)
    with pytest.raises(InputError, match=r"object: found 'crate\.stl', expected one with a place"):
        check_graspable("crate.stl", 0.0, robot.hand)
