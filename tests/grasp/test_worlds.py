"""Thousands of worlds, each with its own object, against the written objective."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.grasp.candidates import from_heatmap
from mjx_grasp.grasp.config import SelectionConfig
from mjx_grasp.grasp.select import HandPose, select, start_selection
from mjx_grasp.grasp.targets import NONE
from mjx_grasp.heatmap.compute import compute_heatmap
from mjx_grasp.objects.parametric import stand_in

CONFIG = SelectionConfig()
SPAN = (0.02, 0.09)
OBJECTS = ("tomato_soup_can", "potted_meat_can", "banana")
COUNT = 1300
WORLDS, COMPARED = 2048, 100
ROUNDING = 1e-5


@pytest.fixture(scope="module")
def objects():
    """Candidates of several objects, the best ones or filled up, and stacked."""
    meshes = [stand_in(name) for name in OBJECTS]
    heatmaps = [compute_heatmap(m.vertices, m.faces, None, SPAN, 0.5) for m in meshes]
    candidates = [from_heatmap(h, count=COUNT) for h in heatmaps]
    assert min(len(h.score) for h in heatmaps) < COUNT
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *candidates)


@pytest.fixture(scope="module")
def worlds(objects):
    """Object numbers, hands and poses; some objects lie so low that contacts are rejected."""
    rng = np.random.default_rng(0)
    number = rng.integers(0, len(OBJECTS), WORLDS)
    p = rng.uniform((0.4, -0.2, -0.1), (0.7, 0.2, 0.15), (WORLDS, 3))
    R = jax.vmap(so3.exp)(jnp.asarray(rng.normal(scale=1.5, size=(WORLDS, 3)), jnp.float32))
    tips = p[:, None] + rng.normal(scale=0.08, size=(WORLDS, 3, 3))
    axes = np.linalg.qr(rng.normal(size=(WORLDS, 3, 3)))[0]
    hands = HandPose(*(jnp.asarray(a, jnp.float32) for a in (tips, axes[:, 0], axes[:, 1])))
    return jnp.asarray(number), hands, jnp.asarray(p, jnp.float32), R


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _written(c, hand, p, R):
    """Cost of each candidate, +inf for rejected ones, and how near each is to a rejection [m]."""
    tips, approach, opposing = (np.asarray(a, float) for a in hand)
    thumb, pair, axis = p + c.thumb @ R.T, p + c.wrap @ R.T, c.axis @ R.T
    centre = pair.mean(axis=1)
    # u is the object axis nearest to the palm's approach; the next one where it is along g.
    axes = R.T[np.argsort(-np.abs(approach @ R))]
    across = np.cross(axes[:, None], axis)
    usable = np.linalg.norm(across, axis=2) >= CONFIG.targets.min_axis_angle
    across = across[np.argmax(usable, axis=0), np.arange(len(axis))]
    side = 0.020 * _unit(np.where(c.valid[:, None], across, 1.0))
    touched = np.stack([thumb, pair[:, 0], pair[:, 1], centre + side, centre - side])
    room = touched[:, :, 2].min(axis=0) - 0.015
    wraps = tips[1:].mean(axis=0)
    cost = (
        np.linalg.norm(tips[0] - thumb, axis=1)
        + np.linalg.norm(wraps - centre, axis=1)
        + 0.1 * np.arccos(np.clip(np.abs(axis @ opposing), 0, 1))
        - 0.1 * c.score
        + 1.0 * np.abs(c.width - np.linalg.norm(tips[0] - wraps))
    )
    usable = c.valid & (c.score >= CONFIG.min_score)
    return np.where(usable & (room >= 0), cost, np.inf), np.where(usable, np.abs(room), np.inf)


@pytest.mark.long
def test_thousands_of_worlds_of_several_objects(objects, worlds):
    @partial(jax.vmap, in_axes=(None, 0, 0, 0, 0))
    def choose(objects, number, hand, p, R):
        candidates = jax.tree.map(lambda leaf: leaf[number], objects)
        return select(candidates, start_selection(candidates, hand, R), hand, p, R, CONFIG)[0]

    targets = jax.tree.map(np.asarray, jax.jit(choose)(objects, *worlds))
    assert targets.candidate.shape == (WORLDS,)
    apart = jax.tree.map(lambda leaf: np.asarray(leaf, float), objects)
    apart = apart._replace(valid=np.asarray(objects.valid))
    number, hands, p, R = jax.tree.map(lambda leaf: np.asarray(leaf), worlds)
    rejecting = without = 0
    for w in np.random.default_rng(1).choice(WORLDS, COMPARED, replace=False):
        candidates = jax.tree.map(lambda leaf, w=w: leaf[number[w]], apart)
        hand = jax.tree.map(lambda leaf, w=w: leaf[w], hands)
        cost, room = _written(candidates, hand, p[w].astype(float), R[w].astype(float))
        if not np.isfinite(cost).any():
            assert room.min() < ROUNDING or not targets.valid[w]
            without += not targets.valid[w]
            continue
        k = targets.candidate[w]
        # A contact on the border of a rejection may be on either side of it.
        best = np.where(room < ROUNDING, np.inf, cost).min()
        assert targets.valid[w] and k != NONE
        assert np.isfinite(cost[k]) or room[k] < ROUNDING
        assert targets.cost[w] <= best + ROUNDING
        if room[k] >= ROUNDING:
            assert cost[k] <= cost.min() + ROUNDING
            assert targets.cost[w] == pytest.approx(cost[k], abs=ROUNDING)
        rejecting += np.sum(np.isfinite(room)) > np.sum(np.isfinite(cost))
    assert rejecting > 0.2 * COMPARED and without > 0.02 * COMPARED
