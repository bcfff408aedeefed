"""The heatmaps of a mesh or of a folder of meshes: files of each, and what sums them up."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import numpy as np
import trimesh
import tyro
from rich.console import Console
from rich.markup import escape

from mjx_grasp.cli import counting_progress
from mjx_grasp.errors import InputError, MjxGraspError
from mjx_grasp.heatmap.colours import steered_shade
from mjx_grasp.heatmap.files import StoredHeatmap, save_heatmap, write_ply
from mjx_grasp.heatmap.meshes import MeshConfig, heatmap_of_mesh, steered
from mjx_grasp.heatmap.sampling import best_triple, sample_triples
from mjx_grasp.heatmap.steering import Heatmap
from mjx_grasp.heatmap.summary import (
    GOOD,
    LEAST,
    Row,
    is_summary,
    write_summary,
    write_triples,
)
from mjx_grasp.language.grounding import Anchor, target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.folder import MeshFile, find_meshes
from mjx_grasp.objects.meshes import read_mesh
from mjx_grasp.objects.parts import parts_of
from mjx_grasp.records.atomic import check_new_folder, replacing
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import NonNegative, Range, Seed, to_record
from mjx_grasp.viz.contact_sheet import Cell, contact_sheet
from mjx_grasp.viz.heatmap import subject_of

_FARTHEST = 1.0  # an anchor farther from the mesh than its diagonal, times this, is a mistake


@dataclass(frozen=True)
class HeatmapsConfig(MeshConfig):
    """What to compute, of a mesh or a folder of meshes; results are in each mesh's own frame."""

    mesh: tyro.conf.Positional[Path]
    """a mesh (.obj, .ply, .stl, .glb, .off; metres), or a folder of meshes"""
    out: Path = Path("heatmaps")
    """folder of the results"""
    instruction: str | None = None
    """steers to a named place, such as "by the handle": a side (top, bottom, left, right, front,
    back, middle) or a part, of a scan of the catalogue or named in a YAML file beside the mesh"""
    triples: Annotated[int, Range(1, 10_000)] = 5
    """how many grasp triples to write per mesh [-]"""
    temperature: NonNegative = 0.0
    """0 takes the best triples, more draws them with probability exp(score/temperature) [-]"""
    min_distance: NonNegative = 0.02
    """how far apart triples must be [m]"""
    seed: Seed = 0
    """of the draw"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.anchor is not None and self.instruction is not None:
            both = (self.anchor, self.instruction)
            raise InputError("--anchor and --instruction", both, "one of them at most")
        if not self.steers and (self.sigma is not None or self.steering != "contacts"):
            expected = "an --anchor or an --instruction with it"
            raise InputError("--steering or --sigma", "no place to steer to", expected)

    @property
    def steers(self) -> bool:
        """Whether scores are steered to a place."""
        return self.anchor is not None or self.instruction is not None


class _Job(NamedTuple):
    file: MeshFile
    mesh: trimesh.Trimesh
    anchor: Anchor | None


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
    check_new_folder("--out", config.out)
    _check_kept(files, config.out)
    grip = config.grip()
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
            progress.update(bar, description=f"heatmap of {escape(job.file.name)}")
            rows[job.file.name], cell = _make_one(job, config, grip)
            cells.append(cell)
            progress.advance(bar, len(job.mesh.vertices))
        if cells:
            bar = progress.add_task("contact sheet", total=len(cells))
            titles = _title(config), _subtitle(config, *grip)
            scale = "root of score over best" if config.steers else "score"
            sheet = contact_sheet(cells, *titles, scale=scale, done=lambda: progress.advance(bar))
            with replacing(config.out / "contact_sheet.png") as temporary:
                sheet.save(temporary, optimize=True)
    ordered = [rows[file.name] for file in files]
    settings = to_record(config) | {"span": grip[0], "friction": grip[1]}
    write_summary(config.out, ordered, settings, provenance(config.seed))
    return ordered


def _check_kept(files: Sequence[MeshFile], out: Path) -> None:
    """Refuses to write over meshes, those that heatmaps are of or others, and over other tables.

    Raises:
        InputError: One of them would be overwritten.
    """
    meshes = {file.path.resolve() for file in files}
    lost = []
    for file in files:
        coloured = out / f"{file.name}.ply"
        # A heatmap is written before its coloured mesh.
        ours = coloured.with_name(f"{file.name}.npz").exists()
        if coloured.resolve() in meshes or (coloured.exists() and not ours):
            lost.append(coloured)
    table = out / "summary.csv"
    if table.exists() and not is_summary(table):
        lost.append(table)
    if lost:
        found = f"the folder of {lost[0].name}, which would be overwritten"
        raise InputError("--out", found, "another folder")


def _prepare(file: MeshFile, config: HeatmapsConfig) -> _Job:
    """Reads a mesh and finds its anchor: everything that can fail, before anything long."""
    mesh = read_mesh(file.path)
    if config.instruction is not None:
        target = target_of(file.name, mesh, parts_of(file, mesh))
        return _Job(file, mesh, PartGrounder().ground(config.instruction, target))
    if config.anchor is None:
        return _Job(file, mesh, None)
    anchor = np.array(config.anchor)
    outside = np.maximum(mesh.bounds[0] - anchor, anchor - mesh.bounds[1]).clip(0.0)
    if np.linalg.norm(outside) > _FARTHEST * np.linalg.norm(mesh.extents):
        low, high = (np.round(b, 3).tolist() for b in mesh.bounds)
        expected = f"a point [m] near {file.path.name}, which lies within {low} to {high}"
        raise InputError("--anchor", config.anchor, expected)
    return _Job(file, mesh, Anchor(anchor, "anchor"))


def _make_one(
    job: _Job, config: HeatmapsConfig, grip: tuple[tuple[float, float], float]
) -> tuple[Row, Cell]:
    start = time.perf_counter()
    name = job.file.name
    stored = heatmap_of_mesh(name, job.mesh, grip, config.heatmap)
    place = job.anchor
    offered, least = stored.heatmap.score, LEAST
    if place is not None:
        stored = steered(stored, place.point, place.size, config.sigma, config.steering)
        offered = stored.heatmap.score_without_com
        least *= float(stored.heatmap.score.max())
    seconds = time.perf_counter() - start
    hint = _hint(stored.heatmap, grip[0]) if offered.max() < LEAST else ""
    _write(stored, config, np.inf if hint else least)
    heatmap, faces = stored.heatmap, stored.faces
    row = Row(
        name=name,
        file=job.file.path.name,
        vertices=len(heatmap.vertices),
        faces=len(faces),
        best_score=float(heatmap.score.max()),
        share_above_0_3=float(np.mean(heatmap.score > GOOD)),
        seconds=seconds,
        hint=hint,
    )
    note = "no grasp" if row.hint else f"best {heatmap.score.max():.2f}"
    triple = None if row.hint else best_triple(heatmap)
    if place is None:
        return row, Cell(name, note, subject_of(heatmap, faces, triple=triple))
    shade = steered_shade(np.asarray(heatmap.score))
    subject = subject_of(heatmap, faces, shade, triple, place.point)
    return row, Cell(name, f"{note}, {place.source}", subject)


def _hint(heatmap: Heatmap, span: tuple[float, float]) -> str:
    """Why nothing can be grasped, as far as widths say it."""
    text = "thumb and fingers can oppose nowhere on it"
    widths = heatmap.width[heatmap.valid]
    beyond = np.abs(widths - np.clip(widths, *span))
    if not len(widths) or beyond.min() == 0.0:
        return text
    low, high = (f"{1e3 * x:g}" for x in span)
    nearest = 1e3 * widths[beyond.argmin()]
    return f"{text}: the hand spans {low} to {high} mm, and the nearest width is {nearest:.1f} mm"


def _write(stored: StoredHeatmap, config: HeatmapsConfig, least: float) -> None:
    """Everything about one mesh: all numbers, a coloured mesh, the best triples."""
    name = stored.info.name
    save_heatmap(config.out / f"{name}.npz", stored.heatmap, stored.faces, stored.info)
    write_ply(config.out / f"{name}.ply", stored.heatmap, stored.faces)
    drawn = sample_triples(
        jax.random.key(config.seed),
        stored.heatmap,
        config.triples,
        temperature=config.temperature,
        min_distance=config.min_distance,
        min_score=least,
    )
    write_triples(config.out / f"{name}.triples.json", drawn, stored.info)


def _title(config: HeatmapsConfig) -> str:
    place = "" if config.instruction is None else f", “{config.instruction}”"
    return f"Grasp-affordance heatmaps{place}"


def _subtitle(config: HeatmapsConfig, span: tuple[float, float], friction: float) -> str:
    text = f"hand span {1e3 * span[0]:g} to {1e3 * span[1]:g} mm, friction {friction:g}"
    if config.anchor is not None:
        text += f", anchor {', '.join(f'{1e3 * x:g}' for x in config.anchor)} mm"
    if config.sigma is not None:
        text += f", sigma {1e3 * config.sigma:g} mm"
    return text + (", colours to each panel's best" if config.steers else "")
