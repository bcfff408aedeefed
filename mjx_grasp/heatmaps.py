"""`python -m mjx_grasp.heatmaps`: grasp-affordance heatmaps of a mesh or a folder of meshes.

Needs no robot, no catalogue and no GPU. Per mesh it writes NAME.npz (everything, see
`mjx_grasp.heatmap.files`), NAME.ply (coloured by score) and NAME.triples.json (the best grasp
triples, far enough from each other); for all of them contact_sheet.png, summary.csv and
summary.json.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro
from rich.console import Console

from mjx_grasp.cli import counting_progress, run_command
from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.geometry.mesh import principal_frame
from mjx_grasp.heatmap import Heatmap, HeatmapConfig, compute_heatmap, steer
from mjx_grasp.heatmap.files import HeatmapInfo, save_heatmap, write_ply
from mjx_grasp.heatmap.nearness import steer_near
from mjx_grasp.heatmap.sampling import best_triple, sample_triples
from mjx_grasp.heatmap.summary import GOOD, Row, summary_table, write_summary, write_triples
from mjx_grasp.language.grounding import target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.folder import MeshFile, catalogue_entry, find_meshes
from mjx_grasp.objects.meshes import read_mesh
from mjx_grasp.objects.refine import refined
from mjx_grasp.records.atomic import check_writable
from mjx_grasp.records.provenance import provenance
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.contact_sheet import Cell, contact_sheet, write_png
from mjx_grasp.viz.heatmap import subject_of

_FARTHEST = 1.0  # an anchor farther from the mesh than its diagonal, times this, is a mistake


@dataclass(frozen=True)
class HeatmapsConfig:
    """What to compute. Meshes are in metres; all results are in the frame of the mesh file."""

    mesh: tyro.conf.Positional[Path]
    """A mesh (.obj, .ply, .stl, .glb, .off; metres), or a folder of meshes or YCB scans."""
    out: Path = Path("heatmaps")
    """Folder of the results."""
    anchor: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Steers the scores to grasps around this point [m]."""
    instruction: str | None = None
    """Steers them to a named place, such as "by the handle": a side (top, bottom, left, right,
    front, back, middle) or, for a scan of the catalogue, one of its parts."""
    sigma: float = 0.030
    """How near to the anchor a grasp's axis should pass [m]."""
    between_contacts: bool = False
    """Steers to grasps whose contacts have the anchor between them, not only in line with it (an
    addition to the publication's method)."""
    span: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MIN MAX")] = None
    """Narrowest and widest grasp [m]; the shipped hand's by default."""
    friction: float | None = None
    """Scoring friction [-]; the shipped hand's by default."""
    edge: float = 0.010
    """Longest edge [m]: candidates are vertices, so coarse meshes are refined to it; 0 keeps the
    mesh as it is."""
    triples: int = 5
    """How many grasp triples to write per mesh."""
    temperature: float = 0.0
    """0 takes the best triples, more draws them with probability exp(score/temperature)."""
    min_distance: float = 0.02
    """How far apart triples must be [m]."""
    seed: int = 0
    """Of the draw."""
    heatmap: HeatmapConfig = field(default_factory=HeatmapConfig)

    def __post_init__(self):
        if self.anchor is not None and self.instruction is not None:
            both = (self.anchor, self.instruction)
            raise InputError("--anchor and --instruction", both, "one of them at most")
        if self.anchor is not None and not np.isfinite(self.anchor).all():
            raise InputError("--anchor", self.anchor, "three finite numbers [m]")
        if self.between_contacts and self.anchor is None and self.instruction is None:
            raise InputError("--between-contacts", True, "an --anchor or an --instruction with it")
        if self.span is not None and not 0 < self.span[0] < self.span[1]:
            raise InputError("--span", self.span, "two lengths in ascending order [m]")
        for name in ("sigma", "friction"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InputError(f"--{name}", value, "a positive number")
        if self.triples < 1:
            raise InputError("--triples", self.triples, "at least 1")
        for name in ("temperature", "min_distance", "edge"):
            if not 0 <= getattr(self, name) < np.inf:
                flag = f"--{name.replace('_', '-')}"
                raise InputError(flag, getattr(self, name), "0 or more")


@dataclass(frozen=True, eq=False)
class _Job:
    file: MeshFile
    mesh: trimesh.Trimesh
    anchor: np.ndarray | None
    source: str


def make_heatmaps(config: HeatmapsConfig, console: Console | None = None) -> list[Row]:
    """Computes, writes and sums up the heatmaps of a configuration.

    A mesh of a folder that cannot be used is a row with an error, and the others are done.

    Args:
        config: Settings.
        console: Where progress is shown; nowhere if None.

    Raises:
        FileError: There are no meshes, or the only one cannot be used.
        InputError: The anchor or the instruction does not fit the only mesh.
    """
    files = find_meshes(config.mesh)
    if config.out.exists() and not config.out.is_dir():
        raise FileError(config.out, "a file", "a folder, or a name for a new one")
    check_writable("--out", config.out / "contact_sheet.png")
    span, friction = _hand(config)
    rows: dict[str, Row] = {}
    cells = []
    with counting_progress(console) as progress:
        jobs = []
        for file in progress.track(files, description="reading meshes"):
            try:
                jobs.append(_prepare(file, config))
            except MjxGraspError as error:
                if len(files) == 1:
                    raise
                rows[file.name] = Row(file.name, file.path.name, error=str(error))
        work = sum(len(job.mesh.vertices) for job in jobs)
        bar = progress.add_task("heatmaps", total=work)
        for job in jobs:
            progress.update(bar, description=f"heatmap of {job.file.name}")
            rows[job.file.name], cell = _make_one(job, config, span, friction)
            cells.append(cell)
            progress.advance(bar, len(job.mesh.vertices))
        if cells:
            bar = progress.add_task("contact sheet", total=len(cells))
            sheet = contact_sheet(
                cells, _title(config), _subtitle(config, span, friction),
                done=lambda: progress.advance(bar),
            )  # fmt: skip
            write_png(config.out / "contact_sheet.png", sheet)
    ordered = [rows[file.name] for file in files]
    settings = json.loads(json.dumps(asdict(config), default=str))
    settings |= {"span": span, "friction": friction}
    write_summary(config.out, ordered, settings, provenance(config.seed))
    return ordered


def _hand(config: HeatmapsConfig) -> tuple[tuple[float, float], float]:
    """Span and friction: of the flags, and of the shipped hand where they do not say."""
    if config.span is not None and config.friction is not None:
        return config.span, config.friction
    hand = load_robot().hand
    return config.span or hand.span, config.friction or hand.scoring_friction


def _prepare(file: MeshFile, config: HeatmapsConfig) -> _Job:
    """Reads a mesh and finds its anchor: everything that can fail, before anything long."""
    mesh = refined(read_mesh(file.path)[0], config.edge)
    if config.instruction is not None:
        target = target_of(file.name, mesh, catalogue_entry(file.name))
        found = PartGrounder().ground(config.instruction, target)
        return _Job(file, mesh, found.point, found.source)
    if config.anchor is None:
        return _Job(file, mesh, None, "")
    anchor = np.array(config.anchor)
    outside = np.maximum(mesh.bounds[0] - anchor, anchor - mesh.bounds[1]).clip(0.0)
    if np.linalg.norm(outside) > _FARTHEST * np.linalg.norm(mesh.extents):
        low, high = (np.round(b, 3).tolist() for b in mesh.bounds)
        expected = f"a point [m] near {file.path.name}, which lies within {low} to {high}"
        raise InputError("--anchor", config.anchor, expected)
    return _Job(file, mesh, anchor, "anchor")


def _make_one(
    job: _Job, config: HeatmapsConfig, span: tuple[float, float], friction: float
) -> tuple[Row, Cell]:
    start = time.perf_counter()
    vertices, faces = np.asarray(job.mesh.vertices), np.asarray(job.mesh.faces)
    heatmap = compute_heatmap(vertices, faces, None, span, friction, config.heatmap)
    if job.anchor is not None:
        steering = steer_near if config.between_contacts else steer
        score = steering(heatmap, jnp.asarray(job.anchor), config.sigma)
        heatmap = heatmap._replace(score=score)
    heatmap = jax.tree.map(np.asarray, heatmap)
    seconds = time.perf_counter() - start
    name = job.file.name
    info = HeatmapInfo(
        name=name,
        span=span,
        friction=friction,
        com=_floats(principal_frame(vertices, faces).centre),
        anchor=None if job.anchor is None else _floats(job.anchor),
        sigma=None if job.anchor is None else config.sigma,
    )
    save_heatmap(config.out / f"{name}.npz", heatmap, faces, info)
    write_ply(config.out / f"{name}.ply", heatmap, faces)
    _write_triples(config.out / f"{name}.triples.json", heatmap, info, config)
    row = Row(
        name=name,
        file=job.file.path.name,
        vertices=len(vertices),
        faces=len(faces),
        best_score=float(heatmap.score.max()),
        share_above_0_3=float(np.mean(heatmap.score > GOOD)),
        seconds=seconds,
    )
    note = f"best {row.best_score:.2f}"
    if job.source:
        note += f", {job.source}"
    subject = subject_of(heatmap, faces, triple=best_triple(heatmap), anchor=job.anchor)
    return row, Cell(name, note, subject)


def _write_triples(path: Path, heatmap: Heatmap, info: HeatmapInfo, config: HeatmapsConfig) -> None:
    drawn = sample_triples(
        jax.random.key(config.seed),
        heatmap,
        config.triples,
        temperature=config.temperature,
        min_distance=config.min_distance,
    )
    write_triples(path, drawn, info)


def _title(config: HeatmapsConfig) -> str:
    if config.instruction is not None:
        return f"Grasp-affordance heatmaps, “{config.instruction}”"
    return "Grasp-affordance heatmaps"


def _subtitle(config: HeatmapsConfig, span: tuple[float, float], friction: float) -> str:
    text = f"hand span {1e3 * span[0]:g} to {1e3 * span[1]:g} mm, friction {friction:g}"
    if config.anchor is not None:
        text += f", anchor {', '.join(f'{1e3 * x:g}' for x in config.anchor)} mm"
    if config.anchor is not None or config.instruction is not None:
        text += f", sigma {1e3 * config.sigma:g} mm"
    return text


def _floats(point: np.ndarray) -> tuple[float, float, float]:
    x, y, z = point
    return float(x), float(y), float(z)


def main() -> None:
    """Parses the command line, makes the heatmaps, prints the table."""
    config = tyro.cli(HeatmapsConfig, description=__doc__)
    rows = make_heatmaps(config, Console(stderr=True))
    console = Console()
    console.print(summary_table(rows))
    failed = [row for row in rows if row.error]
    print(f"written: {len(rows) - len(failed)} of {len(rows)} heatmaps, in {config.out}")
    for row in failed:
        print(f"failed: {row.name}: {row.error}", file=sys.stderr)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    run_command(main)
