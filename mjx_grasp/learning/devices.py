"""The worlds of a training over several devices, and over several hosts.

Every device has worlds of its own and the same weights. What each computes of its worlds, gradients
first of all, is averaged over the devices with JAX's collectives. A state of worlds that is spread
has one more axis in front: the device.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import Array

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import CommandSettings, Count, WholeNumber

AXIS = "devices"


@dataclass(frozen=True)
class RunOn(CommandSettings):
    """What a training runs on; a resumed one may run on something else."""

    devices: Count | Literal["auto"] = "auto"
    """devices that share the worlds; auto: all GPUs, or one CPU"""
    coordinator: str | None = None
    """HOST:PORT of the first of several processes that train together, on hosts that share the
    run's folder; auto within SLURM or Open MPI, which also know the next two"""
    processes: Count | None = None
    """how many processes these are [-]"""
    process: WholeNumber | None = None
    """which of them this one is, from 0 [-]"""
    donate: bool | None = None
    """whether an iteration's worlds take the memory of those before; None: on one device alone,
    since MJX was reported to hang on several (MuJoCo issue 2980)"""


@dataclass(frozen=True)
class Devices:
    """The devices that a training runs on; one, without a mesh, by default."""

    mesh: Mesh | None = None
    donates: bool = True
    """whether an iteration may take the memory of the state that it is given"""

    @property
    def count(self) -> int:
        """How many."""
        return 1 if self.mesh is None else int(self.mesh.devices.size)

    @property
    def axis(self) -> str | None:
        """Name of the axis for collectives; None where there is nothing to collect."""
        return None if self.mesh is None else AXIS

    @property
    def writes(self) -> bool:
        """Whether this process is the one that writes files and talks."""
        return jax.process_index() == 0

    def each(
        self, function: Callable[[Any, Any], tuple[Any, Any]]
    ) -> Callable[[Any, Any], tuple[Any, Any]]:
        """`function(common, own) → (common, own)`, run by every device on what is its own.

        Args:
            function: What is common has to come out alike on every device.
        """
        if self.mesh is None:
            return function

        def on_one(common: Any, own: Any) -> tuple[Any, Any]:
            common, own = function(common, jax.tree.map(lambda x: x[0], own))
            return common, jax.tree.map(lambda x: x[None], own)

        split = PartitionSpec(), PartitionSpec(AXIS)
        return jax.shard_map(
            on_one, mesh=self.mesh, in_specs=split, out_specs=split, check_vma=False
        )

    def own_key(self, key: Array) -> Array:
        """Of a common key one for each device; the key itself where there is one device."""
        return key if self.axis is None else jax.random.fold_in(key, jax.lax.axis_index(self.axis))

    def mean(self, tree: Any) -> Any:
        """Mean over the devices."""
        return tree if self.axis is None else jax.lax.pmean(tree, self.axis)

    def sum(self, tree: Any) -> Any:
        """Sum over the devices."""
        return tree if self.axis is None else jax.lax.psum(tree, self.axis)

    def that_of_most(self, tree: Any, amount: Array) -> Any:
        """What the device with the largest amount has."""
        if self.axis is None:
            return tree
        most = jnp.argmax(jax.lax.all_gather(amount, self.axis))
        mine = jax.lax.axis_index(self.axis) == most
        return jax.tree.map(
            lambda x: jax.lax.psum(jnp.where(mine, x, jnp.zeros_like(x)), self.axis), tree
        )

    def joined(self, tree: Any) -> Any:
        """The worlds of all devices one after the other: [devices, w, ...] to [worlds, ...]."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)

    def split(self, tree: Any) -> Any:
        """The reverse of `joined`."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda x: x.reshape(self.count, -1, *x.shape[1:]), tree)

    @property
    def everywhere(self) -> Sharding:
        """Where that is which all devices have."""
        if self.mesh is None:
            return SingleDeviceSharding(jax.devices()[0])
        return NamedSharding(self.mesh, PartitionSpec())

    def common(self, tree: Any) -> Any:
        """Arrays of this process as those that every device has."""
        if self.mesh is None:
            return tree
        return jax.device_put(jax.tree.map(np.asarray, tree), self.everywhere)

    def first(self, tree: Any) -> Any:
        """What this process's first device has as its own."""
        if self.mesh is None:
            return tree
        return jax.tree.map(lambda x: x.addressable_data(0)[0], tree)

    def agreed(self, *flags: bool) -> tuple[bool, ...]:
        """What the process that writes thinks, told to all."""
        if jax.process_count() == 1:
            return flags
        told = multihost_utils.broadcast_one_to_all(np.array(flags))
        return tuple(bool(flag) for flag in told)

    def wait(self, name: str) -> None:
        """Until every process has come here."""
        if jax.process_count() > 1:
            multihost_utils.sync_global_devices(name)

    def part(self) -> None:
        """Ends what joins several processes, which all have to call this: each is alone then.

        JAX stops all that do not end within minutes of each other, while one may still evaluate.
        """
        if jax.process_count() > 1:
            jax.distributed.shutdown()


ONE_DEVICE = Devices()


def join_hosts(run_on: RunOn) -> None:
    """Joins the processes that train together, before JAX computes anything; one has no others.

    Raises:
        InputError: The processes do not find each other.
    """
    if run_on.coordinator is None:
        for name in ("processes", "process"):
            if getattr(run_on, name) is not None:
                raise InputError(f"--{name}", getattr(run_on, name), "a --coordinator beside it")
        return
    address = None if run_on.coordinator == "auto" else run_on.coordinator
    try:
        jax.distributed.initialize(address, run_on.processes, run_on.process)
    except (ValueError, RuntimeError) as error:
        what = f"{run_on.coordinator} ({str(error).strip().splitlines()[0]})"
        expected = "HOST:PORT with --processes and --process, or auto within SLURM or Open MPI"
        raise InputError("--coordinator", what, expected) from error


def find_devices(run_on: RunOn) -> Devices:
    """The devices of a training.

    Raises:
        InputError: There are not so many as are wanted.
    """
    available, several = jax.devices(), jax.process_count() > 1
    usual = len(available) if several or jax.default_backend() == "gpu" else 1
    count = usual if run_on.devices == "auto" else run_on.devices
    if count > len(available) or (several and count != len(available)):
        here = f"{count} ({len(available)} {jax.default_backend()} device(s) here)"
        most = f"{len(available)}" if several else f"at most {len(available)}"
        raise InputError("--devices", here, f"{most}, or auto")
    mesh = None
    if count > 1:
        # With its default partitioner XLA of JAX 0.11 crashes on a physics step of MJX.
        jax.config.update("jax_use_shardy_partitioner", False)
        mesh = Mesh(np.array(available[:count]), (AXIS,))
    return Devices(mesh, mesh is None if run_on.donate is None else run_on.donate)


def check_even(worlds: int, minibatches: int, devices: Devices) -> None:
    """Makes sure that worlds are split evenly over devices, and on each over minibatches.

    Raises:
        InputError: They cannot be.
    """
    if worlds % (devices.count * minibatches):
        multiple = f"a multiple of {devices.count} devices × {minibatches} minibatches"
        raise InputError("--ppo.worlds", worlds, multiple)
