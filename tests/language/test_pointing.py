"""From pixels to anchors, on pictures and depth rendered by MuJoCo."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mjx_grasp.language.camera import PinholeCamera
from mjx_grasp.language.grounding import GroundingError, Target, View
from mjx_grasp.language.pointing import along_ray, anchor_at, depth_at

SCENE = Path(__file__).with_name("render_scene.py")


@pytest.fixture(
    scope="module", params=["mug", pytest.param("mustard_bottle", marks=pytest.mark.long)]
)
def rendered(request, tmp_path_factory):
    """What the script wrote: a target with its view, and which geom each pixel shows."""
    out = tmp_path_factory.mktemp("rendered") / f"{request.param}.npz"
    done = subprocess.run(
        [sys.executable, SCENE, request.param, out],
        env=os.environ | {"MUJOCO_GL": "egl"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        if os.environ.get("MJX_GRASP_REQUIRE_RENDERER"):
            pytest.fail(done.stderr)
        pytest.skip(done.stderr.strip().splitlines()[-1])
    with np.load(out) as file:
        scene = dict(file)
    height, width = scene["depth"].shape
    camera = PinholeCamera(width, height, *scene["intrinsics"], scene["R_wc"], scene["p_wc"])
    view = View(scene["image"], scene["depth"], camera, scene["R_wo"], scene["p_wo"])
    return Target(request.param, scene["vertices"], scene["faces"], view=view), scene


def surface_points(target, pixels):
    """By an independent ray caster: the first surface points behind pixels, NaN where none."""
    view = target.view
    rays = [view.camera.ray(p) for p in pixels]
    origins = np.array([view.R_wo.T @ (o - view.p_wo) for o, _ in rays])
    directions = np.array([view.R_wo.T @ d for _, d in rays])
    mesh = trimesh.Trimesh(target.vertices, target.faces, process=False)
    hit, ray, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    points = np.full((len(pixels), 3), np.nan)
    points[ray] = hit
    return points


def object_pixels(scene, count, seed=0, erode=0):
    """Centres of random pixels on the object, by the picture's own segmentation."""
    from scipy.ndimage import binary_erosion

    on_object = scene["geom"] == scene["object_geom"]
    if erode:
        on_object = binary_erosion(on_object, iterations=erode)
    rows, columns = np.nonzero(on_object)
    rng = np.random.default_rng(seed)
    pick = rng.choice(len(rows), count, replace=False)
    return np.stack([columns, rows], axis=1)[pick] + 0.5


def test_the_camera_agrees_with_the_renderer_about_where_the_object_is(rendered):
    # Silhouettes: of all pixel centres, those whose ray meets the mesh are those that show it.
    target, scene = rendered
    rows, columns = np.nonzero(scene["geom"] == scene["object_geom"])
    low, high = columns.min() - 3, columns.max() + 3
    grid = np.array([(c + 0.5, r + 0.5) for r in range(rows.min() - 3, rows.max() + 3, 4)
                     for c in range(low, high)])  # fmt: skip
    seen = scene["geom"][grid[:, 1].astype(int), grid[:, 0].astype(int)] == scene["object_geom"]
    expected = np.isfinite(surface_points(target, grid)[:, 0])
    assert 0.1 < seen.mean() < 0.9
    assert np.mean(seen != expected) < 0.004


def test_pixels_on_the_object_give_anchors_within_two_millimetres(rendered):
    target, scene = rendered
    pixels = object_pixels(scene, 100)
    truth = surface_points(target, pixels)
    inside = np.random.default_rng(1).uniform(-0.5, 0.5, pixels.shape)
    anchors = np.array([anchor_at("x", p, target).point for p in pixels + inside])
    error = np.linalg.norm(anchors - truth, axis=1)
    distance = np.linalg.norm(target.view.p_wo - target.view.camera.p_wc)
    assert 0.9 < distance < 1.1
    assert np.nanpercentile(error, 99) <= 0.0002
    assert np.nanmax(error) <= 0.002


def test_the_measured_depth_is_what_counts_not_the_pose(rendered):
    # A pose that is wrong by 5 mm: the point is still where the depth says, in that frame.
    target, scene = rendered
    off = target.view.R_wo @ np.array([0.0, 0.0, 0.005])
    wrong = replace(target, view=replace(target.view, p_wo=target.view.p_wo + off))
    for pixel in object_pixels(scene, 20, erode=2):
        right_one, wrong_one = anchor_at("x", pixel, target), anchor_at("x", pixel, wrong)
        assert "depth" in wrong_one.source
        assert np.allclose(right_one.point - wrong_one.point, [0, 0, 0.005], atol=1e-6)


@pytest.mark.parametrize("missing", [0.0, np.nan, np.inf, -1.0])
def test_without_depth_the_mesh_helps_out(rendered, missing):
    target, scene = rendered
    depth = np.full_like(target.view.depth, missing)
    blind = replace(target, view=replace(target.view, depth=depth))
    pixels = object_pixels(scene, 20, seed=1, erode=1)
    for pixel, truth in zip(pixels, surface_points(target, pixels), strict=True):
        anchor = anchor_at("x", pixel, blind)
        assert "mesh" in anchor.source
        assert np.linalg.norm(anchor.point - truth) < 1e-4


