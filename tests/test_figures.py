"""The figures' scripts, each on one stand-in."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent


def script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "experiments" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_the_sheet_of_heatmaps(tmp_path):
    figure = script("heatmap_figure")
    out, results = tmp_path / "sheet.png", tmp_path / "sheet.json"
    figure.main(figure.FigureConfig(objects=("gelatin_box",), out=out, results=results))
    assert out.stat().st_size < 400_000
    (row,) = json.loads(results.read_text())["rows"]
    assert row["name"] == "gelatin_box" and 0.5 < row["best_score"] <= 1.0


def test_steering_brings_the_contacts_nearer(tmp_path, monkeypatch):
    figure = script("steering_figure")
    monkeypatch.setattr(figure, "CASES", (("sugar_box", "the top"),))
    out, results = tmp_path / "steering.png", tmp_path / "steering.json"
    figure.main(figure.FigureConfig(sigmas=(0.02,), drawn_sigma=0.02, out=out, results=results))
    content = json.loads(results.read_text())
    default, line, steered = content["rows"]
    assert [r["steering"] for r in content["rows"]] == ["default", "in line", "between contacts"]
    assert default["sigma_m"] is None and steered["sigma_m"] == 0.02
    assert line["contacts_mm"] < default["contacts_mm"] - 30
    assert steered["contacts_mm"] < default["contacts_mm"] - 30
    contacts, anchor = np.array(steered["contacts_m"]), np.array(steered["anchor_m"])
    mean = np.linalg.norm(contacts - anchor, axis=1).mean()
    assert steered["contacts_mm"] == pytest.approx(1e3 * mean)
    assert content["provenance"]["git"] and Image.open(out).width > 400
