"""A picture with depth as files: from them and an instruction to an anchor, by a pointing model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float, UInt8
from PIL import Image, UnidentifiedImageError

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.geometry.so3 import quat_to_mat
from mjx_grasp.language.camera import PinholeCamera
from mjx_grasp.language.grounding import Anchor, Target, View
from mjx_grasp.language.pointing import LIMIT_M
from mjx_grasp.language.rex_omni import RexOmniConfig, RexOmniGrounder, build_prompt, check_ready
from mjx_grasp.objects.meshes import read_mesh
from mjx_grasp.records.atomic import check_replaceable, read_json, write_json
from mjx_grasp.records.settings import (
    CommandSettings,
    Finite,
    NonNegative,
    Positive,
    Settings,
    from_record,
)

SCHEMA = "mjx_grasp.anchor/1"
_CAMERA = (
    '{"fx", "fy", "cx", "cy": pixels, "camera", "object": '
    '{"position": [x, y, z], "quaternion": [w, x, y, z]} in the world, metres}'
)
_DEPTH = "a .npy of metres or a PNG of whole millimetres, as large as the picture"


@dataclass(frozen=True)
class Pose(Settings):
    """Of a frame in the world."""

    position: tuple[Finite, Finite, Finite]
    """its origin [m]"""
    quaternion: tuple[Finite, Finite, Finite, Finite]
    """w, x, y, z of its rotation"""

    def rotation(self, name: str) -> Float[np.ndarray, "3 3"]:
        """Its axes as columns.

        Raises:
            InputError: The quaternion is not of unit length.
        """
        length = float(np.linalg.norm(self.quaternion))
        if abs(length - 1.0) > 1e-3:
            raise InputError(f"{name}.quaternion", self.quaternion, "one of unit length")
        return np.asarray(quat_to_mat(jnp.array(self.quaternion) / length), np.float64)


@dataclass(frozen=True)
class CameraFile(Settings):
    """What a camera's file holds: intrinsics [pixels], and where camera and object are."""

    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    camera: Pose
    """x to the right, y down, z forward"""
    object: Pose
    """the frame of the mesh"""


@dataclass(frozen=True)
class GroundConfig(CommandSettings):
    """What is seen, and what is asked."""

    mesh: tyro.conf.Positional[Path]
    """the mesh of the object that is seen (.obj, .ply, .stl, .glb, .off; metres)"""
    instruction: str
    """where to grasp it, such as "by the handle" """
    image: Path
    """picture of it"""
    depth: Path
    """depth along the optical axis of every pixel: a .npy of metres, or a PNG of whole millimetres;
    0 where it was not measured"""
    camera: Path
    """JSON of the intrinsics and of the poses of camera and object, see docs/heatmaps.md"""
    weights: Path
    """folder of Rex-Omni's weights: yours to get, licensed for research"""
    device: Annotated[str, tyro.conf.arg(metavar="DEVICE")] = "auto"
    """PyTorch device; auto takes a GPU where there is one"""
    limit: NonNegative = LIMIT_M
    """how far beside the object a point may be [m]"""
    out: Path | None = None
    """JSON file to write the anchor to; only printed without one"""

    @property
    def model(self) -> RexOmniConfig:
        """Settings of the pointing model."""
        return RexOmniConfig(model=str(self.weights), device=self.device, limit=self.limit)


def ground_seen(config: GroundConfig) -> tuple[Anchor, Target]:
    """The anchor that an instruction means in a picture, in the frame of the mesh, and of what.

    Everything is read and checked before the weights are loaded.

    Raises:
        FileError: A file is missing or cannot be used, or there are no weights.
        InputError: The extra ``language`` is not installed.
        GroundingError: There is no place in the instruction, or the model points to nothing on the
            object.
    """
    if config.out is not None:
        check_replaceable("--out", config.out, [SCHEMA])
    target = read_target(config.mesh, config.image, config.depth, config.camera)
    build_prompt(config.instruction, target.name)  # an instruction without a place is refused
    check_ready(config.model)
    anchor = RexOmniGrounder.load(config.model).ground(config.instruction, target)
    if config.out is not None:
        found = {
            "schema": SCHEMA,
            "mesh": config.mesh.name,
            "instruction": config.instruction,
            "anchor_m": anchor.point.tolist(),
            "source": anchor.source,
        }
        write_json(config.out, found)
    return anchor, target


def read_target(mesh: Path, image: Path, depth: Path, camera: Path) -> Target:
    """A mesh and its view from files; see `GroundConfig`.

    Raises:
        FileError: One of them is missing, not of its kind, or does not fit the others.
    """
    shape, pixels = read_mesh(mesh), _read_image(image)
    height, width = pixels.shape[:2]
    metres = _read_depth(depth)
    if metres.shape != (height, width):
        found = f"a depth of {metres.shape[1]}×{metres.shape[0]} pixels"
        raise FileError(depth, found, f"one of {width}×{height}, as the picture has")
    try:
        said = from_record(CameraFile, read_json(camera, _CAMERA))
        pinhole = PinholeCamera(
            *(width, height, said.fx, said.fy, said.cx, said.cy),
            said.camera.rotation("camera"),
            np.array(said.camera.position),
        )
        R_wo = said.object.rotation("object")
    except (InputError, TypeError) as error:
        raise FileError(camera, f"no camera ({error})", _CAMERA) from None
    view = View(pixels, metres, pinhole, R_wo, np.array(said.object.position))
    return Target(mesh.stem, np.asarray(shape.vertices), np.asarray(shape.faces), view=view)


def _read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    return np.asarray(_open(path, "a picture").convert("RGB"))


def _read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    if path.suffix.lower() == ".npy":
        try:
            depth: Any = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FileError(path, f"nothing readable ({error})", _DEPTH) from None
        if depth.dtype.kind in "iu":
            raise FileError(path, f"whole numbers ({depth.dtype})", _DEPTH)
        scale = 1.0
    else:
        depth, scale = np.asarray(_open(path, _DEPTH)), 1e-3
        if depth.dtype == np.uint8:
            raise FileError(path, "8 bits of depth", _DEPTH)
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise FileError(path, f"{depth.dtype} of shape {depth.shape}", _DEPTH)
    return scale * depth.astype(np.float64)


def _open(path: Path, expected: str) -> Image.Image:
    try:
        picture = Image.open(path)
        picture.load()
    except FileNotFoundError:
        raise FileError(path, "no such file", expected) from None
    except (OSError, UnidentifiedImageError, SyntaxError, Image.DecompressionBombError) as error:
        raise FileError(path, f"nothing readable ({error})", expected) from None
    return picture
