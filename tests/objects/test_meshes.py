"""Reading meshes: what is repaired, what is refused and how, and where scans are found."""

import re

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from mjx_grasp.errors import FileError
from mjx_grasp.objects.meshes import EXTENSIONS, centred, find_scan, read_mesh
from mjx_grasp.objects.repair import repair, split


def ball(radius=0.04, subdivisions=3):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def parts_of(mesh):
    return np.array(mesh.vertices), np.array(mesh.faces)


def written(folder, vertices, faces, name="thing.obj"):
    """An .obj file as it is given, without a library's repairs."""
    path = folder / name
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def assert_closed_and_outward(mesh, volume, tolerance=1e-6):
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(volume, rel=tolerance)


# Refusals


def _not_finite(vertices, faces):
    vertices[3, 1] = np.nan
    return vertices, faces


def _open_half(vertices, faces):
    return vertices, faces[vertices[faces].mean(axis=1)[:, 2] > 0]


def _millimetres(vertices, faces):
    return 1000.0 * vertices, faces


def _too_small(vertices, faces):
    return 0.05 * vertices, faces


def _flat(vertices, faces):
    return vertices * (1.0, 1.0, 0.01), faces


def _no_faces(vertices, faces):
    return vertices, faces[:0]


@pytest.mark.parametrize(
    ("damage", "finding"),
    [
        (_no_faces, "empty"),
        (_not_finite, "1 vertices that are not finite"),
        (_open_half, "open beyond repair"),
        (_millimetres, "looks like millimetres"),
        (_too_small, "extents 0.004 x 0.004 x 0.004 m"),
        (_flat, "extents 0.08 x 0.08 x 0.0008 m"),
    ],
)
def test_a_bad_mesh_is_refused_with_its_file_and_finding(tmp_path, damage, finding):
    path = written(tmp_path, *damage(*parts_of(ball())))
    with pytest.raises(FileError, match=finding) as error:
        read_mesh(path)
    assert error.value.path == path and str(path) in str(error.value)


def test_what_is_said_of_a_mesh_in_millimetres_makes_metres_of_it(tmp_path):
    path, new = written(tmp_path, *_millimetres(*parts_of(ball()))), tmp_path / "metres.stl"
    with pytest.raises(FileError) as error:
        read_mesh(path)
    (code,) = re.findall(r"trimesh\..*\)", error.value.expected)
    exec(code, {"trimesh": trimesh, "FILE": path, "NEW_FILE": new})
    assert np.allclose(read_mesh(new).extents, ball().extents, atol=1e-5)


def test_a_name_without_an_extension_and_a_folder_are_refused_as_such(tmp_path):
    with pytest.raises(
        FileError, match=r"thing: found no extension, expected a mesh: one of \.obj"
    ):
        read_mesh(tmp_path / "thing")
    with pytest.raises(FileError, match=r"found a folder, expected a mesh: one of \.obj"):
        read_mesh(tmp_path)


@pytest.mark.parametrize("extension", [".obj", ".ply", ".stl"])
@pytest.mark.parametrize("content", [b"", b"\x00\xff" * 300, b"not a mesh at all\n"])
def test_a_file_without_a_mesh_is_refused(tmp_path, extension, content):
    path = tmp_path / f"thing{extension}"
    path.write_bytes(content)
    with pytest.raises(FileError) as error:
        read_mesh(path)
    assert error.value.path == path


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(FileError, match=r"gone\.obj: found no such file"):
        read_mesh(tmp_path / "gone.obj")


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_every_kind_of_file_is_read_alike(tmp_path, extension):
    mesh = ball()
    mesh.apply_translation([0.1, -0.2, 0.3])
    path = tmp_path / f"ball{extension}"
    written = mesh.copy()
    if extension == ".glb":  # of which y points up
        written.vertices = written.vertices[:, [0, 2, 1]] * (1, 1, -1)
        written.fix_normals()
    written.export(path)
    read = read_mesh(path)
    assert np.allclose(read.bounds, mesh.bounds, atol=1e-6)
    assert_closed_and_outward(read, mesh.volume, 1e-5)


@pytest.mark.parametrize("name", ["thing.step", "thing", "thing.obj.bak"])
def test_an_unknown_extension_is_refused_even_if_the_file_exists(tmp_path, name):
    path = tmp_path / name
    path.write_text("v 0 0 0\n")
    with pytest.raises(FileError, match="extension") as error:
        read_mesh(path)
    assert name in str(error.value) and ".ply" in error.value.expected


