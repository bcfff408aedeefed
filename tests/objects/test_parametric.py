"""Stand-ins: closed, outward, of the published size, or of the scan's where the two disagree."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from mjx_grasp.assets import asset_path
from mjx_grasp.errors import InputError
from mjx_grasp.objects.catalogue import load_catalogue
from mjx_grasp.objects.parametric import stand_in
from mjx_grasp.objects.repair import split

ROOT = Path(__file__).resolve().parents[2]
CATALOGUE = load_catalogue()
BASES = [n for n, info in CATALOGUE.items() if info.scale == 1.0]

# Sorted extents of the scans [mm] where published dimensions are absent, leave out a handle or
# disagree with the scan, and how far the stand-in may be from them. Where it is more than 6 %: the
# clamp and the mug's handle are plainer than the real ones, and the pitcher has no spout.
SCANS = {
    "power_drill": ((57.5, 184.3, 187.0), 0.06),
    "toy_airplane": ((183.6, 254.7, 261.1), 0.06),
    "banana": ((36.7, 68.9, 197.6), 0.06),
    "mini_soccer_ball": ((125.5, 127.7, 127.9), 0.06),
    "pear": ((65.7, 66.5, 94.8), 0.06),
    "large_clamp": ((39.2, 121.5, 165.8), 0.09),
    "mug": ((81.9, 93.3, 104.9), 0.08),
    "pitcher_base": ((143.9, 150.0, 242.5), 0.13),
}
BALLS = {
    "apple",
    "mini_soccer_ball",
    "softball",
    "baseball",
    "tennis_ball",
    "racquetball",
    "golf_ball",
    "orange",
    "peach",
}
# A point in the opening and one in the wall below it: the volume has to know the difference.
HOLLOW = {"pitcher_base": 0.35, "bowl": 0.35, "mug": 0.45, "wine_glass": 0.3}


def published(name):
    """Sorted extents [m]; two numbers are a diameter, twice, and a length."""
    dims = CATALOGUE[name].published_dims_m
    return np.sort({1: dims * 3, 2: (dims[0], *dims), 3: dims}[len(dims)])


@pytest.mark.parametrize("name", BASES)
def test_is_closed_outward_and_of_moderate_size(name):
    mesh = stand_in(name)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert 1000 < len(mesh.faces) <= 6000
    for part in split(mesh):
        assert part.volume > 0
    assert mesh.area_faces.min() > 0
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0.0, atol=1e-9)


@pytest.mark.parametrize("name", [n for n in BASES if n not in SCANS])
def test_has_the_published_dimensions(name):
    np.testing.assert_allclose(np.sort(stand_in(name).extents), published(name), rtol=0.03)


@pytest.mark.parametrize("name", list(SCANS))
def test_has_the_scans_extents_where_published_ones_mislead(name):
    extents, tolerance = SCANS[name]
    np.testing.assert_allclose(1e3 * np.sort(stand_in(name).extents), extents, rtol=tolerance)


@pytest.mark.parametrize("name", sorted(BALLS))
def test_balls_are_round_and_full(name):
    mesh = stand_in(name)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    np.testing.assert_allclose(radius, radius.max(), rtol=1e-6)
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * radius.max() ** 3, rel=0.005)


@pytest.mark.parametrize("name", ["foam_brick", "sugar_box", "cracker_box", "wood_block"])
def test_boxes_fill_their_box(name):
    mesh = stand_in(name)
    assert 0.97 < mesh.volume / np.prod(mesh.extents) < 1.0


@pytest.mark.parametrize("name", ["tomato_soup_can", "master_chef_can", "tuna_fish_can"])
def test_cans_fill_their_cylinder(name):
    mesh = stand_in(name)
    diameter, _, height = mesh.extents
    full = np.pi / 4 * diameter**2 * height
    assert 0.97 < mesh.volume / full < 1.0


@pytest.mark.parametrize(("name", "share"), HOLLOW.items())
def test_vessels_are_hollow(name, share):
    mesh = stand_in(name)
    assert mesh.volume < share * mesh.convex_hull.volume


@pytest.mark.parametrize("name", [n for n in BASES if n not in HOLLOW])
def test_the_rest_is_solid(name):
    mesh = stand_in(name)
    assert mesh.volume > 0.2 * mesh.convex_hull.volume


def test_scale_is_uniform():
    whole, small = stand_in("pitcher_base"), stand_in("pitcher_base", 0.6)
    np.testing.assert_allclose(small.vertices, 0.6 * whole.vertices, rtol=1e-12)
    np.testing.assert_array_equal(small.faces, whole.faces)


def test_every_object_of_the_catalogue_has_one_and_an_unknown_name_is_refused():
    for info in CATALOGUE.values():
        assert stand_in(info.scan_of).volume > 0
    with pytest.raises(InputError, match="apple"):
        stand_in("pitcher_base_scaled")


def test_the_shipped_file_is_what_the_script_makes(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    script = import_module("stand_ins")
    script.main(script.StandInsConfig(tmp_path / "made.npz"))
    with np.load(tmp_path / "made.npz") as made, np.load(asset_path("stand_ins.npz")) as shipped:
        assert made.files == shipped.files
        for name in made.files:
            np.testing.assert_allclose(made[name], shipped[name], rtol=0, atol=1e-9)
