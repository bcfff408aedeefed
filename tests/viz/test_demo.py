"""A demo's stage, curves and page, of a grasp that is made up."""

from dataclasses import replace
from pathlib import Path

import handmade
import mujoco
import numpy as np
import pytest
from browser import browsing
from rich.console import Console

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.grasps.kept import Trace
from mjx_grasp.heatmap.compute import compute_heatmap, heatmap_surface
from mjx_grasp.heatmap.steering import steer_to
from mjx_grasp.language.grounding import GroundingError
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.model import Shape, object_mesh
from mjx_grasp.pipeline.known import STEERED_SCORE
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.demo import run
from mjx_grasp.viz.demo.config import DemoConfig
from mjx_grasp.viz.demo.page import Shown, demo_page, verdict
from mjx_grasp.viz.demo.place import place_of, steered_to
from mjx_grasp.viz.demo.plots import Curves, Stage, forces_up_to, wrench_up_to
from mjx_grasp.viz.demo.result import from_anchor, placed, tries_of
from mjx_grasp.viz.demo.stage import FOCUS, Skin, stage_model
from mjx_grasp.viz.heatmap import Subject

CONTACTS = np.array([[0.0, -0.02, 0.0], [0.0, 0.02, 0.02], [0.0, 0.02, -0.02]])


def test_the_stage_has_the_scenes_coordinates_and_touches_nothing(robot):
    box = handmade.box()
    scene = build_scene([box], robot)
    faces = np.asarray(box.mesh.faces)
    score = np.linspace(0, 1, len(box.mesh.vertices))
    skin = Skin(np.asarray(box.mesh.vertices), faces, score, CONTACTS, np.zeros(3))
    model = stage_model(scene, skin)
    assert model.nq == scene.model.nq and model.nu == scene.model.nu
    np.testing.assert_array_equal(model.jnt_qposadr, scene.model.jnt_qposadr)
    assert model.ntex == 1 and model.nmesh == scene.model.nmesh + 1
    assert model.body(FOCUS).id > 0
    qpos = np.zeros(model.nq)
    qpos[scene.addresses.robot_qpos] = robot.home
    qpos[scene.addresses.object_qpos] = (0.5, 0.3, 0.0451, 1, 0, 0, 0)
    found = []
    for each in (model, scene.model):
        data = mujoco.MjData(each)
        data.qpos[:] = qpos
        mujoco.mj_forward(each, data)
        found.append(data.ncon)
    assert found[0] == found[1]
    np.testing.assert_allclose(model.body_mass.sum(), scene.model.body_mass.sum())


def shown(success):
    t = np.arange(1, 61) * 0.01
    flags = np.zeros((60, 3), bool)
    flags[30:50, 0] = True
    tips, wrench = np.full((60, 3), 0.01), (0.1 * t, 0.01 * t)
    curves = Curves(t, tips, flags, flags, flags * 2.0, flags * 3.0, 0.2 * t, *wrench)
    box = handmade.box().mesh
    subject = Subject(
        np.asarray(box.vertices), np.asarray(box.faces), np.asarray(box.vertex_normals),
        np.linspace(0, 1, 8), CONTACTS[0], CONTACTS[1:], np.zeros(3),
    )  # fmt: skip
    grasp = {
        "outcome": "success" if success else "never_lifted",
        "failure": "none" if success else "dropped", "handoff_s": 0.2, "lift_s": 0.3,
        "lifted_s": None, "tip_error_mm": (1.0, 2.0, 3.0), "force_mean_n": 2.0,
        "force_peak_n": 3.0, "replans": 0, "returns": 1,
    }  # fmt: skip
    stages = [Stage("reaching", 0.0, 0.2), Stage("closing", 0.2, 0.3), Stage("lifting", 0.3, 0.6)]
    asked = {"from_anchor_mm": 23.4, "at_best_mm": 12.5, "as_asked": True}
    result = {
        "grasp": grasp,
        "success": success,
        "mass_kg": 0.25,
        "tries": [{"start_s": 0.2, "from_anchor_mm": 23.4 if success else None}],
        "seconds": {"heatmap": 1.0},
        **(asked if success else dict.fromkeys(asked)),
    }
    return Shown("a <box>", subject, curves, stages, None, "no renderer", result)


