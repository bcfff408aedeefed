import numpy as np
import pytest
import trimesh

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.colours import VOID, score_colours, steered_shade
from mjx_grasp.viz.contact_sheet import Cell, contact_sheet
from mjx_grasp.viz.heatmap import ANCHOR, THUMB, WRAP, Subject, best_axes, draw
from mjx_grasp.viz.raster import look_from


def ball(score, **marks):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    values = np.broadcast_to(np.asarray(score(mesh.vertices), float), len(mesh.vertices))
    return Subject(mesh.vertices, mesh.faces, mesh.vertex_normals, values, **marks)


def hue(picture):
    """Colours without brightness."""
    picture = picture.astype(float)
    return picture / np.maximum(np.linalg.norm(picture, axis=-1, keepdims=True), 1)


def middle(picture):
    return picture[picture.shape[0] // 2, picture.shape[1] // 2].astype(int)


def is_colour(pixels, colour, within=30):
    return np.abs(pixels.astype(int) - colour).max(axis=-1) < within


def test_scores_are_seen_where_they_are():
    # Good on the side of +x, bad on that of −x.
    subject = ball(lambda v: v[:, 0] > 0)
    for azimuth, score in ((0.0, 1.0), (np.pi, 0.0)):
        picture = draw(subject, 60, 60, look_from(azimuth, 0.0))
        expected = hue(score_colours(np.array([score])))[0]
        assert hue(middle(picture)[None])[0] @ expected > 0.985
        assert np.all(picture[0, 0] == 255)


def test_the_top_of_the_scale_can_be_set_and_void_is_grey():
    half = ball(lambda v: np.full(len(v), 0.5))
    picture = draw(half, 40, 40, look_from(0, 0), top=0.5)
    assert hue(middle(picture)[None])[0] @ hue(score_colours(np.array([1.0])))[0] > 0.985
    nothing = draw(ball(lambda v: np.full(len(v), np.nan)), 40, 40, look_from(0, 0))
    assert hue(middle(nothing)[None])[0] @ hue(np.array([VOID]))[0] > 0.995


def test_contacts_are_filled_on_the_near_side_and_rings_on_the_far_side():
    thumb = np.array([0.04, 0, 0])
    wrap = np.array([[-0.038, 0.0, 0.012], [-0.038, 0.0, -0.012]])
    subject = ball(lambda v: np.zeros(len(v)), thumb=thumb, wrap=wrap)
    near, far = (draw(subject, 200, 200, look_from(a, 0.0)) for a in (0.0, np.pi))
    assert is_colour(middle(near), THUMB)
    assert not is_colour(middle(far), THUMB), "a ring is open in its middle"
    ring = is_colour(far, THUMB)[90:110, 90:110].sum()
    assert 10 < ring < is_colour(near, THUMB).sum()
    assert is_colour(far, WRAP)[60:140, 80:120].sum() > is_colour(near, WRAP)[60:140, 80:120].sum()


def test_an_anchor_beside_the_mesh_is_in_the_picture():
    subject = ball(lambda v: np.zeros(len(v)), anchor=np.array([0.0, 0.0, 0.09]))
    picture = draw(subject, 200, 200, look_from(0.3, 0.2))
    rows, columns = np.nonzero(is_colour(picture, ANCHOR))
    assert len(rows) > 20
    assert rows.max() < 60 and abs(columns.mean() - 100) < 3


def test_the_best_side_shows_the_good_surface_and_the_thumb():
    for direction in ([1.0, 0.2, 0.1], [-0.3, -1.0, 0.1]):
        direction = np.array(direction) / np.linalg.norm(direction)
        subject = ball(
            lambda v, d=direction: np.clip(25 * (v @ d), 0, 1),
            thumb=0.04 * direction,
            wrap=-0.04 * direction + np.array([[0, 0, 0.01], [0, 0, -0.01]]),
        )
        assert best_axes(subject)[2] @ direction > 0.3


@pytest.mark.parametrize("axis", [0, 1])
def test_a_box_is_never_seen_along_an_axis(axis):
    box = trimesh.creation.box([0.06, 0.04, 0.12]).subdivide_to_size(0.02)
    towards = np.eye(3)[axis] * box.extents[axis] / 2
    good = 1.0 * (box.vertices[:, axis] > towards[axis] - 1e-6)
    pair = np.array([[0, 0, 0.01], [0, 0, -0.01]])
    marks = dict(thumb=towards, wrap=pair - towards)
    subject = Subject(box.vertices, box.faces, box.vertex_normals, good, **marks)
    near = best_axes(subject)[2]
    assert near[axis] > 0.3 and np.abs(near).min() > 0.3


def test_a_sheet_says_that_grey_is_no_candidate_where_there_is_some():
    void = ball(lambda v: np.where(v[:, 2] > 0, np.nan, 0.5))
    for subject, some in ((void, True), (ball(lambda v: v[:, 2] > 0), False)):
        sheet = np.asarray(contact_sheet([Cell("ball", "", subject)], "Title", cell_pixels=80))
        assert is_colour(sheet[-40:, sheet.shape[1] // 2 :], VOID, within=3).any() == some


def test_each_picture_of_steering_has_a_scale_of_its_own():
    score = np.r_[np.zeros(900), np.linspace(0.001, 0.003, 99), 0.02].astype(np.float32)
    shade = steered_shade(score)
    assert np.all(shade[:900] == 0) and shade.max() == 1.0
    assert np.median(shade[900:]) > 0.6, "one good point leaves the part lit"
    assert np.all(np.diff(shade[900:]) >= 0)
    assert np.array_equal(steered_shade(np.zeros(5)), np.zeros(5))


def sheet_of(count, **options):
    cells = [Cell(f"object {k}", "best 0.5", ball(lambda v: v[:, 2] / 0.04)) for k in range(count)]
    return contact_sheet(cells, "Title", "subtitle", cell_pixels=80, **options)


def test_a_sheet_has_a_place_for_everything():
    assert sheet_of(3, columns=2).height > sheet_of(2, columns=2).height
    calls = []
    wide = sheet_of(5, columns=5, done=lambda: calls.append(1))
    assert len(calls) == 5
    pixels = np.asarray(wide)
    # Purple and yellow ends of the colour bar; purple bottoms of five balls.
    for score in (0.0, 1.0):
        assert is_colour(pixels, score_colours(np.array([score]))[0], within=3).sum() > 5
    with pytest.raises(InputError, match="at least one"):
        contact_sheet([], "Title")


@pytest.mark.long
def test_many_cells_become_smaller_instead_of_enormous(monkeypatch):
    monkeypatch.setattr("mjx_grasp.viz.contact_sheet._MOST_PIXELS", 600)
    assert max(sheet_of(30).size) < 1200
