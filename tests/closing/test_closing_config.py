import pytest

from mjx_grasp.closing.config import ClosingConfig, StartNoise
from mjx_grasp.errors import InputError


def test_defaults_are_the_published_task():
    c = ClosingConfig()
    assert (c.control_dt, c.episode_s, c.episode_ticks) == (0.01, 4.0, 400)
    assert (c.finger_action_rate, c.arm_action_rate) == (5.0, 0.15)
    assert (c.reach_weight, c.contact_weight, c.lift_weight) == (3.0, 1.0, 2.0)
    assert (c.action_rate_weight, c.action_acceleration_weight) == (-0.01, -0.005)
    assert (c.success_height, c.success_hold_s, c.success_slip) == (0.10, 0.5, 0.03)
    assert (c.grip_force, c.grip_ramp_s, c.acquisition_s) == (1.0, 0.5, 1.6)


@pytest.mark.parametrize(
    "field, value",
    [
        ("control_dt", 0.0),
        ("control_dt", float("nan")),
        ("episode_s", -1.0),
        ("episode_s", 0.001),
        ("lift_speed", 0.0),
        ("grip_force", -0.1),
        ("residual_keep", 1.1),
        ("lift_ramp_s", 1.1),
    ],
)
def test_impossible_tasks_are_refused_by_name(field, value):
    with pytest.raises(InputError, match=rf"ClosingConfig\.{field}|ClosingConfig\.episode_s"):
        ClosingConfig(**{field: value})


@pytest.mark.parametrize(
    "field, value",
    [
        ("offset_m", -0.001),
        ("offset_m", 5.0),
        ("angle_rad", 5.0),
        ("friction", (0.0, 0.8)),
        ("friction", (0.9, 0.8)),
        ("mass_scale", (0.0, 1.0)),
    ],
)
def test_impossible_noise_is_refused_by_name(field, value):
    with pytest.raises(InputError, match=rf"StartNoise\.{field}"):
        StartNoise(**{field: value})