def test_the_page_needs_nothing_beside_it_and_says_what_came_of_it():
    page = demo_page(shown(True))
    assert "a &lt;box&gt;" in page and "lifted and held" in page and "No film. no renderer" in page
    assert page.count("data:image/png;base64,") == 3
    assert "http" not in page.replace("http-equiv", "") and "src='/" not in page
    assert "<dt>contacts from the anchor</dt><dd>23.4 mm, 12.5 mm at best</dd>" in page
    failed = demo_page(shown(False))
    assert "never lifted: dropped" in failed and "from the anchor" not in failed
    assert "<dt>lifted after</dt><dd>–</dd>" in failed and "<dt>mass</dt><dd>0.25 kg</dd>" in failed


def test_the_page_says_where_a_grasp_was_not_what_was_asked_for():
    asked = shown(True).result
    assert verdict(asked) == "lifted and held, contacts 23 mm from the place, 12 at best"
    aside = asked | {"from_anchor_mm": 56.0, "as_asked": False}
    found = "lifted and held, but not where it was asked for: contacts 56 mm from the place"
    assert verdict(aside).startswith(found)
    first, second = ({"start_s": 0.1, "from_anchor_mm": mm} for mm in (14.0, 20.0))
    aside["tries"] = [first, *asked["tries"]]
    assert verdict(aside).endswith(", after a try at 14 mm")
    aside["tries"] = [second, first, *asked["tries"]]
    assert verdict(aside).endswith(", after 2 tries, the nearest at 14 mm")
    page = demo_page(shown(True)._replace(result=aside))
    assert "class='verdict aside'" in page and "class='verdict aside'" not in demo_page(shown(True))
    dropped = aside | {"success": False, "grasp": asked["grasp"] | {"outcome": "slipped"}}
    assert verdict(dropped).startswith("slipped, contacts 56 mm from the place")
    never = dropped | {"tries": [], "from_anchor_mm": None, "as_asked": None}
    assert verdict(never) == "slipped"
    assert "contacts from the anchor" not in demo_page(shown(True)._replace(result=never))


def test_contacts_are_as_asked_where_hardly_any_are_nearer_and_those_of_the_last_try_count():
    def found(*distances, best=12.5):
        tries = [{"start_s": 0.1 * k, "from_anchor_mm": mm} for k, mm in enumerate(distances)]
        return placed(tries, best)

    assert found(50.0, 32.0) == {"from_anchor_mm": 32.0, "at_best_mm": 12.5, "as_asked": True}
    assert found(10.0)["as_asked"] is True
    assert found(10.0, 33.0) == {"from_anchor_mm": 33.0, "at_best_mm": 12.5, "as_asked": False}
    assert found() == {"from_anchor_mm": None, "at_best_mm": 12.5, "as_asked": None}
    assert set(found(None, best=None).values()) == {None}


def test_tries_have_the_contacts_that_the_hand_closed_on_in_the_objects_frame(robot):
    scene = build_scene([handmade.box()], robot)
    at = scene.addresses.object_qpos
    qpos = np.zeros((4, 1, scene.model.nq))
    half = np.sqrt(0.5)
    qpos[:, 0, at] = (0.5, 0.3, 0.05, half, 0.0, 0.0, half)  # a quarter turn about z
    contacts = np.zeros((4, 1, 3, 3))
    contacts[2, 0] = (0.5, 0.31, 0.05)  # x = 10 mm of the object
    ticks, fingers = np.zeros((4, 1), np.float32), np.zeros((4, 1, 3), np.float32)
    no = fingers > 0
    trace = Trace(
        ticks.astype(np.int32), qpos.astype(np.float32), ticks, np.zeros((4, 1, 6), np.float32),
        fingers, contacts.astype(np.float32), no, no, fingers, fingers, ticks > 0,
    )  # fmt: skip
    stages = [Stage("reaching", 0.0, 0.02), Stage("closing", 0.02, 0.04)]
    (found,) = tries_of(stages, trace, scene, np.array([0.03, 0.0, 0.0]), 0.01)
    assert found == {"start_s": 0.02, "from_anchor_mm": 20.0}
    assert tries_of(stages, trace, scene, None, 0.01)[0]["from_anchor_mm"] is None


