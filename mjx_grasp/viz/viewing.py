"""What `view` serves until it is interrupted: a heatmap, or a robot that grasps what has one."""

from __future__ import annotations

import ipaddress
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
import tyro
from rich.console import Console

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.config import ClosingController, check_closing
from mjx_grasp.evaluation.grasps.run import closing_policy, loaded_grasper
from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_surface
from mjx_grasp.heatmap.files import HeatmapInfo, StoredHeatmap, load_heatmap
from mjx_grasp.heatmap.meshes import MeshConfig, heatmap_of_mesh
from mjx_grasp.language.grounding import Target, target_of
from mjx_grasp.objects.catalogue import find_objects
from mjx_grasp.objects.config import Weight
from mjx_grasp.objects.folder import MeshFile
from mjx_grasp.objects.meshes import read_mesh
from mjx_grasp.objects.model import ObjectModel, load_object, load_objects
from mjx_grasp.objects.parts import parts_of
from mjx_grasp.records.settings import Positive, Range
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.sim.native import NativePhysics
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.live import LiveGrasp
from mjx_grasp.viz.live_viewer import LiveViewer
from mjx_grasp.viz.viewer import Viewer, import_viser
from mjx_grasp.viz.viewer_state import TripleCount, ViewerSettings


@dataclass(frozen=True)
class ViewConfig(MeshConfig):
    """What to show: of a mesh or of the .npz of a heatmap, with an anchor to drag."""

    mesh: tyro.conf.Positional[Path]
    """a mesh (.obj, .ply, .stl, .glb, .off; metres) or the .npz of a heatmap; with --live a mesh, a
    folder of meshes, or a name or group of the catalogue"""
    triples: TripleCount = 3
    """how many of the best grasp triples to draw [-]"""
    host: str = "127.0.0.1"
    """address to serve on; 0.0.0.0 lets other machines in"""
    port: Annotated[int, Range(1, 65535)] = 8080
    """port to serve on; the next free one if it is taken"""
    live: bool = False
    """whether a simulated robot is there that grasps the object at the press of a button; an anchor
    is then relative to the middle of its bounding box"""
    also: tuple[str, ...] = ()
    """more objects to choose from on the live page: names and groups of the catalogue, meshes and
    folders of meshes"""
    objects_dir: Path | None = None
    """folder of real scans of the catalogue's objects on the live page; stand-ins without one"""
    mass: Positive | None = None
    """of each mesh of your own on the live page, also of those that are dropped on it [kg]"""
    density: Positive | None = None
    """of them, instead of a mass; 500 if neither is given [kg/m^3]"""
    controller: ClosingController = "policy"
    """what closes on the live page: a policy on top of a grip that answers to load, or that grip
    alone"""
    policy: Path | None = None
    """policy file; the shipped one by default"""

    def __post_init__(self) -> None:
        super().__post_init__()
        Weight(self.mass, self.density)  # refuses both
        check_closing(self.controller, self.policy)
        for name in ("also", "objects_dir", "mass", "density", "controller", "policy"):
            value = getattr(self, name)
            if value not in (None, (), "policy") and not self.live:
                raise InputError(f"--{name.replace('_', '-')}", value, "--live beside it")


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
    viewer: Viewer | LiveViewer
    if config.live:
        check_loopback(config.host)
        live = load_live(config)
        heatmap, own = partial(object_heatmap, config), partial(own_object, config)
        viewer = LiveViewer(live, heatmap, settings, own, config.host, config.port)
        shown = ", ".join(live.scene.object_names)
    else:
        viewer = Viewer(*load(config), settings, config.host, config.port)
        shown = viewer.target.name
    say(f"{viewer.url} shows {shown}; Ctrl-C ends it")
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
    elif not (config.mesh.suffix or config.mesh.exists()):
        expected = "a mesh's file; a name of the catalogue needs --live beside it"
        raise InputError("mesh", str(config.mesh), expected)
    else:
        name, mesh = config.mesh.stem, read_mesh(config.mesh)
        with Console(stderr=True).status(f"computing the heatmap of {name}"):
            stored = heatmap_of_mesh(name, mesh, config.grip(), config.heatmap)
    return stored, target_of(name, mesh, parts_of(MeshFile(name, config.mesh), mesh))


def load_live(config: ViewConfig) -> LiveGrasp:
    """The robot with the objects that are asked for, the first one first.

    Raises:
        InputError: An unknown object, or one that is asked for twice.
        FileError: A mesh, a scan or the policy cannot be used.
    """
    robot = load_robot(config.robot)
    file = closing_policy(config.controller, config.policy, robot)
    # With scores of an anchor the best half decides; without one that is no loss.
    grasper = loaded_grasper(robot, file, steered=True)
    names = [str(config.mesh), *config.also]
    meshes = any(asked.file is not None for asked in find_objects(names))
    weight = Weight(config.mass, config.density) if meshes else None  # else of dropped ones alone
    scene = build_scene(load_objects(names, config.objects_dir, weight=weight), robot)
    return LiveGrasp(grasper, NativePhysics(scene, grasper.dt, threads=1))


def own_object(config: ViewConfig, path: Path) -> ObjectModel:
    """The object of a mesh that is dropped on the live page.

    Args:
        config: What such meshes weigh.
        path: The mesh.

    Raises:
        FileError: It is none, or none that can be grasped.
    """
    return load_object(str(path), weight=Weight(config.mass, config.density))


def object_heatmap(config: ViewConfig, obj: ObjectModel) -> StoredHeatmap:
    """The heatmap of an object about its own centre of mass, object frame.

    Args:
        config: Hand and heatmap.
        obj: The object.
    """
    surface, grip = heatmap_surface(obj.mesh, config.heatmap), config.grip()
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    heatmap = compute_heatmap(vertices, faces, obj.com, *grip, config.heatmap)
    x, y, z = (float(c) for c in obj.com)
    return StoredHeatmap(heatmap, faces, HeatmapInfo(obj.name, *grip, (x, y, z)))


def check_loopback(host: str) -> None:
    """Makes sure that an address is heard by this machine alone.

    Raises:
        InputError: Others would hear it too.
    """
    found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
    if not all(ipaddress.ip_address(address[0]).is_loopback for *_, address in found):
        raise InputError("--host", host, "127.0.0.1: whoever opens the live page moves the robot")


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
