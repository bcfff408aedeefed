"""Impossible settings and damaged files: every command says what is wrong before it does anything.

All run through their real parsers, in the process of the tests.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import walk
from typed import refusal

from mjx_grasp.assets import asset_path
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.reach import run as sweeping
from mjx_grasp.evaluation.reach.poses import SweepConfig
from mjx_grasp.handoff import make as making
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.learning import export as exporting
from mjx_grasp.records.settings import _hints, to_record
from mjx_grasp.tasks import assemble
from mjx_grasp.training.config import TrainConfig, preset_config
from mjx_grasp.viz import heatmap_folder, rendering, viewing
from mjx_grasp.viz.demo import run as demonstrating
from mjx_grasp.viz.demo.config import DemoConfig
from mjx_grasp.viz.heatmap_folder import HeatmapsConfig
from mjx_grasp.viz.rendering import VideoConfig
from mjx_grasp.viz.viewing import ViewConfig

COMMANDS = {
    "demo": (DemoConfig, ()),
    "train": (TrainConfig, ("--preset", "cpu")),
    "evaluate": (EvaluateConfig, ("--out", "x.json")),
    "handoffs": (HandoffConfig, ("--out", "x.npz")),
    "heatmaps": (HeatmapsConfig, ("mesh.obj",)),
    "sweep_reach": (SweepConfig, ()),
    "view": (ViewConfig, ("mesh.obj",)),
    "viz.video": (VideoConfig, ("t.npz",)),
}
"""Of each command its settings, and what it has to be given."""


@pytest.fixture(autouse=True)
def _nothing_long_begins(monkeypatch):
    def begun(*_, **__):
        pytest.fail("it went on")

    for module, name in (
        (assemble, "build_scene"),
        (making, "HandoffGenerator"),
        (sweeping, "Reacher"),
        (heatmap_folder, "heatmap_of_mesh"),
        (demonstrating, "heatmap_of"),
        (exporting, "onnx_model"),
        (viewing, "Viewer"),
        (viewing, "LiveViewer"),
        (viewing, "build_scene"),
        (viewing, "heatmap_of_mesh"),
        (rendering, "_try_backend"),
    ):
        monkeypatch.setattr(module, name, begun)


@pytest.fixture
def refused(monkeypatch, capsys):
    """Runs a command that has to refuse, and gives what it says without the frame around it."""

    def run(command, *arguments):
        before = sorted(Path.cwd().rglob("*"))
        status, error = refusal(monkeypatch, capsys, command, *arguments)
        assert status == 2, error
        assert "Traceback" not in error
        assert sorted(Path.cwd().rglob("*")) == before, "something was written"
        return " ".join(error.translate(str.maketrans("│╭╮╰╯─", "      ")).split())

    return run


def flags(kind, prefix=""):
    """Flags of numbers of a command's settings, each with what it may not be."""
    good = walk.example(kind)
    for name, hint in _hints(kind).items():
        flag = f"{prefix}{name.replace('_', '-')}"
        value = getattr(good, name)
        if dataclasses.is_dataclass(value):
            yield from flags(type(value), f"{flag}.")
            continue
        if not any(walk.numbers(hint)):
            continue
        several = "tuple[" in str(hint)
        refused = list(walk.impossible(hint, value))
        if not several and np.inf not in refused:
            refused.remove(10**400)  # as a word it is infinity
        for bad in refused:
            if isinstance(bad, tuple) is not several or (several and len(bad) > len(value or bad)):
                continue
            values = bad if several else (bad,)
            numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
            if values and len(numbers) == len(values) and min(numbers) > -np.inf:
                yield f"--{flag}", tuple(map(str, values)), good.name_of(name)


def sampled(kind):
    """Of every flag one value, another one from flag to flag; all are tried without a parser."""
    found = {}
    for flag, values, name in flags(kind):
        found.setdefault(flag, []).append((values, name))
    for k, (flag, tried) in enumerate(found.items()):
        yield flag, *tried[k % len(tried)]


