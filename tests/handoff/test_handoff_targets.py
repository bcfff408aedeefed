import numpy as np
import pytest

from mjx_grasp.grasp.config import TargetConfig
from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.sampling import draw_candidates, sample_object_poses
from mjx_grasp.handoff.targets import closest_reach_axis, standoffs, target_variants
from mjx_grasp.objects.resting import RestingPose

CONFIG = TargetConfig()


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def candidates(n=50, seed=0):
    rng = np.random.default_rng(seed)
    return {
        "thumb": rng.normal(size=(n, 3)),
        "normal": unit(rng.normal(size=(n, 3))),
        "centre": rng.normal(size=(n, 3)),
        "axis": unit(rng.normal(size=(n, 3))),
        "wrap_normals": unit(rng.normal(size=(n, 2, 3))),
    }


def test_wraps_lie_across_grasp_axis_and_reach_axis():
    given = candidates()
    variants = target_variants(**given, config=CONFIG)
    thumb, first, second = np.moveaxis(variants.position, 2, 0)
    assert np.allclose(thumb, given["thumb"][:, None])
    assert np.allclose(0.5 * (first + second), given["centre"][:, None])
    spread = first - second
    assert np.allclose(np.linalg.norm(spread, axis=-1), 0.04)
    assert np.allclose(np.einsum("nvi,ni->nv", spread, given["axis"]), 0, atol=1e-12)
    for variant in range(6):
        assert np.allclose(spread[:, variant, variant // 2], 0, atol=1e-12)
    assert np.allclose(spread[:, ::2], -spread[:, 1::2])


def test_normals_are_the_thumbs_and_the_mean_of_the_wraps():
    given = candidates()
    normal = target_variants(**given, config=CONFIG).normal
    assert np.allclose(normal[:, 0], given["normal"])
    assert np.allclose(normal[:, 1], unit(given["wrap_normals"].sum(axis=1)))
    assert np.allclose(normal[:, 1], normal[:, 2])


def test_a_reach_axis_along_the_grasp_axis_is_not_usable():
    given = candidates(3)
    given["axis"] = unit(np.array([[1, 0, 0], [0.05, 0, 1], [0.3, 1, 0]]))
    usable = target_variants(**given, config=CONFIG).usable
    assert usable.tolist() == [
        [False, False, True, True, True, True],
        [True, True, True, True, False, False],
        [True] * 6,
    ]
    assert np.isfinite(target_variants(**given, config=CONFIG).position).all()


def test_standoffs_are_outside_by_25_and_40_mm():
    rng = np.random.default_rng(0)
    position, normal = rng.normal(size=(4, 6, 3, 3)), unit(rng.normal(size=(4, 1, 3, 3)))
    out = np.sum((standoffs(position, normal, CONFIG) - position) * normal, axis=-1)
    assert np.allclose(out, [0.025, 0.040, 0.040])


def test_the_reach_axis_is_the_nearest_to_the_palms_approach_that_can_be_used():
    approach = unit(np.array([[0.1, -0.2, -0.9], [0.1, -0.2, -0.9], [-0.8, 0.3, 0.1]]))
    usable = np.array([[True] * 6, [True] * 4 + [False] * 2, [True] * 6])
    assert closest_reach_axis(approach, usable).tolist() == [2, 1, 0]


RESTING = [
    RestingPose(np.array([1.0, 0, 0, 0]), 0.08, 0.6),
    RestingPose(np.array([0.5, 0.5, 0.5, 0.5]), 0.03, 0.2),
]


def test_object_poses_rest_in_the_object_area_by_probability():
    config = SamplingConfig()
    position, quat = sample_object_poses(RESTING, 4000, config, np.random.default_rng(0))
    for axis, (low, high) in enumerate((config.x_range, config.y_range)):
        assert position[:, axis].min() >= low and position[:, axis].max() <= high
        assert position[:, axis].mean() == pytest.approx((low + high) / 2, abs=0.02)
    upright = position[:, 2] == 0.08
    assert np.all(upright | (position[:, 2] == 0.03))
    assert upright.mean() == pytest.approx(0.75, abs=0.03)
    assert np.allclose(np.linalg.norm(quat, axis=1), 1)
    # A turn about the world's z leaves what points up: the object's z, or here its y when lying.
    w, x, y, z = quat.T
    z_up = 1 - 2 * (x * x + y * y)
    y_up = 2 * (y * z + w * x)
    assert np.allclose(z_up[upright], 1)
    assert np.allclose(y_up[~upright], 1)
    yaw = 2 * np.arctan2(quat[upright, 3], quat[upright, 0])
    yaw = np.mod(yaw, 2 * np.pi)
    assert np.histogram(yaw, bins=8, range=(0, 2 * np.pi))[0].min() > 0.8 * upright.sum() / 8


def test_candidates_prefer_scores_and_keep_their_distance():
    rng = np.random.default_rng(0)
    thumb = rng.uniform(0, 0.1, (800, 3))
    score = rng.random(800)
    allowed = rng.random(800) < 0.5
    config = SamplingConfig(candidates_per_pose=10, min_distance=0.01)
    drawn = [draw_candidates(score, thumb, allowed, config, rng) for _ in range(50)]
    for chosen in drawn:
        assert len(chosen) == len(set(chosen)) == 10 and allowed[chosen].all()
        gaps = np.linalg.norm(thumb[chosen, None] - thumb[chosen], axis=-1)
        assert gaps[~np.eye(10, dtype=bool)].min() >= 0.01
    every = np.concatenate(drawn)
    assert score[every].mean() > score[allowed].mean() + 0.1
    assert len(set(every)) > 100
    assert len(draw_candidates(score, thumb, np.zeros(800, bool), config, rng)) == 0
    assert len(draw_candidates(score, 0 * thumb, allowed, config, rng)) == 1
