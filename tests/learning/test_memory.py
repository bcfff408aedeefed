import pytest

from mjx_grasp.learning import memory
from mjx_grasp.learning.config import PPOConfig

GIB = 2**30


@pytest.fixture(scope="module")
def per_world(scene):
    return memory.bytes_per_world(scene, 16)


def test_a_world_takes_more_with_a_longer_rollout(scene, per_world):
    assert memory.bytes_per_world(scene, 64) - per_world == pytest.approx(
        48 * (memory.bytes_per_world(scene, 17) - per_world), rel=1e-6
    )
    assert 10_000 < per_world < 10_000_000


@pytest.mark.parametrize("gib", [1, 2, 5, 16, 80])
def test_worlds_fit_and_are_a_power_of_two(scene, per_world, gib):
    worlds = memory.worlds_that_fit(scene, PPOConfig(worlds=2**30, unroll=16), gib * GIB)
    assert worlds & (worlds - 1) == 0 and worlds % PPOConfig.minibatches == 0
    assert worlds * per_world <= 0.8 * gib * GIB < 2 * worlds * per_world


def test_bounds_on_both_sides(scene):
    assert memory.worlds_that_fit(scene, PPOConfig(worlds=12), 10**15) == 12
    for minibatches in (4, 32):
        ppo = PPOConfig(unroll=16, minibatches=minibatches, worlds=minibatches)
        assert memory.worlds_that_fit(scene, ppo, 1) == minibatches


@pytest.mark.parametrize("devices", [1, 2, 3, 5, 7])
@pytest.mark.parametrize("gib", [1, 80])
def test_worlds_are_even_whatever_the_devices(scene, devices, gib):
    ppo = PPOConfig(worlds=8192, minibatches=16)
    worlds = memory.worlds_that_fit(scene, ppo, gib * GIB, devices)
    assert worlds % (devices * ppo.minibatches) == 0 and 0 < worlds <= ppo.worlds
    if gib == 80:
        assert worlds > ppo.worlds - devices * ppo.minibatches, "no more is given up than must be"


def test_device_memory_is_plausible():
    assert 2**28 < memory.device_memory() < 2**42
