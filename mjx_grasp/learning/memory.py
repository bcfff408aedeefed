"""How many worlds a device's memory holds, from the sizes of the arrays a training needs."""

from __future__ import annotations

import math

import jax

from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.sim.mjx_engine import warp_bytes_per_world
from mjx_grasp.sim.scene import Scene

_COPIES = 2
"""MuJoCo Warp's arrays, and about as much again that it and XLA keep meanwhile."""
_TRANSITION_NUMBERS = 900
"""Numbers kept of a control step: two observations for actor and critic, actions, forces, flags."""


def bytes_per_world(scene: Scene, unroll: int) -> int:
    """Device memory of one world of a training [bytes]: physics and its rollout."""
    return _COPIES * warp_bytes_per_world(scene) + 4 * _TRANSITION_NUMBERS * unroll


def worlds_that_fit(scene: Scene, ppo: PPOConfig, memory_bytes: int, devices: int = 1) -> int:
    """The worlds that are asked for, or as many as fit, evenly over devices and minibatches.

    What fits on a device is the power of two that four fifths of its memory hold.
    """
    fit = int(0.8 * memory_bytes / bytes_per_world(scene, ppo.unroll))
    each = min(ppo.worlds // devices, 2 ** int(math.log2(max(fit, ppo.minibatches))))
    return devices * max(each - each % ppo.minibatches, ppo.minibatches)


def device_memory() -> int:
    """Memory of JAX's first device [bytes]; the machine's own where JAX does not say."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return int(stats["bytes_limit"])
    import os

    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