@pytest.mark.parametrize(
    "command",
    [pytest.param(c, marks=pytest.mark.long) if c == "train" else c for c in COMMANDS],
)
def test_impossible_numbers_are_refused_by_their_flag_or_field(command, refused):
    kind, needed = COMMANDS[command]
    tried = list(sampled(kind))
    assert len(tried) > 3
    for flag, values, name in tried:
        try:
            said = refused(command, *needed, flag, *values)
        except pytest.fail.Exception:
            pytest.fail(f"{command} {flag} {' '.join(values)} was taken")
        assert name in said or flag in said, (flag, values, said)


@pytest.mark.parametrize(
    ("command", "arguments", "text"),
    [
        ("train", ("--preset", "cpu", "--ppo.hidden", "0"), "--ppo.hidden: found (0,)"),
        ("train", ("--preset", "cpu", "--seed", "9" * 20), "4294967295"),
        ("train", ("--preset", "cpu", "--scene.table-half-size", "0", "0", "0"), "more than 0"),
        ("train", ("--preset", "cpu", "--objects", "foam_brik"), "foam_brick"),
        ("train", ("--preset", "cpu", "--ppo.hidden"), "hidden"),
        ("train", ("--preset", "cpu", "--robot", "no_robot"), "no_robot"),
        ("train", ("--preset", "cpu", "--out", "/proc/run"), "--out: found '/proc/run'"),
        ("evaluate", ("--out", "x.json", "--seed", "-1"), "--seed"),
        ("evaluate", ("--out", "missing/dir/x.json"), "does not exist (missing/dir)"),
        ("evaluate", ("--out", "x.json", "--objects-dir", "none"), "none: found no such folder"),
        ("export", ("p.npz", "--out", "x.npz"), "--out: found 'x.npz'"),
        ("export", ("p.npz", "--out", "missing/x.onnx"), "does not exist (missing)"),
        ("export", ("p.npz", "--out", "/proc/x.onnx"), "--out: found '/proc/x.onnx'"),
        ("export", ("p.npz",), "--out"),
        ("handoffs", ("--out", "x.npz", "--seed", "-1"), "--seed"),
        (
            "handoffs",
            ("--out", "x.npz", "--targets.thumb-standoff", "-1"),
            "s.thumb-standoff: found",
        ),
        ("handoffs", ("--out", "missing/dir/x.npz"), "does not exist (missing/dir)"),
        ("handoffs", ("--out", "x.npz", "--objects-dir", "none"), "none: found no such folder"),
        ("sweep_reach", ("--out", "missing/x.json"), "does not exist (missing)"),
        ("sweep_reach", ("--plot", "missing/x.png"), "does not exist (missing)"),
        ("sweep_reach", ("--seed", "9" * 5000), "--seed"),
        ("view", ("mesh.obj", "--host", "999.1.1.1"), "--host: found '999.1.1.1'"),
        ("view", ("mesh.obj", "--host", ""), "--host"),
        ("view", ("rubiks_cube", "--live", "--host", "0.0.0.0"), "whoever opens the live page"),
        (
            "view",
            ("mug",),
            "mesh: found 'mug', expected a mesh's file; a name of the catalogue needs",
        ),
        ("view", ("eight",), "a name of the catalogue needs --live beside it"),
        ("view", ("teapot",), "a name of the catalogue needs --live beside it"),
        ("view", ("teapot", "--live"), "object: found 'teapot'"),
        ("view", ("heatmap.npz", "--live"), "heatmap.npz"),
        ("view", ("rubiks_cube", "--live", "--also", "teapot"), "object: found 'teapot'"),
        ("view", ("rubiks_cube", "--live", "--policy", "none.npz"), "none.npz"),
        ("view", ("rubiks_cube", "--controller", "grip"), "--live beside it"),
        ("view", ("mesh.obj", "--also", "mug"), "--also: found ('mug',), expected --live"),
        ("view", ("mesh.obj", "--mass", "1"), "--mass: found 1.0, expected --live"),
        ("viz.video", ("t.npz", "--out", "missing/x.gif"), "does not exist (missing)"),
        ("heatmaps", ("mesh.obj", "--anchor", "0", "0", "nan"), "--anchor"),
    ],
)
def test_what_was_once_taken_or_ended_in_a_traceback(command, arguments, text, refused):
    pytest.importorskip("viser")
    assert text in refused(command, *arguments)


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path.read_bytes()


