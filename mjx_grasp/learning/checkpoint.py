"""Checkpoints of the whole training state, written atomically by Orbax.

A checkpoint has two parts: what has been learnt, which later versions of the package always read,
and the worlds as they stood, which they read as long as a world still has the same arrays. Where it
has not, the worlds start anew and the training goes on.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from mjx_grasp.errors import FileError
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.devices import Devices
from mjx_grasp.learning.ppo import TrainState, learner_of
from mjx_grasp.records.atomic import read_json, write_json

_MANIFEST = "manifest.json"
_VERSION = 3
"""1: one item `state` with everything, and a manifest of the files alone. 2: no mean of weights."""
_STEM = "iteration_"
_NAME = re.compile(rf"^{_STEM}(\d+)$")
_OWN = re.compile(rf"^{_STEM}\d+(\.orbax-checkpoint-tmp.*)?$")
"""Also while they are written."""


def save_checkpoint(
    folder: str | Path,
    state: TrainState,
    env: BraxTask,
    config: dict[str, Any],
    keep: int = 2,
) -> Path:
    """Writes `folder/iteration_N`, complete or not at all, and drops all but the newest `keep`.

    What a killed process has left of others is dropped too.

    Of several processes, which all have to call this, each writes what it has.

    Args:
        folder: Folder of the run's checkpoints.
        state: The training state, the environments' own included.
        env: Knows how to pack the environments.
        config: Configuration of the run, kept beside the arrays.
        keep: Checkpoints that stay.
    """
    folder = Path(folder).resolve()
    path = folder / f"{_STEM}{int(state.iteration):08d}"
    writes = env.devices.writes
    if path.exists() and writes:
        shutil.rmtree(path)
    env.devices.wait(f"before {path.name}")
    worlds = jax.jit(env.pack)(state.env)
    with ocp.Checkpointer(
        ocp.CompositeCheckpointHandler("learner", "worlds", "config")
    ) as checkpointer:  # writes to a temporary folder, then renames
        checkpointer.save(
            path,
            ocp.args.Composite(
                learner=ocp.args.StandardSave(learner_of(state)),
                worlds=ocp.args.StandardSave(worlds),
                config=ocp.args.JsonSave(config),
            ),
        )
    if writes:
        manifest = {"version": _VERSION, "worlds": _layout(worlds), "files": _digests(path)}
        write_json(path / _MANIFEST, manifest)
        kept = set(checkpoints(folder)[-keep:])
        for other in folder.iterdir():  # older ones, and what a kill has left
            if _OWN.match(other.name) and other.is_dir() and other not in kept:
                shutil.rmtree(other)
    env.devices.wait(f"after {path.name}")
    return path


def checkpoints(folder: str | Path) -> list[Path]:
    """Finished checkpoints of a run, oldest first; the manifest is written last."""
    numbered = []
    for path in Path(folder).iterdir() if Path(folder).is_dir() else ():
        match = _NAME.match(path.name)
        if match and (path / _MANIFEST).is_file():
            numbered.append((int(match[1]), path))
    return [path for _, path in sorted(numbered)]


def newest_checkpoint(folder: str | Path) -> Path | None:
    """The checkpoint to go on from, None if there is none yet.

    Raises:
        FileError: It is damaged; the message names the newest one that is not.
    """
    done = checkpoints(folder)
    if not done:
        return None
    _checked_manifest(done[-1])
    return done[-1]


def restore_checkpoint(
    path: str | Path, template: TrainState, env: BraxTask
) -> tuple[TrainState, bool]:
    """Reads a training state back.

    Args:
        path: A checkpoint folder, of this version or an older one.
        template: A state of the same configuration, for its structure, shapes and fresh worlds.
        env: Knows how to unpack the environments.

    Returns:
        The state, and whether its worlds go on where they stood; else they are the template's.

    Raises:
        FileError: The checkpoint is damaged or belongs to another configuration.
    """
    path = Path(path).resolve()
    manifest = _checked_manifest(path)
    try:
        version, like = manifest["version"], learner_of(template)
        if version < 3:
            del like["policy"]
        learner = _restored(path, "state" if version == 1 else "learner", like, env.devices)
        if version < 3:
            learner["policy"] = jax.tree.map(jnp.copy, learner["params"].policy)
    except Exception as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise FileError(
            path, f"a checkpoint that cannot be restored ({first[:200]})", "an undamaged checkpoint"
        ) from error
    worlds = jax.eval_shape(env.pack, template.env)
    if manifest.get("worlds") != _layout(worlds):
        return TrainState(**learner, env=template.env), False
    stood = _restored(path, "worlds", worlds, env.devices)
    return TrainState(**learner, env=jax.jit(env.unpack)(stood)), True


def _restored(path: Path, item: str, like: Any, devices: Devices) -> Any:
    """An item of a checkpoint in the form of `like`; what else it holds is left alone."""
    to = devices.everywhere
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=to), like)
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler(item)) as checkpointer:
        asked = ocp.args.PyTreeRestore(
            item=shapes,
            restore_args=ocp.checkpoint_utils.construct_restore_args(shapes),
            partial_restore=True,
        )
        return checkpointer.restore(path, ocp.args.Composite(**{item: asked}))[item]


def _layout(tree: Any) -> str:
    """SHA-256 of the names, shapes and types of a tree's arrays."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    rows = [f"{jax.tree_util.keystr(at)} {x.shape} {x.dtype}" for at, x in leaves]
    return hashlib.sha256("\n".join(rows).encode()).hexdigest()


def _digests(path: Path) -> dict[str, str]:
    """SHA-256 of every file of a checkpoint but the manifest; Orbax misses some flipped bits."""
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.name != _MANIFEST)
    return {
        p.relative_to(path).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files
    }


def _checked_manifest(path: Path) -> dict[str, Any]:
    """What an intact checkpoint says of itself.

    Raises:
        FileError: It is damaged, or newer than this package.
    """
    manifest, damage = _looked_at(path)
    if damage is None:
        return manifest
    others = [p for p in reversed(checkpoints(path.parent)) if p.name < path.name]
    intact = next((p for p in others if _looked_at(p)[1] is None), None)
    expected = "an undamaged checkpoint"
    if intact is not None:
        expected += f"; {intact.name} is intact: remove {path.name} to resume from there"
    raise FileError(path, damage, expected)


def _looked_at(path: Path) -> tuple[dict[str, Any], str | None]:
    """A checkpoint's manifest, and what is wrong with it; None if its files are as written."""
    try:
        manifest = read_json(path / _MANIFEST, "the checksums of a checkpoint")
        if "version" not in manifest:
            manifest = {"version": 1, "files": manifest}
        version, expected = int(manifest["version"]), dict(manifest["files"])
    except (FileError, ValueError, TypeError, KeyError) as error:
        return {}, f"no readable manifest ({error})"
    if version > _VERSION:
        return manifest, f"version {version}, which needs a newer package"
    found = _digests(path)
    changed = sorted(n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n))
    return manifest, f"damaged or missing files ({', '.join(changed[:3])})" if changed else None
