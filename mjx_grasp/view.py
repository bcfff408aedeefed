"""`python -m mjx_grasp.view`: a heatmap in the browser, with an anchor to drag.

Takes a mesh (metres) or the .npz of a heatmap. Needs the extra `viewer` (viser).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
import tyro
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.errors import InputError
from mjx_grasp.geometry.mesh import principal_frame
from mjx_grasp.heatmap import compute_heatmap
from mjx_grasp.heatmap.files import HeatmapInfo, StoredHeatmap, load_heatmap
from mjx_grasp.language.grounding import Target, target_of
from mjx_grasp.objects.folder import catalogue_entry
from mjx_grasp.objects.meshes import read_mesh
from mjx_grasp.objects.refine import refined
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.viewer import Viewer, import_viser
from mjx_grasp.viz.viewer_state import Settings


@dataclass(frozen=True)
class ViewConfig:
    """What to show."""

    mesh: tyro.conf.Positional[Path]
    """A mesh (.obj, .ply, .stl, .glb, .off; metres) or the .npz of a heatmap."""
    anchor: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Where the anchor starts [m]; without one the default heatmap is shown first."""
    sigma: float = 0.030
    """How near to the anchor a grasp's axis should pass [m]."""
    triples: int = 3
    """How many of the best grasp triples to draw."""
    span: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MIN MAX")] = None
    """Narrowest and widest grasp [m]; the shipped hand's by default."""
    friction: float | None = None
    """Scoring friction [-]; the shipped hand's by default."""
    edge: float = 0.010
    """Longest edge [m]: candidates are vertices, so coarse meshes are refined to it; 0 keeps the
    mesh as it is."""
    host: str = "127.0.0.1"
    """Address to serve on; 0.0.0.0 lets other machines in."""
    port: int = 8080
    """Port to serve on; the next free one if it is taken."""

    def __post_init__(self):
        if not 1 <= self.port <= 65535:
            raise InputError("--port", self.port, "a port, 1 to 65535")


def load(config: ViewConfig) -> tuple[StoredHeatmap, Target]:
    """The heatmap to show and its object, computed if a mesh was given.

    Raises:
        FileError: The file is neither.
    """
    if config.mesh.suffix.lower() == ".npz":
        stored = load_heatmap(config.mesh)
        mesh = trimesh.Trimesh(np.asarray(stored.heatmap.vertices), stored.faces, process=False)
        return stored, target_of(stored.info.name, mesh, catalogue_entry(stored.info.name))
    mesh = refined(read_mesh(config.mesh)[0], config.edge)
    hand = load_robot().hand
    span = config.span or hand.span
    friction = config.friction or hand.scoring_friction
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    name = config.mesh.stem
    with Console(stderr=True).status(f"computing the heatmap of {name}"):
        heatmap = compute_heatmap(vertices, faces, None, span, friction)
    x, y, z = (float(c) for c in principal_frame(vertices, faces).centre)
    stored = StoredHeatmap(heatmap, faces, HeatmapInfo(name, span, friction, (x, y, z)))
    return stored, target_of(name, mesh, catalogue_entry(name))


def main(config: ViewConfig) -> None:
    """Serves until it is interrupted."""
    import_viser()  # a missing extra is an error before anything long
    settings = Settings(config.anchor, config.sigma, triples=config.triples)
    viewer = Viewer(*load(config), settings, config.host, config.port)
    print(f"{viewer.url} shows {viewer.target.name}; Ctrl-C ends it", flush=True)
    try:
        while True:
            time.sleep(1.0)
    finally:
        viewer.close()


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(ViewConfig, description=__doc__)))
