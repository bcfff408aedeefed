"""The script that fills the READMEs with tables, and what its tests share."""

import importlib.util
import sys
from pathlib import Path

from mjx_grasp.evaluation.results import ResultRow
from mjx_grasp.evaluation.statistics import wilson_interval

ROOT = Path(__file__).resolve().parent.parent
PROVENANCE = {
    "command": "python -m mjx_grasp.evaluate --out a.json",
    "git": "0123456789abcdef-dirty",
    "versions": {"jax": "0.10.2"},
    "device": "a card",
    "seed": 7,
}
CODE = PROVENANCE["git"][:7]
ALONE = "python -m mjx_grasp.evaluate"


def load_generator():
    path = ROOT / "experiments" / "make_readme.py"
    sys.path.insert(0, str(path.parent))  # as when it is run as a script
    spec = importlib.util.spec_from_file_location("make_readme", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_readme"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


make_readme = load_generator()


def result(name, successes, offset_mm):
    return ResultRow(
        object=name, controller="policy", engine="mujoco", episodes=64, successes=successes,
        never_lifted=64 - successes, not_held=0, slipped=0, ci95=wilson_interval(successes, 64),
        force_mean_n=4.25, force_peak_n=9.0, squeeze_force_n=None, offset_mm=offset_mm,
        angle_deg=0.0, friction=0.8, handoffs="ik",
    )  # fmt: skip


def values(line):
    return [cell.strip() for cell in line.strip("|").split("|")]