def test_depth_that_goes_through_glass_is_corrected_by_the_mesh(rendered):
    target, scene = rendered
    glass = replace(target, view=replace(target.view, depth=target.view.depth + 0.3))
    (pixel,) = object_pixels(scene, 1, erode=3)
    anchor = anchor_at("x", pixel, glass)
    assert "mesh" in anchor.source
    assert np.linalg.norm(anchor.point - surface_points(target, [pixel])[0]) < 1e-4


def test_something_in_front_of_the_object_is_refused(rendered):
    target, scene = rendered
    hand = replace(target, view=replace(target.view, depth=target.view.depth - 0.2))
    (pixel,) = object_pixels(scene, 1, erode=3)
    with pytest.raises(GroundingError, match="in front of"):
        anchor_at("x", pixel, hand)


def beside(target, scene, metres):
    """A pixel about this far to the right of the object's rightmost one."""
    rows, columns = np.nonzero(scene["geom"] == scene["object_geom"])
    row = int(np.median(rows[columns == columns.max()]))
    per_metre = target.view.camera.fx / float(scene["depth"][row, columns.max()])
    return np.array([columns.max() + 0.5 + metres * per_metre, row + 0.5])


def test_just_beside_the_object_the_nearest_surface_is_taken(rendered):
    target, scene = rendered
    anchor = anchor_at("x", beside(target, scene, 0.015), target)
    assert "beside" in anchor.source
    mesh = trimesh.Trimesh(target.vertices, target.faces, process=False)
    _, gap, _ = trimesh.proximity.closest_point_naive(mesh, anchor.point[None])
    assert gap[0] < 1e-6
    # The point is where the ray passes: its own pixel is about as far away as was pointed.
    pixel, _ = target.view.camera.project(target.view.R_wo @ anchor.point + target.view.p_wo)
    gap_px = np.linalg.norm(pixel - beside(target, scene, 0.015))
    assert 5 < gap_px < 14


def test_far_beside_the_object_is_refused_with_the_distance(rendered):
    target, scene = rendered
    with pytest.raises(GroundingError, match=r"passes .* at \d+ mm"):
        anchor_at("x", beside(target, scene, 0.06), target)
    near = anchor_at("x", beside(target, scene, 0.06), target, limit=0.1)
    assert "beside" in near.source


@pytest.mark.parametrize("pixel", [(-1, 5), (5, -0.1), (640.1, 5), (5, 481)])
def test_pixels_outside_the_picture_are_refused(rendered, pixel):
    with pytest.raises(GroundingError, match="outside"):
        anchor_at("x", np.array(pixel), rendered[0])


@pytest.mark.wrong_types
def test_a_picture_of_another_size_is_refused(rendered):
    target, _ = rendered
    with pytest.raises(GroundingError, match="size"):
        anchor_at(
            "x", np.ones(2), replace(target, view=replace(target.view, depth=np.ones((2, 2))))
        )


def test_the_nearest_point_to_a_ray_agrees_with_sampling_the_surface():
    mesh = trimesh.creation.box(extents=(0.05, 0.03, 0.08))
    points, _ = trimesh.sample.sample_surface_even(mesh, 60_000, seed=0)
    rng = np.random.default_rng(0)
    for _ in range(30):
        origin = rng.normal(size=3)
        origin *= 0.5 / np.linalg.norm(origin)
        direction = rng.uniform(-0.1, 0.1, 3) - origin
        direction /= np.linalg.norm(direction)
        met = along_ray(mesh.vertices, mesh.faces, origin, direction)
        offset = points - origin
        across = offset - (offset @ direction)[:, None] * direction
        least = np.linalg.norm(across, axis=1).min()
        assert met.beside <= least + 1e-7
        assert met.beside >= least - 0.002
        on_ray = origin + met.along * direction
        assert np.linalg.norm(met.point - on_ray) == pytest.approx(met.beside, abs=2e-6)


def test_what_is_behind_the_camera_is_not_met():
    mesh = trimesh.creation.box(extents=(0.05, 0.03, 0.08))
    away = along_ray(mesh.vertices, mesh.faces, np.array([0.5, 0, 0]), np.array([1.0, 0, 0]))
    assert not np.isfinite(away.beside)


def test_depth_is_that_of_the_pixel():
    depth = np.arange(30.0).reshape(5, 6) + 1.0
    depth[2, 3] = np.nan
    assert depth_at(depth, np.array([0.0, 0.0])) == depth[0, 0]
    assert depth_at(depth, np.array([2.99, 1.0])) == depth[1, 2]
    assert depth_at(depth, np.array([6.0, 5.0])) == depth[4, 5]
    assert depth_at(depth, np.array([3.4, 2.4])) is None