def test_faces_that_name_missing_vertices_are_refused():
    vertices, faces = parts_of(ball())
    with pytest.raises(FileError, match="missing vertices"):
        repair(vertices[:-1], faces, "thing.obj")


def test_a_sheet_that_encloses_nothing_is_refused():
    vertices, faces = parts_of(ball())
    vertices[:, 2] = 0.2 * vertices[:, 0]  # at an angle: its extents are those of an object
    with pytest.raises(FileError):
        repair(vertices, faces, "sheet.obj")


# Repairs


@pytest.mark.parametrize("extension", [".obj", ".ply", ".stl"])
def test_a_good_mesh_is_read_as_it_is(tmp_path, extension):
    good = ball()
    path = tmp_path / f"thing{extension}"
    good.export(path)
    mesh = read_mesh(path)
    assert_closed_and_outward(mesh, good.volume, tolerance=1e-4)
    assert len(mesh.faces) == len(good.faces) and len(mesh.vertices) == len(good.vertices)


def test_duplicate_vertices_are_merged(tmp_path):
    good = ball()
    soup = good.triangles.reshape(-1, 3)
    path = written(tmp_path, soup, np.arange(len(soup)).reshape(-1, 3))
    mesh = read_mesh(path)
    assert_closed_and_outward(mesh, good.volume, tolerance=1e-4)
    assert len(mesh.vertices) == len(good.vertices)


@settings(max_examples=15)
@given(st.lists(st.integers(0, 319), min_size=1, max_size=150, unique=True))
def test_flipped_faces_are_turned_back(flipped):
    good = ball(subdivisions=2)
    vertices, faces = parts_of(good)
    faces[flipped] = faces[flipped][:, ::-1]
    mesh = repair(vertices, faces, "thing.obj")
    assert_closed_and_outward(mesh, good.volume)
    np.testing.assert_array_equal(np.sort(mesh.faces, axis=1), np.sort(faces, axis=1))


def test_an_inside_out_mesh_is_turned_outward():
    good = ball()
    vertices, faces = parts_of(good)
    mesh = repair(vertices, faces[:, ::-1], "thing.obj")
    assert_closed_and_outward(mesh, good.volume)
    np.testing.assert_array_equal(mesh.faces, faces)


@pytest.mark.parametrize("first", ["outer", "inner"])
def test_a_hollow_mesh_inside_out_keeps_its_cavity(first):
    outer, inner = ball(0.04), ball(0.02)
    inner.invert()
    pair = (outer, inner) if first == "outer" else (inner, outer)
    vertices = np.concatenate([each.vertices for each in pair])
    faces = np.concatenate([pair[0].faces, pair[1].faces + len(pair[0].vertices)])
    mesh = repair(vertices, faces[:, ::-1], "thing.obj")
    assert_closed_and_outward(mesh, outer.volume + inner.volume)
    np.testing.assert_array_equal(mesh.faces, faces)


def test_the_walls_of_a_cavity_stay_inward():
    outer, inner = ball(0.04), ball(0.02)
    vertices = np.concatenate([outer.vertices, inner.vertices])
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    mesh = repair(vertices, faces, "thing.obj")
    assert_closed_and_outward(mesh, outer.volume - inner.volume)
    np.testing.assert_array_equal(mesh.faces, faces)


@settings(max_examples=15)
@given(st.integers(0, 1279), st.sampled_from([1, 2, 5]))
def test_a_small_hole_is_filled_flush(seed_face, size):
    good = ball()
    vertices, faces = parts_of(good)
    if size == 5:  # all faces around a vertex
        hole = (faces == faces[seed_face, 0]).any(axis=1)
    else:  # one face, or two that share an edge
        shared = np.isin(faces, faces[seed_face]).sum(axis=1)
        hole = np.zeros(len(faces), bool)
        hole[np.argsort(-shared, kind="stable")[:size]] = True
    mesh = repair(vertices, faces[~hole], "thing.obj")
    assert len(mesh.faces) > np.sum(~hole)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(good.volume, rel=0.02)