@pytest.fixture(scope="module")
def damage(tmp_path_factory):
    """Contents of files that nothing can be read of, by what is wrong with them."""
    path, deep = tmp_path_factory.mktemp("damage") / "a.npz", "[" * 100_000
    policy = asset_path("policy.npz").read_bytes()
    return {
        "missing": None,
        "empty": b"",
        "text": b"no such thing: {\n",
        "noise": np.random.default_rng(0).bytes(3000),
        "half": policy[: len(policy) // 2],
        "of something else": npz(path, a=np.zeros(3)),
        "pickled": npz(path, header=np.array([{}], dtype=object)),
        "a list as header": npz(path, header=np.array("[]")),
        "header nested too deep": npz(path, header=np.array(deep)),
        "nested too deep": deep.encode(),
    }


FILES = {
    "train --handoffs": ("train", "--preset", "cpu", "--handoffs", "{}.npz"),
    "train --robot": ("train", "--preset", "cpu", "--robot", "{}.yaml"),
    "evaluate --policy": ("evaluate", "--out", "x.json", "--policy", "{}.npz"),
    "evaluate --handoffs": ("evaluate", "--out", "x.json", "--handoffs", "{}.npz"),
    "evaluate --robot": ("evaluate", "--out", "x.json", "--robot", "{}.yaml"),
    "export": ("export", "--out", "x.onnx", "{}.npz"),
    "export --robot": ("export", "p.npz", "--out", "x.onnx", "--robot", "{}.yaml"),
    "handoffs --update": ("handoffs", "--out", "x.npz", "--update", "{}.npz"),
    "handoffs --robot": ("handoffs", "--out", "x.npz", "--robot", "{}.yaml"),
    "sweep_reach --robot": ("sweep_reach", "--robot", "{}.yaml"),
    "heatmaps obj": ("heatmaps", "{}.obj"),
    "heatmaps ply": ("heatmaps", "{}.ply"),
    "heatmaps stl": ("heatmaps", "{}.stl"),
    "heatmaps glb": ("heatmaps", "{}.glb"),
    "view off": ("view", "{}.off"),
    "view npz": ("view", "{}.npz"),
    "viz.video": ("viz.video", "{}.npz"),
}


OF_EACH_KIND = (
    *("train --handoffs", "evaluate --policy", "export --robot"),
    *("heatmaps obj", "view npz"),
)
"""What other commands read is read by the same functions."""


@pytest.mark.parametrize(
    "use", [pytest.param(u, marks=[pytest.mark.long] * (u not in OF_EACH_KIND)) for u in FILES]
)
def test_damaged_files_are_refused_by_name(use, damage, refused):
    if use.startswith("view"):
        pytest.importorskip("viser")
    command, *arguments = FILES[use]
    for k, (what, content) in enumerate(damage.items()):
        file = Path(arguments[-1].format(f"file{k}"))
        if content is not None:
            file.write_bytes(content)
        said = refused(command, *arguments[:-1], file)
        assert file.name in said, (what, said)
    folder = Path(arguments[-1].format("folder"))
    folder.mkdir()
    assert folder.name in refused(command, *arguments[:-1], folder)


@pytest.fixture
def run(tmp_path):
    """The folder of a run that has just begun."""
    folder = tmp_path / "run"
    folder.mkdir()
    config = dataclasses.replace(preset_config("cpu"), out=folder)
    (folder / "config.json").write_text(json.dumps(to_record(config)))
    (folder / "provenance.json").write_text("{}")
    return folder


@pytest.mark.parametrize("name", ["config.json", "provenance.json"])
def test_a_run_whose_files_are_damaged_is_not_resumed(name, run, damage, refused):
    whole = (run / name).read_bytes()
    for what, content in damage.items():
        (run / name).unlink()
        if content is not None:
            (run / name).write_bytes(content)
        said = refused("train", "--resume", run)
        assert name in said, (what, said)
        (run / name).write_bytes(whole)
    (run / name).unlink()
    (run / name).mkdir()
    assert name in refused("train", "--resume", run)
