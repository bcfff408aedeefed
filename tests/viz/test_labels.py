"""Words beside points cover no other words and no point."""

import numpy as np
import pytest

from mjx_grasp.viz.labels import Label, place
from mjx_grasp.viz.plots import new_figure


@pytest.mark.parametrize("seed", range(4))
def test_labels_cover_neither_each_other_nor_points(seed):
    points = np.random.default_rng(seed).uniform(0.1, 0.9, (12, 2))
    figure = new_figure(4, 4)
    ax = figure.subplots()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.plot(*points.T, "o")
    boxes = place(ax, [Label(f"{k}.5 N", *point, "k") for k, point in enumerate(points)])
    assert len(boxes) > 6
    figure.draw_without_rendering()
    drawn = [text.get_window_extent() for text in ax.texts]
    assert np.allclose([box.bounds for box in boxes], [box.bounds for box in drawn])
    for k, box in enumerate(boxes):
        assert not box.count_overlaps(boxes[:k])
        assert not any(box.contains(*pixel) for pixel in ax.transData.transform(points))
        assert ax.bbox.contains(*box.min) and ax.bbox.contains(*box.max)


def test_a_label_is_off_the_lines_where_it_can_be():
    """Above and left of the point, where it would stand, there is a line."""
    ax = new_figure(4, 4).subplots()
    ax.plot((0, 1), (1, 0))
    ax.plot(0.5, 0.5, "o")
    (box,) = place(ax, [Label("3 N", 0.5, 0.5, "k")])
    corners = ax.transData.inverted().transform(box.corners())
    assert len(set(np.sign(corners.sum(axis=1) - 1))) == 1


def test_where_there_is_no_room_a_label_is_left_out():
    ax = new_figure(4, 4).subplots()
    crowd = np.stack(np.meshgrid(*[np.linspace(0.4, 0.6, 9)] * 2), axis=-1).reshape(-1, 2)
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.plot(*crowd.T, "o", markersize=9)
    assert place(ax, [Label("in the middle of it", 0.5, 0.5, "k")]) == []