def test_a_large_hole_is_not_hidden_under_a_lid():
    vertices, faces = parts_of(ball())
    bowl = faces[vertices[faces].mean(axis=1)[:, 2] < 0.02]
    with pytest.raises(FileError, match="open beyond repair"):
        repair(vertices, bowl, "bowl.obj")


def test_double_and_degenerate_faces_are_dropped():
    good = ball()
    vertices, faces = parts_of(good)
    extra = np.concatenate([faces, faces[:3], faces[:2][:, ::-1], [[5, 5, 9]]])
    mesh = repair(vertices, extra, "thing.obj")
    assert_closed_and_outward(mesh, good.volume)
    assert len(mesh.faces) == len(faces)


def test_a_fin_on_a_closed_body_is_dropped():
    good = ball()
    vertices, faces = parts_of(good)
    a, b = faces[0, :2]
    vertices = np.concatenate([vertices, [1.3 * vertices[a]]])
    mesh = repair(vertices, np.concatenate([faces, [[a, b, len(vertices) - 1]]]), "t.obj")
    assert_closed_and_outward(mesh, good.volume, tolerance=0.02)
    assert np.ptp(mesh.vertices, axis=0).max() < 1.01 * np.ptp(good.vertices, axis=0).max()


@pytest.mark.parametrize("corners", [3, 4])
def test_islands_that_enclose_nothing_are_dropped(corners):
    good, turn = ball(), 2.0 * np.pi * np.arange(corners) / corners
    vertices, faces = parts_of(good)
    ring = np.stack([np.cos(turn), np.sin(turn), np.full(corners, 5.0)], axis=1)
    flat = len(vertices) + np.array([[0, 1, 2], [0, 2, 3]])[: corners - 2]
    vertices = np.concatenate([vertices, 0.01 * ring])
    mesh = repair(vertices, np.concatenate([faces, flat]), "t.obj")
    assert_closed_and_outward(mesh, good.volume)
    assert len(split(mesh)) == 1 and len(mesh.vertices) == len(good.vertices)


def test_repair_of_a_repaired_mesh_changes_nothing():
    vertices, faces = parts_of(ball())
    once = repair(vertices, faces[5:], "thing.obj")
    twice = repair(np.asarray(once.vertices), np.asarray(once.faces), "thing.obj")
    np.testing.assert_array_equal(once.triangles, twice.triangles)


# The object frame and components


@given(st.floats(0.2, 3.0), st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_centred_puts_the_box_about_the_origin(scale, shift):
    mesh = trimesh.creation.box(extents=(0.1, 0.05, 0.2)).apply_translation(shift)
    moved = centred(mesh, scale)
    np.testing.assert_allclose(moved.bounds.sum(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(moved.extents, scale * mesh.extents, rtol=1e-9)


def test_split_gives_the_components_in_order():
    first, second = ball(0.02), ball(0.01).apply_translation((0.1, 0.0, 0.0))
    parts = split(trimesh.util.concatenate([first, second]))
    assert [p.volume for p in parts] == pytest.approx([first.volume, second.volume])


# Folders of scans

NAMES = ("004_sugar_box",)
LAYOUTS = [
    "004_sugar_box.obj",
    "004_sugar_box.ply",
    "004_sugar_box/google_16k/nontextured.ply",
    "004_sugar_box/google_16k/textured.obj",
    "ycb/004_sugar_box/google_16k/nontextured.ply",
    "ycb/004_sugar_box.stl",
]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_both_layouts_are_found(tmp_path, layout):
    scan = tmp_path / layout
    scan.parent.mkdir(parents=True, exist_ok=True)
    ball().export(scan)
    assert find_scan(tmp_path, NAMES) == scan
    read_mesh(find_scan(tmp_path, NAMES))


def test_the_first_stem_is_preferred(tmp_path):
    for stem in ("b", "a"):
        (tmp_path / f"{stem}.obj").touch()
    assert find_scan(tmp_path, ("a", "b")).name == "a.obj"


def test_a_missing_scan_names_the_folder_and_the_files_looked_for(tmp_path):
    (tmp_path / "005_tomato_soup_can.obj").touch()
    with pytest.raises(FileError, match="no scan of 004_sugar_box") as error:
        find_scan(tmp_path, NAMES)
    assert error.value.path == tmp_path and "google_16k" in error.value.expected


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(FileError, match="no such folder"):
        find_scan(tmp_path / "nowhere", NAMES)