def test_an_object_too_heavy_for_friction_is_told_before_the_grasp():
    most = 3 * 0.8 * 8.0 / 9.81
    assert run.too_heavy(most - 0.01, 8.0) is None
    assert "8 N each carry about 2 kg by a friction of 0.8" in run.too_heavy(most + 0.01, 8.0)


def test_how_far_from_the_anchor_contacts_are_is_in_its_own_unit():
    contacts = np.array([[0.03, 0.0, 0.0], [0.0, -0.05, 0.0], [0.0, 0.0, 0.04]])
    assert from_anchor(np.zeros(3), contacts) == 40.0
    assert from_anchor(None, contacts) is None


def _shape(obj):
    """What an object looks like."""
    return Shape(obj.name, obj.mesh, obj.parts)


@pytest.mark.parametrize(
    "asked", [{"instruction": "by the moustache"}, {"anchor": (1.0, 1.0, 1.0)}]
)
def test_a_place_is_looked_for_before_what_takes_long(tmp_path, monkeypatch, asked):
    monkeypatch.setattr(run, "load_objects", lambda *_, **__: pytest.fail("convex pieces first"))
    config = DemoConfig(object="mug", out=tmp_path / "out", **asked)
    with pytest.raises((GroundingError, InputError), match=r"moustache|--anchor"):
        run.run_demo(config, Console(quiet=True))
    assert not (tmp_path / "out").exists()


def test_an_instruction_and_a_point_are_one_too_many():
    with pytest.raises(InputError, match="--instruction and --anchor"):
        DemoConfig(instruction="by the cap", anchor=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"--policy.*none beside --controller grip"):
        DemoConfig(controller="grip", policy=Path("policy.npz"))
    with pytest.raises(InputError, match=r"--force-budget.*none beside --controller grip"):
        DemoConfig(controller="grip", force_budget=4.0)
    for alone in ({"sigma": 0.01}, {"steering": "axis"}):
        with pytest.raises(InputError, match="no place to steer to"):
            DemoConfig(**alone)
        assert DemoConfig(instruction="by the cap", **alone).steers
    assert not DemoConfig().steers and DemoConfig(instruction="by the cap").steers


def test_an_anchor_far_from_the_object_is_refused_with_where_that_lies():
    box = handmade.box()  # ±30, ±20 and ±45 mm: as far away as 45 mm
    for near in ((0.074, 0.0, 0.0), (0.0, -0.064, 0.089)):
        np.testing.assert_array_equal(place_of(_shape(box), DemoConfig(anchor=near)).point, near)
    for far in ((0.076, 0.0, 0.0), (0.0, -0.066, 0.0), (0.0, 0.0, 0.091), (20.0, 0.0, 50.0)):
        with pytest.raises(InputError, match=r"^--anchor: found \(.* near box.*0\.045\]") as error:
            place_of(_shape(box), DemoConfig(anchor=far))
        assert error.value.found == far and "[m]" in error.value.expected


def test_the_place_is_to_blame_where_no_grasp_is_near_it_and_else_the_object(robot):
    box = handmade.box()
    surface = heatmap_surface(box.mesh)
    arrays = np.asarray(surface.vertices), np.asarray(surface.faces)
    heatmap = compute_heatmap(*arrays, None, (0.02, 0.09), 0.5)
    config = DemoConfig(anchor=(0.0, 0.0, 0.08), steering="between", sigma=0.002)
    place = place_of(_shape(box), config)
    with pytest.raises(InputError, match=r"^--anchor: found \(0\.0, 0\.0, 0\.08\).*--sigma"):
        steered_to(heatmap, place, config, robot.hand)
    best = heatmap.score_without_com.max()
    nothing = heatmap._replace(score_without_com=0.04 / best * heatmap.score_without_com)
    for asked, near in ((config, place), (DemoConfig(), None)):
        with pytest.raises(InputError, match=r"^object: found"):
            steered_to(nothing, near, asked, robot.hand)


def refused(match, **settings):
    """A demo that is refused and leaves no folder."""
    with pytest.raises(InputError, match=match):
        run.run_demo(DemoConfig(out=Path("out"), **settings), Console(quiet=True))
    assert not Path("out").exists()


