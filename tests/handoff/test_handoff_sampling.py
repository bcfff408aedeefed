from types import SimpleNamespace

import numpy as np
import pytest

from mjx_grasp.handoff.config import SamplingConfig
from mjx_grasp.handoff.sampling import draw_candidates, poses_at_rest, sample_object_poses
from mjx_grasp.objects.resting import RestingPose

RESTING = [
    RestingPose(np.array([1.0, 0, 0, 0]), 0.08, 0.6),
    RestingPose(np.array([0.5, 0.5, 0.5, 0.5]), 0.03, 0.2),
]


def test_object_poses_rest_in_the_object_area_by_probability():
    config = SamplingConfig()
    position, quat = sample_object_poses(RESTING, 4000, config, np.random.default_rng(0))
    for axis, (low, high) in enumerate((config.area.x, config.area.y)):
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


@pytest.mark.wrong_types
def test_a_share_of_the_poses_stands_as_scanned():
    can = SimpleNamespace(
        resting=tuple(RESTING),
        mesh=SimpleNamespace(bounds=np.array([[-1, -1, -0.12], [1, 1, 0.12]])),
    )
    assert poses_at_rest(can, 0.0) == can.resting
    upright, *fallen = poses_at_rest(can, 0.25)
    assert np.array_equal(upright.quat, [1, 0, 0, 0]) and upright.height == 0.12
    assert [pose.probability for pose in fallen] == pytest.approx([0.75 * 0.75, 0.25 * 0.75])
    assert upright.probability == 0.25
    assert sum(pose.probability for pose in poses_at_rest(can, 1.0)[1:]) == 0


def test_candidates_prefer_scores_and_keep_their_distance():
    rng = np.random.default_rng(0)
    thumb = rng.uniform(0, 0.1, (800, 3))
    score = rng.random(800)
    area, allowed = np.ones(800), rng.random(800) < 0.5
    config = SamplingConfig(candidates_per_pose=10, min_distance=0.01)
    drawn = [draw_candidates(score, area, thumb, allowed, config, rng) for _ in range(50)]
    for chosen in drawn:
        assert len(chosen) == len(set(chosen)) == 10 and allowed[chosen].all()
        gaps = np.linalg.norm(thumb[chosen, None] - thumb[chosen], axis=-1)
        assert gaps[~np.eye(10, dtype=bool)].min() >= 0.01
    every = np.concatenate(drawn)
    assert score[every].mean() > score[allowed].mean() + 0.1
    assert len(set(every)) > 100
    assert len(draw_candidates(score, area, thumb, np.zeros(800, bool), config, rng)) == 0
    assert len(draw_candidates(score, area, 0 * thumb, allowed, config, rng)) == 1


def test_a_surface_in_smaller_pieces_is_not_drawn_more_often():
    # One half of a plate with ten times as many candidates as the other.
    rng = np.random.default_rng(1)
    x = np.concatenate([rng.uniform(-0.5, 0.0, 100), rng.uniform(0.0, 0.5, 1000)])
    thumb = np.stack([x, rng.uniform(0, 1, 1100), np.zeros(1100)], axis=1)
    area = np.where(x < 0, 0.5 / 100, 0.5 / 1000)
    score, allowed = np.full(1100, 0.5), np.ones(1100, bool)
    config = SamplingConfig(candidates_per_pose=1)
    drawn = [draw_candidates(score, area, thumb, allowed, config, rng)[0] for _ in range(600)]
    assert np.mean(x[drawn] < 0) == pytest.approx(0.5, abs=0.08)
