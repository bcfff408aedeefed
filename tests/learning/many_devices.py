"""Trainings on several CPU devices, as a script: a process chooses its devices only once.

python many_devices.py OUT.npz            four devices of one process
python many_devices.py OUT.npz homing     a checkpoint of two of them, of a task without physics
python many_devices.py OUT.npz closing    the same of the closing task
python many_devices.py FOLDER COUNT ITERATIONS   the same task on so many, from where FOLDER is
python many_devices.py FOLDER HOST:PORT PROCESSES PROCESS ITERATIONS
"""

import os
import sys
from pathlib import Path

if __name__ == "__main__":
    # XLA has a thread for each. Twice as many as are used, because a thread that waits for other
    # devices is not there for the callbacks of the engine.
    count = 8 if len(sys.argv) < 5 else 1
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={count}"
    os.environ["XLA_FLAGS"] = flags

sys.path.insert(0, str(Path(__file__).resolve().parent))

import jax
import numpy as np
import test_any_task
import tiny_training as tiny
from jax.sharding import Mesh

from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.checkpoint import checkpoints, restore_checkpoint, save_checkpoint
from mjx_grasp.learning.devices import AXIS, ONE_DEVICE, Devices, RunOn, find_devices, join_hosts
from mjx_grasp.learning.ppo import init_state, make_iteration
from mjx_grasp.learning.run import LoopConfig


class Twins(Devices):
    """Devices that draw the same numbers."""

    def own_key(self, key):
        return key


def devices_of(count, kind=Devices):
    return ONE_DEVICE if count == 1 else kind(Mesh(np.array(jax.devices()[:count]), (AXIS,)))


def trained(env, config, iterations=3):
    """States, the first one included, and metrics."""
    states, metrics = [init_state(config, env, seed=0)], []
    iterate = jax.jit(make_iteration(config, env))
    for _ in range(iterations):
        state, row = iterate(states[-1])
        states.append(state)
        metrics.append({name: float(x) for name, x in row.items()})
    assert iterate._cache_size() == 1, "the second iteration compiled again"
    return states, metrics, iterate


def weights(state):
    return np.concatenate([np.asarray(x).ravel() for x in jax.tree.leaves(state.params)])


def homing(count, worlds, kind=Devices, task=test_any_task.Homing, stagger=True, **changes):
    config = tiny.ppo(worlds=worlds, unroll=8, hidden=(16,), privileged_critic=False, **changes)
    env = BraxTask(task(), worlds // count, stagger, devices_of(count, kind))
    return trained(env, config)


def homing_env(count):
    return BraxTask(test_any_task.Homing(), 8 // count, True, devices_of(count))


def closing_env(count):
    task = tiny.make_env(worlds=8 // count).task
    return BraxTask(task, 8 // count, True, devices_of(count))


def four_devices(out):
    """What the tests look at."""
    found = {}
    twins, lone = homing(2, 16, Twins)[0][-1], homing(1, 8)[0][-1]
    found["twins"], found["lone"] = weights(twins), weights(lone)
    found["counts"] = [int(s.normalizer.count.lo) for s in (twins, lone)]

    states, metrics, _ = homing(4, 64, epochs=4, learning_rate=1e-2)
    copies = [x.addressable_shards for x in jax.tree.leaves(states[-1].params)]
    found["copies"] = np.array(
        [np.concatenate([np.asarray(c[k].data).ravel() for c in copies]) for k in range(4)]
    )
    found["places"] = np.asarray(states[0].env.pipeline_state.place)
    found["reward"] = [row["reward"] for row in metrics]
    found["terms"] = [row["reward/near"] + row["reward/effort"] for row in metrics]
    found["episodes"] = metrics[0]["episodes"]
    rate = states[-1].optimizer[-1].hyperparams["learning_rate"]
    found["rates"] = [float(shard.data) for shard in rate.addressable_shards]

    paced = {"task": test_any_task.PacedHoming, "stagger": False}
    states, metrics, _ = homing(4, 16, iterations=3, **paced)
    found["told"] = np.asarray(states[-1].env.pipeline_state.told)
    found["logged"] = [metrics[-1][name] for name in test_any_task.PacedHoming.pace_names]

    np.savez(out, **found)


def checkpoints_of(out, env_of):
    """A checkpoint of two devices, read back on one, two and four."""
    found = {}
    config = tiny.ppo(worlds=8, privileged_critic=env_of is closing_env)
    env = env_of(2)
    states, _, iterate = trained(env, config)
    path = save_checkpoint(Path(out).parent / "checkpoints", states[2], env, tiny.CONFIG)
    found["kept"] = weights(states[2])
    found["unbroken"] = weights(states[3])
    found["stood"] = worlds_of(env, states[2])
    for count in (1, 2, 4):
        env = env_of(count)
        state, goes_on = restore_checkpoint(path, init_state(config, env, seed=9), env)
        found[f"goes_on_{count}"] = goes_on
        found[f"kept_{count}"] = weights(state)
        found[f"stood_{count}"] = worlds_of(env, state)
        if count == 2:
            found["resumed"] = weights(iterate(state)[0])
        if count == 4:
            state, row = jax.jit(make_iteration(config, env))(state)
            found["after"] = [int(state.iteration), float(row["total_loss"])]
    np.savez(out, **found)


def worlds_of(env, state):
    """All that is packed of the worlds, one row each."""
    leaves = jax.tree.leaves(env.pack(state.env)["task"])
    return np.concatenate([np.asarray(x, float).reshape(8, -1) for x in leaves], axis=1)


def goes_on(folder, count, iterations):
    """A training in the loop with its files, every iteration kept."""
    config = tiny.ppo(iterations, worlds=8, privileged_critic=False)
    env = homing_env(count)
    state, kept = init_state(config, env, seed=0), checkpoints(folder / "checkpoints")
    if kept:
        state, stood = restore_checkpoint(kept[-1], state, env)
        print("from", int(state.iteration), stood, flush=True)
    tiny.train_loop(folder, state, env, config, LoopConfig(checkpoint_every=1), tiny.CONFIG)


def processes(folder, coordinator, count, process, iterations):
    """A training of processes with a device each, in the loop with its files."""
    run_on = RunOn("auto", coordinator, count, process)
    join_hosts(run_on)
    config = tiny.ppo(iterations, worlds=8)
    devices = find_devices(run_on)
    env = BraxTask(tiny.make_env(8 // devices.count).task, 8 // devices.count, True, devices)
    state = init_state(config, env, seed=3)
    kept = checkpoints(folder / "checkpoints")
    if kept:
        state, goes_on = restore_checkpoint(kept[-1], state, env)
        print("from", int(state.iteration), goes_on, flush=True)
    state = tiny.train_loop(folder, state, env, config, LoopConfig(checkpoint_every=1), tiny.CONFIG)
    np.save(folder / f"weights_{process}.npy", weights(state))


if __name__ == "__main__":
    if len(sys.argv) == 2:
        four_devices(sys.argv[1])
    elif len(sys.argv) == 3:
        checkpoints_of(sys.argv[1], {"homing": homing_env, "closing": closing_env}[sys.argv[2]])
    elif len(sys.argv) == 4:
        goes_on(Path(sys.argv[1]), *map(int, sys.argv[2:]))
    else:
        processes(Path(sys.argv[1]), sys.argv[2], *map(int, sys.argv[3:]))
