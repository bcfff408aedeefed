"""The documentation: it builds without a warning, its links lead somewhere, nothing is left out."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import jax.numpy as jnp
import numpy as np
import pytest
from test_packaging import COMMANDS, module_name

import mjx_grasp
from mjx_grasp.geometry import so3
from mjx_grasp.objects.catalogue import groups
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.robot.interface import Robot
from mjx_grasp.robot.spec import load_robot

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"


class Page(HTMLParser):
    """What a page loads, where it leads, and what may lead to it."""

    def __init__(self, path: Path):
        super().__init__()
        self.loads, self.links, self.anchors = set(), set(), set()
        self.text = path.read_text()
        self.feed(self.text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.anchors.add(found.get("id"))
        if tag == "a" and "href" in found:
            self.links.add(found["href"])
        elif tag != "a" and (source := found.get("src") or found.get("href")):
            self.loads.add(source)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """All pages by their path in the site."""
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, DOCS / "build.py", out], capture_output=True, text=True, env=os.environ
    )
    assert (done.returncode, done.stderr) == (0, "")
    return {path.relative_to(out): Page(path) for path in out.rglob("*.html")}, out


def test_links_lead_somewhere_and_nothing_is_loaded_from_elsewhere(site):
    """Of the site as it is built, without a warning."""
    pages, out = site
    for path, page in pages.items():
        outside = {link for link in page.loads if urlsplit(link).netloc}
        assert not outside, f"{path} loads {outside}"
        for link in page.links | page.loads:
            to = urlsplit(link)
            if to.scheme:
                continue
            there = (out / path.parent / unquote(to.path)).resolve() if to.path else out / path
            assert there.is_file(), f"{path}: {link}"
            if to.fragment and (found := pages.get(there.relative_to(out))):
                assert unquote(to.fragment) in found.anchors, f"{path}: {link}"


@pytest.mark.long
def test_every_public_name_is_in_the_reference(site):
    pages, _ = site
    anchors = set().union(*(page.anchors for page in pages.values()))
    listed = pages[Path("reference/public.html")].links
    for name, module in mjx_grasp._PUBLIC.items():
        assert f"{module}.{name}" in anchors
        assert any(link.endswith(f"#{module}.{name}") for link in listed), name


@pytest.mark.long
def test_every_module_is_in_the_reference(site):
    pages, _ = site
    anchors = set().union(*(page.anchors for page in pages.values()))
    for path in (ROOT / "mjx_grasp").glob("*/**/*.py"):
        if path.name != "__init__.py":
            assert f"module-{module_name(path)}" in anchors


@pytest.mark.long
def test_every_command_is_on_its_page(site):
    pages, _ = site
    text = pages[Path("commands.html")].text
    for path in COMMANDS:
        assert f"usage: python -m {module_name(path)}" in text
    shown = re.findall(r"^## ([\w.]+)$", (DOCS / "commands.md").read_text(), re.M)
    assert {f"mjx_grasp.{name}" for name in shown} == {module_name(path) for path in COMMANDS}


@pytest.mark.long
def test_equations_are_there_without_a_script(site):
    pages, _ = site
    method = pages[Path("method.html")].text
    assert method.count("<math") > 50 and "\\frac" not in re.sub(r"<math.*?</math>", "", method)
    assert "merror" not in method


def blocks(name):
    return re.findall(r"^```python\n(.*?)^```", (DOCS / name).read_text(), re.M | re.S)


@pytest.mark.long
def test_the_tutorial_lifts_the_can():
    names: dict = {}
    for number, code in enumerate(blocks("tutorial.md")):
        exec(compile(code, f"tutorial.md, block {number + 1}", "exec"), names)
    assert Phase(int(names["state"].phase)) is Phase.HOLDING
    assert Failure(int(names["state"].failure)) is Failure.NONE
    assert names["rise"] > 0.1
    assert names["heatmap"].thumb[names["steered"]][2] > names["heatmap"].thumb[names["best"]][2]


def test_the_example_of_an_object_runs():
    names: dict = {}
    exec(blocks("own-object.md")[0], names)
    assert names["scores"].shape == (1000, len(names["heatmap"].vertices))
    assert names["scores"].max() > 0


def test_the_page_about_the_catalogue_names_the_eight():
    (said,) = re.findall(
        r"^The eight are .*?\n\n", (DOCS / "own-object.md").read_text(), re.M | re.S
    )
    assert set(re.findall(r"`(\w+)`", said)) == set(groups()["eight"])


class Drives:
    """Hardware that stays where it is."""

    online, sent = False, None

    def __init__(self, robot):
        self.q, self.sensed = np.array(robot.home), sum(len(f.joints) for f in robot.hand.fingers)

    def start(self):
        self.online = True

    def stop(self):
        self.online = False

    def positions(self):
        return self.q

    def velocities(self):
        return np.zeros_like(self.q)

    def external_torques(self):
        return np.zeros((1, self.sensed))

    def send(self, target):
        self.sent = target


@pytest.mark.long
def test_the_loop_of_a_driver_grasps():
    driver, loop, given = blocks("own-driver.md")[:3]
    names: dict = {}
    exec(driver + loop + given, names)
    cube = mjx_grasp.load_object("rubiks_cube")
    scene = mjx_grasp.build_scene([cube], names["spec"])
    qpos = scene.model.qpos0.copy()
    qpos[scene.addresses.robot_qpos] = names["spec"].home
    qpos[scene.addresses.object_qpos] = [0.5, -0.1, -cube.mesh.bounds[0, 2], 1, 0, 0, 0]
    simulated = mjx_grasp.SimRobot(scene, qpos, cube.name)
    simulated.connect()

    def look():
        truth = simulated.truth()
        pose = truth.object_pos, so3.quat_to_mat(truth.object_quat)
        return mjx_grasp.Seen(*pose, truth.tip_found, jnp.zeros((0, 4)))

    there = (names[name] for name in ("grasper", "library", "known"))
    state = names["grasp"](simulated, look, *there)
    assert Phase(int(state.phase)) is Phase.HOLDING
    assert simulated.truth().object_pos[2] > 0.1


def test_the_skeleton_of_a_driver_is_a_robot():
    names: dict = {}
    exec(blocks("own-driver.md")[0], names)
    spec = load_robot()
    drives = Drives(spec)
    driver = names["LabRobot"](drives, spec)
    for verb in vars(Robot):
        assert verb.startswith("_") or hasattr(driver, verb)
    driver.connect()
    assert driver.is_connected
    np.testing.assert_array_equal(drives.sent, spec.home)
    measured = driver.read()
    assert measured.pad_pos.shape == (3, 3) and np.isfinite(measured.pad_pos).all()
    closer = mjx_grasp.Closer.of(spec)
    points = mjx_grasp.ThreePoints(measured.pad_pos, -measured.pad_mat[..., 0])
    state = closer.start(measured, points)
    untouched, still = jnp.zeros(3, bool), jnp.zeros(closer.action_size)
    _, target = closer.tick(state, measured, points, untouched, still)
    driver.command(target)
    assert drives.sent.shape == (len(spec.joints),)
    driver.disconnect()
    assert not driver.is_connected
