"""A training with a reward term of your own, logged by its name.

    python examples/own_reward.py FOLDER [ITERATIONS [WORLDS]]

Goes on from the shipped policy, on a stand-in of the Rubik's cube in native MuJoCo; two minutes
with the default of 20 iterations, too few to learn much. `FOLDER/metrics.csv` has a column
`reward/gentle`.
"""

import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
from jaxtyping import Array, Float
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.tasks.rewards import Moment, RewardTerm
from mjx_grasp.training.config import preset_config
from mjx_grasp.training.job import run_training


def pressing(moment: Moment) -> Float[Array, "*b"]:
    """How much harder than 3 N the fingers press, mean over the fingers [N]."""
    force = jnp.linalg.norm(moment.truth.finger_force, axis=-1)
    return jnp.mean(jnp.maximum(force - 3.0, 0.0), axis=-1)


def main(folder: Path, iterations: int = 20, worlds: int = 128) -> None:
    """Trains with the rewards of the preset `cpu` and a price on pressing hard."""
    config = preset_config("cpu")
    config = replace(
        config,
        out=folder,
        handoffs=asset_path("handoffs_standins.npz"),
        evaluation_episodes=0,
        ppo=replace(config.ppo, iterations=iterations, worlds=worlds),
    )
    run_training(config, Console(stderr=True), extra_terms=(RewardTerm("gentle", -0.2, pressing),))


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
