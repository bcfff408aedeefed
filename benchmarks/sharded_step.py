"""A physics step of MJX on several devices, the smallest that shows whether XLA can compile it.

With JAX 0.11.2, MuJoCo MJX 3.17.0 and Warp 1.18.0 it ends in a segmentation fault inside
`backend_compile_and_load` where XLA partitions with Shardy, its default, on two H100s as on CPUs as
devices; with `--no-shardy` it says what it has computed, as it does with JAX 0.10.2. (On CPUs the
process may then hang or abort while it exits.) Trainings on several devices switch Shardy off for
that reason (`mjx_grasp/learning/devices.py`).

On GPUs it also shows which of MuJoCo Warp's ways to keep CUDA graphs bear several devices
(`--graph`). On two H100s, without Shardy, NONE and WARP do. WARP_STAGED ends with "Failed to update
graph memcpy batch: invalid argument" (MuJoCo issue 3191), and WARP_STAGED_EX, which is reported to
work there, with "Failed to run input memcpy batch: invalid argument"; the other device then waits
for ever. Trainings use WARP, MJX's default.

  XLA_FLAGS=--xla_force_host_platform_device_count=4 JAX_PLATFORMS=cpu \
    python -X faulthandler benchmarks/sharded_step.py
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from jax.sharding import Mesh, PartitionSpec
from mujoco import mjx
from mujoco.mjx.warp.types import GraphMode

from mjx_grasp.cli import run_command
from mjx_grasp.records.settings import CommandSettings, Count

SCENE = """
<mujoco><worldbody>
  <body><joint type="free"/><geom type="sphere" size="0.1" mass="1"/></body>
  <body pos="0 0 -1"><geom type="box" size="5 5 0.1"/></body>
</worldbody></mujoco>
"""


@dataclass(frozen=True)
class StepConfig(CommandSettings):
    """How to compile it."""

    shardy: bool = True
    """whether XLA partitions with Shardy"""
    devices: Count = 2
    worlds: Count = 4
    """of each device [-]"""
    graph: Literal["NONE", "WARP", "WARP_STAGED", "WARP_STAGED_EX"] | None = None
    """how CUDA graphs are captured and kept; None: MJX's default, the only way on CPUs"""
    steps: Count = 8
    """one after the other, as graphs are captured at first and then used again [-]"""


def main(config: StepConfig) -> None:
    """Compiles a step and runs it some times."""
    jax.config.update("jax_use_shardy_partitioner", config.shardy)
    model = mujoco.MjModel.from_xml_string(SCENE)
    graph = None if config.graph is None else getattr(GraphMode, config.graph)
    on_device = mjx.put_model(model, impl="warp", graph_mode=graph)
    split = PartitionSpec("devices")
    mesh = Mesh(np.array(jax.devices()[: config.devices]), ("devices",))

    def stepped(qpos: jax.Array) -> jax.Array:
        data = mjx.make_data(model, impl="warp", naconmax=16 * config.worlds, njmax=32)
        data = jax.vmap(lambda q: data.replace(qpos=q))(qpos)
        return jax.vmap(mjx.step, in_axes=(None, 0))(on_device, data).qpos

    step = jax.shard_map(stepped, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
    qpos = jnp.tile(jnp.asarray(model.qpos0), (config.devices * config.worlds, 1))
    jitted = jax.jit(step)
    for _ in range(config.steps):
        qpos = jitted(qpos)
    apart = float(jnp.ptp(qpos, axis=0).max())  # all begin alike
    print(f"JAX {jax.__version__}: {qpos.shape}, worlds up to {apart:g} apart", flush=True)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(StepConfig, description=__doc__)), keeps=False)
