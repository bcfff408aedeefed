"""Checkpoints of the whole training state, written atomically by Orbax."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from mjx_grasp.errors import FileError
from mjx_grasp.learning.brax_env import BraxTask
from mjx_grasp.learning.ppo import TrainState
from mjx_grasp.records.atomic import replacing

_MANIFEST = "manifest.json"
_NAME = re.compile(r"^iteration_(\d+)$")


def save_checkpoint(
    folder: str | Path,
    state: TrainState,
    env: BraxTask,
    config: dict[str, Any],
    keep: int = 2,
) -> Path:
    """Writes `folder/iteration_N`, complete or not at all, and drops all but the newest `keep`.

    Args:
        folder: Folder of the run's checkpoints.
        state: The training state, the environments' own included.
        env: Knows how to pack the environments.
        config: Configuration of the run, kept beside the arrays.
        keep: Checkpoints that stay.
    """
    folder = Path(folder).resolve()
    path = folder / f"iteration_{int(state.iteration):08d}"
    if path.exists():
        shutil.rmtree(path)
    with ocp.Checkpointer(
        ocp.CompositeCheckpointHandler("state", "config")
    ) as checkpointer:  # writes to a temporary folder, then renames
        checkpointer.save(
            path,
            ocp.args.Composite(
                state=ocp.args.StandardSave(_packed(state, env)),
                config=ocp.args.JsonSave(config),
            ),
        )
    manifest = json.dumps(_digests(path), indent=1)
    with replacing(path / _MANIFEST) as temporary:
        temporary.write_text(manifest)
    for old in checkpoints(folder)[:-keep]:
        shutil.rmtree(old)
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
    _check_manifest(done[-1])
    return done[-1]


def restore_checkpoint(path: str | Path, template: TrainState, env: BraxTask) -> TrainState:
    """Reads a training state back.

    Args:
        path: A checkpoint folder.
        template: A state of the same configuration, for its structure and shapes.
        env: Knows how to unpack the environments.

    Raises:
        FileError: The checkpoint is damaged or belongs to another configuration.
    """
    path = Path(path).resolve()
    _check_manifest(path)
    like = jax.tree.map(ocp.utils.to_shape_dtype_struct, _packed(template, env))
    try:
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler("state", "config")) as checkpointer:
            packed = checkpointer.restore(
                path, ocp.args.Composite(state=ocp.args.StandardRestore(like))
            )["state"]
    except Exception as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise FileError(
            path, f"a checkpoint that cannot be restored ({first[:200]})", "an undamaged checkpoint"
        ) from error
    return TrainState(**(packed | {"env": env.unpack(packed["env"])}))


def _digests(path: Path) -> dict[str, str]:
    """SHA-256 of every file of a checkpoint but the manifest; Orbax misses some flipped bits."""
    files = sorted(p for p in path.rglob("*") if p.is_file() and p.name != _MANIFEST)
    return {
        p.relative_to(path).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files
    }


def _check_manifest(path: Path) -> None:
    damage = _damage(path)
    if damage is None:
        return
    others = [p for p in reversed(checkpoints(path.parent)) if p.name < path.name]
    intact = next((p for p in others if _damage(p) is None), None)
    expected = "an undamaged checkpoint"
    if intact is not None:
        expected += f"; {intact.name} is intact: remove {path.name} to resume from there"
    raise FileError(path, damage, expected)


def _damage(path: Path) -> str | None:
    """What is wrong with a checkpoint's files; None if they are as they were written."""
    try:
        expected = json.loads((path / _MANIFEST).read_text())
    except (OSError, ValueError) as error:
        return f"no readable manifest ({error})"
    found = _digests(path)
    changed = sorted(n for n in found.keys() | expected.keys() if found.get(n) != expected.get(n))
    return f"damaged or missing files ({', '.join(changed[:3])})" if changed else None


def _packed(state: TrainState, env: BraxTask) -> dict[str, Any]:
    return state._asdict() | {"env": env.pack(state.env)}
