"""What `view` serves: a stored heatmap, or one computed of a mesh, until it is interrupted."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import trimesh
from rich.console import Console

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.files import StoredHeatmap, load_heatmap
from mjx_grasp.heatmap.meshes import MeshConfig, heatmap_of_mesh
from mjx_grasp.language.grounding import Target, target_of
from mjx_grasp.objects.folder import MeshFile
from mjx_grasp.objects.meshes import read_mesh
from mjx_grasp.objects.parts import parts_of
from mjx_grasp.records.settings import Range
from mjx_grasp.viz.viewer import Viewer, import_viser
from mjx_grasp.viz.viewer_state import TripleCount, ViewerSettings


@dataclass(frozen=True)
class ViewConfig(MeshConfig):
    """What to show: of a mesh or of the .npz of a heatmap, with an anchor to drag."""

    triples: TripleCount = 3
    """how many of the best grasp triples to draw [-]"""
    host: str = "127.0.0.1"
    """address to serve on; 0.0.0.0 lets other machines in"""
    port: Annotated[int, Range(1, 65535)] = 8080
    """port to serve on; the next free one if it is taken"""


def serve(config: ViewConfig, say: Callable[[str], None]) -> None:
    """Serves the page, and waits.

    Args:
        config: What to show.
        say: Is told where the page is, once it is there.

    Raises:
        FileError: The file is neither a mesh nor a heatmap.
        InputError: The extra is not installed, or nothing can be served on the address.
    """
    import_viser()  # what is missing is an error before anything long
    check_host(config.host)
    settings = ViewerSettings(
        config.anchor, sigma=config.sigma, steering=config.steering, triples=config.triples
    )
    viewer = Viewer(*load(config), settings, config.host, config.port)
    say(f"{viewer.url} shows {viewer.target.name}; Ctrl-C ends it")
    try:
        while True:
            time.sleep(1.0)
    finally:
        viewer.close()


def load(config: ViewConfig) -> tuple[StoredHeatmap, Target]:
    """The heatmap to show and its object, computed if a mesh was given.

    Raises:
        FileError: The file is neither.
    """
    if config.mesh.suffix.lower() == ".npz":
        stored = load_heatmap(config.mesh)
        name = stored.info.name
        mesh = trimesh.Trimesh(np.asarray(stored.heatmap.vertices), stored.faces, process=False)
    else:
        name, mesh = config.mesh.stem, read_mesh(config.mesh)
        with Console(stderr=True).status(f"computing the heatmap of {name}"):
            stored = heatmap_of_mesh(name, mesh, config.grip(), config.heatmap)
    return stored, target_of(name, mesh, parts_of(MeshFile(name, config.mesh), mesh))


def check_host(host: str) -> None:
    """Makes sure that something can be served on an address.

    Raises:
        InputError: This machine does not have it.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        expected = "an address of this machine, such as 127.0.0.1 or 0.0.0.0"
        raise InputError("--host", host, f"{expected} ({error})") from None