def test_a_page_that_no_demo_has_written_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = Path("out") / "index.html"
    page.parent.mkdir()
    page.write_text("mine")
    with pytest.raises(InputError, match=r"--out: found .*index\.html, which no demo has written"):
        run.run_demo(DemoConfig("mug", out=Path("out")), Console(quiet=True))
    assert [path.name for path in Path("out").iterdir()] == ["index.html"]


def test_a_scenario_of_its_own_objects_takes_no_other():
    refused("^object: found 'mug', expected chips_can, .*side_grasp", object="mug",
            scenario="side_grasp")  # fmt: skip
    refused("^--anchor", object="chips_can", scenario="side_grasp", anchor=(20.0, 0.0, 50.0))


def test_nothing_is_written_of_an_object_that_cannot_be_grasped(monkeypatch):
    def void(obj, hand):
        surface = heatmap_surface(obj.mesh)
        arrays = np.asarray(surface.vertices), np.asarray(surface.faces)
        found = compute_heatmap(*arrays, None, (0.02, 0.09), 0.5)
        return found._replace(score=0.0 * found.score)

    monkeypatch.setattr(run, "heatmap_of", void)
    refused("^object: found 'rubiks_cube'", object="rubiks_cube")


def test_an_instruction_steers_by_contacts_and_the_publications_formula_by_its_name(robot):
    glass = replace(
        handmade.box(),
        name="wine_glass",
        mesh=object_mesh("wine_glass", None),
        parts=load_catalogue()["wine_glass"].parts,
    )
    surface = heatmap_surface(glass.mesh)
    arrays = np.asarray(surface.vertices), np.asarray(surface.faces)
    heatmap = compute_heatmap(*arrays, None, (0.02, 0.09), 0.5)
    at, size = (np.array(x) for x in glass.parts["stem"])
    on_stem = {}
    for steering in ("contacts", "axis"):
        config = DemoConfig(object="wine_glass", instruction="by the stem", steering=steering)
        steered = steered_to(heatmap, place_of(_shape(glass), config), config, robot.hand)
        expected = steer_to(heatmap, at, size, steering=steering)
        assert np.allclose(steered.score, expected / expected.max(), atol=1e-6)
        assert steered.score.max() == 1.0 and "part: stem" in steered.source
        # Among these the grasp is chosen.
        good = np.flatnonzero(steered.score >= STEERED_SCORE)
        contacts = np.concatenate([heatmap.thumb[good, None], heatmap.wrap[good]], axis=1)
        on_stem[steering] = np.abs(contacts - at).max(axis=1) <= size / 2 + 1e-3
    assert on_stem["contacts"].all() and not on_stem["axis"].all()
    assert place_of(_shape(glass), DemoConfig(anchor=(0.0, 0.0, 0.1))).size.max() == 0.0
    assert place_of(_shape(glass), DemoConfig()) is None


def test_the_axis_of_forces_shows_the_estimated_ones_too_but_for_spikes():
    still = np.zeros((400, 3))
    flags = still > 0
    none = still[:, 0]
    seen = Curves(np.arange(400.0), still, flags, flags, still, still, none, none, none)
    assert forces_up_to(seen) == pytest.approx(1.15 * 2.0)
    assert wrench_up_to(seen) == pytest.approx(1.4)
    assert wrench_up_to(seen._replace(net_moment=none + 0.05)) == pytest.approx(1.4 * 5.0)
    thumb = np.tile([10.0, 0.0, 0.0], (400, 1))
    assert forces_up_to(seen._replace(felt=thumb)) == pytest.approx(11.5)
    assert forces_up_to(seen._replace(force=thumb)) == pytest.approx(11.5)
    spike = thumb.copy()
    spike[200] = 100.0
    assert forces_up_to(seen._replace(felt=spike)) == pytest.approx(11.5)


def test_the_page_has_room_on_a_phone(tmp_path):
    """Nothing is wider than the screen, and pictures are as wide as the text."""
    page = tmp_path / "index.html"
    page.write_text(demo_page(shown(True)), encoding="utf-8")
    with browsing(page.as_uri(), {"width": 390, "height": 844}) as opened:
        width = opened.evaluate("document.documentElement.scrollWidth")
        pictures = opened.evaluate("[...document.images].map(i => [i.naturalWidth, i.width])")
    assert width == 390
    assert pictures and all(real > 0 and 300 < seen <= 390 for real, seen in pictures)
