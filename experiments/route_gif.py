"""A whole grasp around an obstacle as a looping GIF: the README's picture.

    python experiments/route_gif.py --objects-dir SCANS

Poses are tried by their seeds until one succeeds; the results file says how many were.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console

from mjx_grasp.cli import run_command
from mjx_grasp.heatmap.compute import heatmap_of, heatmap_surface
from mjx_grasp.heatmap.steering import steer_to
from mjx_grasp.language.grounding import target_of
from mjx_grasp.language.parts import PartGrounder
from mjx_grasp.objects.model import load_object
from mjx_grasp.records.atomic import check_writable, write_json
from mjx_grasp.records.provenance import provenance
from mjx_grasp.records.settings import CommandSettings, Count, Positive, Seed
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.demo.config import DemoConfig
from mjx_grasp.viz.demo.run import run_demo
from mjx_grasp.viz.frames import Frame, write_gif
from mjx_grasp.viz.heatmap import Subject, draw

_FPS = 25
_INTRO_S, _END_S = 1.6, 1.2
_INSET, _MARGIN = 210, 14
_INK, _PAPER = (34, 40, 49), (255, 255, 255)
_SAID = {
    "reaching": "reach, around the ball",
    "closing": "close",
    "lifting": "lift",
    "holding": "hold",
}


@dataclass(frozen=True)
class RouteConfig(CommandSettings):
    """What is grasped, and where the picture goes."""

    object: str = "potted_meat_can"
    """of the catalogue"""
    instruction: str = "near the top"
    """where to grasp it"""
    scenario: str = "obstacle"
    """what happens meanwhile"""
    objects_dir: Path | None = None
    """folder of real scans; the parametric stand-in without one"""
    seed: Seed = 24
    """of the first pose; of this one the can stands"""
    tries: Count = 5
    """poses tried at most [-]"""
    max_mb: Positive = 3.0
    """size of the GIF [MB]"""
    out: Path = Path("docs/route.gif")
    """the picture"""
    results: Path = Path("experiments/results/route.json")
    """what it shows"""


def main(config: RouteConfig) -> None:
    """Grasps, films, writes."""
    check_writable("--out", config.out)
    check_writable("--results", config.results)
    made, console, outcomes = provenance(config.seed), Console(stderr=True), []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(config.seed, config.seed + config.tries):
            demo = DemoConfig(
                config.object,
                instruction=config.instruction,
                scenario=config.scenario,
                objects_dir=config.objects_dir,
                seed=seed,
                out=Path(folder) / str(seed),
            )
            result = run_demo(demo, console)
            outcomes.append(result["grasp"]["outcome"])
            console.print(f"seed {seed}: {outcomes[-1]}")
            if result["success"]:
                break
        film = list(iio.imiter(demo.out / "grasp.mp4"))
    pictures = told(film, result, heat(config), config)
    write_gif(config.out, pictures, _FPS, round(config.max_mb * 1e6))
    kept = ("object", "mesh", "asked", "scenario", "closing", "success", "phases")
    record = {name: result[name] for name in kept}
    tried = {"seed": seed, "outcomes": outcomes}
    write_json(config.results, {**record, **tried, "provenance": made})
    console.print(f"written: {config.out}, {config.results}")


def heat(config: RouteConfig) -> Frame:
    """The steered heatmap with its anchor."""
    obj = load_object(config.object, config.objects_dir)
    heatmap = heatmap_of(obj, load_robot().hand)
    anchor = PartGrounder().ground(config.instruction, target_of(obj.name, obj.mesh, obj.parts))
    score = np.asarray(steer_to(heatmap, jnp.asarray(anchor.point), anchor.size))
    valid = np.asarray(heatmap.valid)
    shade = np.sqrt(score / max(float(np.quantile(score[valid], 0.99)), 1e-9))
    subject = Subject(
        vertices=np.asarray(heatmap.vertices, np.float64),
        faces=np.asarray(heatmap_surface(obj.mesh).faces),
        normals=np.asarray(heatmap.normals, np.float64),
        score=np.where(valid, np.minimum(shade, 1.0), np.nan),
        anchor=anchor.point,
    )
    return draw(subject, _INSET, _INSET)


def told(
    film: list[Frame], result: dict[str, Any], inset: Frame, config: RouteConfig
) -> list[Frame]:
    """The film with the instruction, the heatmap at its beginning, and what is done."""
    quoted = f"{config.object.replace('_', ' ')}: “{config.instruction}”"
    first = _captioned(film[0], quoted, "where to grasp", inset)
    pictures = [first] * round(_INTRO_S * _FPS)
    for i, picture in enumerate(film):
        now = i / _FPS
        phase = next((p["name"] for p in result["phases"] if now < p["end"]), "holding")
        pictures.append(_captioned(picture, quoted, _SAID.get(phase, phase)))
        held = [p["start"] for p in result["phases"] if p["name"] == "holding"]
        if held and now > held[-1] + _END_S:
            break
    return pictures


def _captioned(picture: Frame, title: str, text: str, inset: Frame | None = None) -> Frame:
    image = Image.fromarray(picture)
    ink = ImageDraw.Draw(image)
    ink.text((_MARGIN, _MARGIN - 4), title, _INK, ImageFont.load_default(20))
    ink.text((_MARGIN, _MARGIN + 22), text, _INK, ImageFont.load_default(16))
    if inset is not None:
        corner = image.width - _INSET - _MARGIN, _MARGIN
        frame = (corner[0] - 2, corner[1] - 2, corner[0] + _INSET + 1, corner[1] + _INSET + 1)
        ink.rectangle(frame, fill=_PAPER, outline=_INK)
        image.paste(Image.fromarray(inset), corner)
    return np.asarray(image)


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(RouteConfig, description=__doc__)))
