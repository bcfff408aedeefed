"""Steering by numbers: how near the chosen contacts come to every side and named part.

Of every object of the catalogue, to its six sides and its parts, by default and steered in each
way: the three contacts of the best candidate. What a robot then achieves is another question.

python experiments/steering_numbers.py --objects-dir SCANS
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from trimesh import Trimesh

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_surface
from mjx_grasp.heatmap.sampling import Triples, best_triple
from mjx_grasp.heatmap.steering import Heatmap, Steering, steer_to
from mjx_grasp.language.grounding import Anchor, target_of
from mjx_grasp.language.parts import SIDES, PartGrounder
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.model import object_mesh
from mjx_grasp.pipeline.known import STEERED_SCORE, steered_candidates
from mjx_grasp.records.atomic import write_json
from mjx_grasp.records.journal import Journal
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, to_record
from mjx_grasp.robot.description import HandSpec
from mjx_grasp.robot.spec import load_robot

SCHEMA = "mjx_grasp.steering_numbers/1"
DEFAULT = "default"
WAYS: tuple[Steering, ...] = get_args(Steering)
FACES = tuple(side for side in SIDES if side != "middle")
ON_PART_M = 0.001
"""A contact no farther outside a part's box is on the part: boxes are placed no better."""
USABLE = 0.05
"""Candidates with less are not chosen by the selection."""


@dataclass(frozen=True)
class NumbersConfig(CommandSettings):
    """What to measure."""

    objects: tuple[str, ...] = tuple(load_catalogue())
    """names of the catalogue"""
    objects_dir: Path | None = None
    """folder of real scans; parametric stand-ins without one, and where there is no scan"""
    out: Path = Path("experiments/results/steering_numbers.json")


class Seen(NamedTuple):
    """An object as it is steered on; the object frame is that of its mesh."""

    name: str
    source: str
    mesh: Trimesh
    heatmap: Heatmap

    def anchor(self, instruction: str) -> Anchor:
        """What an instruction means."""
        parts = load_catalogue()[self.name].parts_on(scan=self.source == "scan")
        return PartGrounder().ground(instruction, target_of(self.name, self.mesh, parts))


def seen(name: str, objects_dir: Path | None, hand: HandSpec) -> Seen:
    """An object with its heatmap: of its scan, where there is one."""
    scan = objects_dir is not None and load_catalogue()[name].split != "figure_only"
    mesh = heatmap_surface(object_mesh(name, objects_dir if scan else None))
    surface = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    heatmap = compute_heatmap(*surface, None, hand.span, hand.scoring_friction)
    return Seen(name, "scan" if scan else "stand-in", mesh, jax.tree.map(np.asarray, heatmap))


def scores(heatmap: Heatmap, anchor: Anchor) -> Iterator[tuple[str, Float[np.ndarray, " v"]]]:
    """By default, and steered in each way."""
    yield DEFAULT, np.asarray(heatmap.score)
    for way in WAYS:
        yield way, np.asarray(steer_to(heatmap, anchor.point, anchor.size, steering=way))


def choice_on_part(
    heatmap: Heatmap, score: Float[np.ndarray, " v"], anchor: Anchor
) -> float | None:
    """Of the candidates that a whole grasp chooses among, the share with all contacts on the part.

    None of an anchor that is no part.
    """
    if not anchor.size.any():
        return None
    among = steered_candidates(heatmap, score)
    chosen = np.asarray(among.valid & (among.score >= STEERED_SCORE))
    contacts = np.concatenate([among.thumb[chosen, None], among.wrap[chosen]], axis=1)
    outside = np.maximum(np.abs(contacts - anchor.point) - 0.5 * anchor.size, 0.0)
    return float(np.mean(np.linalg.norm(outside, axis=2).max(axis=1) <= ON_PART_M))


def measures(heatmap: Heatmap, triple: Triples, anchor: Anchor) -> dict[str, Any]:
    """How far the contacts of a chosen triple are from the anchor and outside its part."""
    contacts = np.concatenate([triple.thumb, triple.wrap[0]]).astype(np.float64)
    apart = np.linalg.norm(contacts - anchor.point, axis=1)
    outside = np.maximum(np.abs(contacts - anchor.point) - 0.5 * anchor.size, 0.0)
    beyond = np.linalg.norm(outside, axis=1)
    return {
        "apart_mm": _millimetres(apart),
        "contacts_mm": round(1e3 * float(apart.mean()), 2),
        "outside_mm": _millimetres(beyond),
        "on_part": bool(np.all(beyond <= ON_PART_M)) if anchor.size.any() else None,
        "quality": round(float(heatmap.score_without_com[int(triple.candidate[0])]), 4),
    }


def rows_of(obj: Seen) -> Iterator[dict[str, Any]]:
    """Of every place of an object and every way, the best candidate."""
    info, heatmap = load_catalogue()[obj.name], obj.heatmap
    contacts = np.concatenate([heatmap.thumb[:, None], heatmap.wrap], axis=1)
    usable = heatmap.valid & (heatmap.score_without_com >= USABLE)
    for kind, places in (("part", tuple(info.parts)), ("side", FACES)):
        for place in places:
            anchor = obj.anchor(place)
            if anchor.source != f"{kind}: {place}":  # a part hides a side of its name
                continue
            apart = np.linalg.norm(contacts - anchor.point, axis=2).mean(axis=1)
            nearest = float(apart[usable].min()) if usable.any() else None
            common = {
                "object": obj.name,
                "split": info.split,
                "mesh": obj.source,
                "kind": kind,
                "place": place,
                "anchor_m": np.round(anchor.point, 4).tolist(),
                "size_m": np.round(anchor.size, 4).tolist(),
                "nearest_mm": None if nearest is None else round(1e3 * nearest, 2),
            }
            for way, score in scores(heatmap, anchor):
                triple = best_triple(heatmap, score)
                share = choice_on_part(heatmap, score, anchor)
                row = {"steering": way, "choice_on_part": share}
                yield common | row | measures(heatmap, triple, anchor)


def _rows_of_object(name: str, objects_dir: Path | None, hand: HandSpec) -> list[dict[str, Any]]:
    return list(rows_of(seen(name, objects_dir, hand)))


def _millimetres(lengths: Float[np.ndarray, " n"]) -> list[float]:
    return np.round(1e3 * lengths, 2).tolist()


def main(config: NumbersConfig) -> None:
    """Measures and writes."""
    made = provenance(0)  # before anything is written, so that the revision is not dirty by it
    hand = load_robot().hand
    journal, rows = Journal(config.out, to_record(config), made["git"]), []
    for name in track(config.objects, "objects", console=Console(stderr=True)):
        rows += journal.once(name, _rows_of_object, name, config.objects_dir, hand)
    settings = {"span_m": hand.span, "friction": hand.scoring_friction, "usable": USABLE}
    settings |= {"on_part_m": ON_PART_M}
    content = {"schema": SCHEMA, "settings": settings, "rows": rows, "provenance": made}
    write_json(config.out, content)
    journal.close()
    print(f"written: {config.out}, {len(rows)} rows")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(NumbersConfig, description=__doc__)))
