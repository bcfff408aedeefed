"""A training so small that a test can run it, also as a script that a test can kill.

python tiny_training.py FOLDER ITERATIONS [SECONDS_PER_ITERATION]
"""

import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import handmade
import jax
import jax.numpy as jnp
import numpy as np

from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.checkpoint import checkpoints, restore_checkpoint
from mjx_grasp.learning.config import PPOConfig
from mjx_grasp.learning.ppo import init_state
from mjx_grasp.learning.run import LoopConfig, Member, train_together
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise
from mjx_grasp.tasks.starts import build_starts

CONFIG = {"made": "by hand"}


def ppo(iterations=2, **changes):
    values = dict(worlds=4, unroll=4, iterations=iterations, epochs=2, minibatches=2, hidden=(8, 8))
    return PPOConfig(**(values | changes))


def make_env(worlds=4, stagger=True, extra_terms=()):
    """One box, native engine, episodes of ten ticks, so that resets happen in every rollout."""
    scene, handoffs = handmade.box_handoffs_scene()
    physics = NativePhysics(scene, threads=1)
    starts = build_starts(scene, handoffs, physics.substeps)
    config = ClosingTaskConfig(episode_s=0.1)
    task = ClosingTask(physics, starts, config, StartNoise(), extra_terms=extra_terms)
    return BraxTask(task, worlds, stagger)


def parameters(state):
    """All that a training learns or draws from, as one vector."""
    leaves = jax.tree.leaves((state.params, state.optimizer, state.normalizer, state.key))
    return np.concatenate([np.asarray(x, np.float64).ravel() for x in leaves])


def train_loop(folder, state, env, settings, loop, run_config):
    """One training by itself."""
    (state,) = train_together([Member(folder, state, run_config)], env, settings, loop)
    return state


class Slow(BraxTask):
    """Takes its time, so that a test can kill the training between two iterations."""

    def __init__(self, inner, seconds):
        super().__init__(inner.task, inner.worlds, inner._stagger)
        self._seconds = seconds

    def step(self, state, action):
        def wait(x):
            time.sleep(self._seconds)
            return x

        shape = jax.ShapeDtypeStruct(action.shape, jnp.float32)
        return super().step(state, jax.pure_callback(wait, shape, action))


def main(folder, iterations, seconds):
    folder.mkdir(parents=True, exist_ok=True)
    env = Slow(make_env(), seconds)
    state = init_state(ppo(iterations), env, seed=3)
    done = checkpoints(folder / "checkpoints")
    if done:
        state, _ = restore_checkpoint(done[-1], state, env)
    print(json.dumps({"from": int(state.iteration)}), flush=True)
    state = train_loop(folder, state, env, ppo(iterations), LoopConfig(checkpoint_every=1), CONFIG)
    np.save(folder / "parameters.npy", parameters(state))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 0.0)
