import jax
import numpy as np
import pytest
from made_up import made_up

from mjx_grasp.heatmap.steering import steer, steer_near

HEATMAP = made_up(np.full(50, 0.81), seed=3)


def segment_distance(point, start, end):
    t = np.linspace(0, 1, 20_001)[:, None]
    return np.linalg.norm(start + t * (end - start) - point, axis=1).min()


@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_distance_to_the_segment_between_the_contacts(seed):
    anchor = np.random.default_rng(seed).uniform(-0.1, 0.1, 3)
    expected = [
        0.9 * np.exp(-((segment_distance(anchor, HEATMAP.thumb[k], HEATMAP.centre[k]) / 0.03) ** 2))
        for k in range(50)
    ]
    assert np.allclose(steer_near(HEATMAP, np.float32(anchor), 0.03), expected, atol=1e-5)


def test_between_the_contacts_it_is_the_publications_score_and_nowhere_more():
    between = HEATMAP.thumb + 0.4 * (HEATMAP.centre - HEATMAP.thumb)
    for k in range(10):
        near, line = (np.asarray(f(HEATMAP, between[k], 0.03)) for f in (steer_near, steer))
        assert near[k] == pytest.approx(line[k], rel=1e-6)
        assert np.all(near <= line + 1e-7)


def test_a_grasp_in_line_but_far_away_loses_its_score():
    anchor = HEATMAP.thumb[0] + np.float32([0, 0, 0.1])
    assert steer(HEATMAP, anchor, 0.03)[0] > 0.89
    assert steer_near(HEATMAP, anchor, 0.03)[0] < 1e-4


def test_many_anchors_are_a_vmap():
    anchors = np.random.default_rng(0).uniform(-0.05, 0.05, (6, 3)).astype(np.float32)
    many = jax.vmap(lambda a: steer_near(HEATMAP, a, 0.02))(anchors)
    for row, anchor in zip(many, anchors, strict=True):
        assert np.allclose(row, steer_near(HEATMAP, anchor, 0.02), atol=1e-7)
