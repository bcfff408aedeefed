import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.closing import stages
from mjx_grasp.closing.config import GripConfig, LiftConfig, StageConfig


@pytest.mark.parametrize("fingers", range(8))
@pytest.mark.parametrize("tick, late", [(1, False), (159, False), (160, True), (399, True)])
def test_lift_begins_with_three_fingers_or_late_with_two(fingers, tick, late):
    touching = jnp.array([bool(fingers & 1 << f) for f in range(3)])
    count = int(touching.sum())
    expected = count == 3 or (late and count >= 2)
    assert bool(stages.lift_begins(touching, tick * jnp.float32(0.01), StageConfig())) == expected


@given(
    height=st.floats(0.05, 0.3),
    speed=st.floats(0.05, 0.3),
    share=st.floats(0.05, 1.0),
    delay=st.floats(0.0, 1.0),
)
def test_trapezoid_covers_the_height_after_its_delay(height, speed, share, delay):
    config = LiftConfig(
        height=height, speed=speed, ramp_s=share * height / speed * 0.999, delay_s=delay
    )
    duration = height / speed + config.ramp_s + delay
    time = np.linspace(0, duration + 0.5, 20001)
    v = np.asarray(stages.lift_speed(jnp.asarray(time, jnp.float32), config))
    assert v.min() >= 0 and v.max() <= speed * (1 + 1e-6)
    np.testing.assert_allclose(np.trapezoid(v, time), height, rtol=1e-3)
    assert (v[time > duration + 1e-3] == 0).all() and (v[time < delay - 1e-3] == 0).all()


def test_published_lift_summed_over_ticks():
    config = LiftConfig(delay_s=0.0)
    v = np.asarray(stages.lift_speed(jnp.arange(400) * 0.01, config))
    np.testing.assert_allclose(v.sum() * 0.01, 0.15, rtol=1e-4)
    np.testing.assert_allclose(v[20:100], 0.15, rtol=1e-5)
    np.testing.assert_allclose(v[10], 0.075, rtol=1e-4)
    assert np.abs(np.diff(v)).max() <= 0.15 / 20 + 1e-5  # no jump


def test_lift_without_ramp_still_covers_the_height():
    config = LiftConfig(ramp_s=0.0)
    v = np.asarray(stages.lift_speed(jnp.arange(400) * 0.01, config))
    np.testing.assert_allclose(v.sum() * 0.01, 0.15, atol=0.15 * 0.01 + 1e-6)


def test_the_grip_ramps_over_half_a_second():
    time = jnp.array([0, 0.1, 0.25, 0.5, 0.51, 4.0])
    share = stages.grip_share(time, GripConfig(force=3.0))
    np.testing.assert_allclose(share, [0, 0.2, 0.5, 1, 1, 1], rtol=1e-5)
