import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.heatmap.colours import score_colours
from mjx_grasp.heatmap.files import TERMS
from mjx_grasp.heatmap.steering import Heatmap, steer, steer_contacts
from mjx_grasp.viz.viewer_state import ViewerSettings, show


def plate():
    """Thumbs on the upper side of a plate of 30 mm, wraps straight below; all equally good."""
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 21), np.linspace(-0.1, 0.1, 21))
    thumb = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.015)], axis=1).astype(np.float32)
    n = len(thumb)
    down = np.tile(np.float32([0, 0, -1]), (n, 1))
    along = np.tile(np.float32([0.015, 0, 0]), (n, 1))
    centre = thumb + np.float32(0.03) * down
    near = np.exp(-((np.linalg.norm(thumb[:, :2], axis=1) / 0.03) ** 2)).astype(np.float32)
    valid = np.ones(n, bool)
    valid[0] = False
    return Heatmap(
        vertices=thumb, normals=-down, score=np.where(valid, 0.8 * near, 0),
        score_without_com=np.where(valid, np.float32(0.8), 0), thumb=thumb, opposing=centre,
        long_axis=along / np.float32(0.015), offset=np.full(n, 0.015, np.float32),
        wrap=np.stack([centre + along, centre - along], axis=1),
        wrap_normals=np.stack([down, down], axis=1), centre=centre, axis=down,
        width=np.full(n, 0.03, np.float32), valid=valid,
        terms={name: np.ones(n, np.float32) for name in TERMS},
    )  # fmt: skip


PLATE = plate()


def test_without_an_anchor_the_default_heatmap_is_shown():
    shown = show(PLATE, ViewerSettings())
    assert np.array_equal(shown.score, PLATE.score)
    assert np.allclose(shown.triples.thumb[0], [0, 0, 0.015])
    assert shown.best == pytest.approx(0.8)


@pytest.mark.parametrize("anchor", [(0.06, -0.03, 0.0), (-0.08, 0.08, 0.3)])
def test_scores_colours_and_triple_follow_the_anchor(anchor):
    shown = show(PLATE, ViewerSettings(anchor, sigma=0.02, steering="axis"))
    assert np.allclose(shown.score, steer(PLATE, np.float32(anchor), 0.02))
    assert np.allclose(shown.triples.thumb[0, :2], anchor[:2], atol=1e-6)
    yellow = np.argmax(shown.colours.astype(int).sum(axis=1))
    assert np.allclose(PLATE.vertices[yellow, :2], anchor[:2], atol=1e-6)


def test_a_wider_sigma_colours_more():
    counts = [
        (
            show(PLATE, ViewerSettings((0.0, 0.0, 0.0), sigma=s, steering="axis")).colours[:, 1]
            > 120
        ).sum()
        for s in (0.01, 0.03, 0.06)
    ]
    assert counts[0] < counts[1] < counts[2]


def test_the_scale_ends_at_the_best_score_or_at_one():
    best = show(PLATE, ViewerSettings(to_best=True))
    fixed = show(PLATE, ViewerSettings(to_best=False))
    middle = int(np.argmax(PLATE.score))
    assert best.best == fixed.best == pytest.approx(0.8)
    assert np.array_equal(best.colours[middle], score_colours(np.array([1.0]))[0])
    assert np.array_equal(fixed.colours[middle], score_colours(np.array([0.8]))[0])


def test_triples_are_apart_and_as_many_as_asked_for():
    shown = show(PLATE, ViewerSettings((0.0, 0.0, 0.0), triples=6))
    thumbs = shown.triples.thumb
    gap = np.linalg.norm(thumbs[:, None] - thumbs, axis=2) + np.eye(6)
    assert shown.triples.valid.all() and gap.min() >= 0.02 - 1e-6


def test_in_words():
    text = show(PLATE, ViewerSettings((0.06, -0.03, 0.0))).describe()
    assert text == (
        "score 0.800, thumb (60.0, -30.0, 15.0), "
        "index and middle (75.0, -30.0, -15.0) and (45.0, -30.0, -15.0) mm"
    )
    nothing = PLATE._replace(valid=np.zeros_like(PLATE.valid), score=0 * PLATE.score)
    assert show(nothing, ViewerSettings()).describe() == "no grasp"


@pytest.mark.parametrize(("field", "value"), [("sigma", 0.0), ("triples", 0)])
def test_settings_that_cannot_work_are_refused(field, value):
    with pytest.raises(InputError, match=field):
        ViewerSettings(**{field: value})


def test_between_the_contacts_is_stricter_than_in_line():
    above = (0.0, 0.0, 0.1)
    line, near = (show(PLATE, ViewerSettings(above, steering=s)) for s in ("axis", "between"))
    assert line.best > 0.7 and near.best < 0.01


def test_contacts_are_judged_by_default_and_a_part_by_its_size():
    anchor, size = (0.05, 0.0, 0.0), (0.04, 0.06, 0.05)
    point, part = ViewerSettings(anchor), ViewerSettings(anchor, size=size)
    assert (point.scale, part.scale) == pytest.approx((0.03, 0.005))
    assert ViewerSettings(anchor, size=size, sigma=0.02).scale == 0.02
    assert np.allclose(show(PLATE, point).score, steer_contacts(PLATE, np.float32(anchor)))
    drawn = show(PLATE, part).triples
    contacts = np.concatenate([drawn.thumb[:1], drawn.wrap[0]])
    assert np.all(np.abs(contacts - anchor) <= np.divide(size, 2) + 1e-6)
