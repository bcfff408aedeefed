"""A training by another library, skrl's PPO, on the closing task as a vector environment.

    pip install 'mjx_grasp[gym]' skrl
    python examples/gym_training.py FOLDER [ITERATIONS [WORLDS]]

Trains on a stand-in of the Rubik's cube in native MuJoCo; the default of 20 iterations is too few
to learn much. `FOLDER/policy.npz` is a policy as every other: `python -m mjx_grasp.evaluate
--policy` and `python -m mjx_grasp.export` take it.
"""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from flax import linen
from skrl.agents.jax.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.jax import wrap_env
from skrl.memories.jax import RandomMemory
from skrl.models.jax import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.jax import RunningStandardScaler
from skrl.trainers.jax import SequentialTrainer
from skrl.utils import set_seed

from mjx_grasp.gym import closing_vector_env
from mjx_grasp.learning.policy import Policy
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import to_record
from mjx_grasp.training.config import preset_config

UNROLL = 32  # ticks per iteration


class Actor(GaussianMixin, Model):
    """The mean of the actions, of what a robot measures."""

    def __init__(self, device=None, **spaces):
        Model.__init__(self, device=device, **spaces)
        GaussianMixin.__init__(self)

    @linen.compact
    def __call__(self, inputs, role):
        """Means, and the logarithms of standard deviations."""
        x = inputs["observations"]
        for units in (128, 128):
            x = linen.elu(linen.Dense(units)(x))
        small = linen.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        mean = linen.Dense(self.num_actions, kernel_init=small)(x)
        spread = self.param("log_std", lambda _: jnp.full(self.num_actions, jnp.log(0.15)))
        return mean, {"log_std": spread}


class Critic(DeterministicMixin, Model):
    """The value, of what only the simulator knows as well."""

    def __init__(self, device=None, **spaces):
        Model.__init__(self, device=device, **spaces)
        DeterministicMixin.__init__(self)

    @linen.compact
    def __call__(self, inputs, role):
        """Values."""
        x = inputs["states"]
        for units in (128, 128):
            x = linen.elu(linen.Dense(units)(x))
        return linen.Dense(1)(x), {}


def scaler(space):
    """A normaliser that clips nothing that occurs."""
    return {"size": space, "clip_threshold": 1e3}


def main(folder: Path, iterations: int = 20, worlds: int = 128) -> None:
    """Trains, and keeps the policy."""
    set_seed(0)
    config = preset_config("cpu")
    vector = closing_vector_env(worlds, config)
    env = wrap_env(vector, wrapper="gymnasium")
    spaces = {
        "observation_space": env.observation_space,
        "state_space": env.state_space,
        "action_space": env.action_space,
    }
    models = {"policy": Actor(**spaces), "value": Critic(**spaces)}
    for role, model in models.items():
        model.init_state_dict(role=role)
    cfg = PPO_CFG(
        rollouts=UNROLL,
        learning_epochs=5,
        mini_batches=4,
        learning_rate=3e-4,
        grad_norm_clip=1.0,
        value_loss_scale=1.0,
        rewards_shaper=lambda rewards, *_: 0.02 * rewards,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs=scaler(env.observation_space),
        state_preprocessor=RunningStandardScaler,
        state_preprocessor_kwargs=scaler(env.state_space),
    )
    cfg.experiment.directory, cfg.experiment.experiment_name = str(folder), "skrl"
    cfg.experiment.checkpoint_interval = 0  # none
    memory = RandomMemory(memory_size=UNROLL, num_envs=worlds)
    agent = PPO(models=models, memory=memory, cfg=cfg, **spaces)
    run = {"timesteps": iterations * UNROLL, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=run).train()

    path = folder / "policy.npz"
    meta = {
        "task": to_record(config.task),
        "noise": to_record(config.noise),
        "objects": list(config.objects),
        "env_steps": iterations * UNROLL * worlds,
        "provenance": provenance(seed=0),
    }
    as_policy(agent, meta, vector.task.physics.scene.robot.identity).save(path)
    print(f"written: {path}")


def as_policy(agent, meta, robot) -> Policy:
    """The actor and its normaliser in this package's form."""
    seen, layers = agent._observation_preprocessor, agent.policy.state_dict.params["params"]
    dense = [layers[f"Dense_{i}"] for i in range(3)]
    return Policy(
        mean=np.asarray(seen.running_mean, np.float32),
        std=np.sqrt(np.asarray(seen.running_variance, np.float32)) + 1e-8,
        weights=tuple(np.asarray(layer["kernel"], np.float32) for layer in dense),
        biases=tuple(np.asarray(layer["bias"], np.float32) for layer in dense),
        meta=meta,
        robot=robot,
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
