"""Laws of what covers the robot's bodies."""

import numpy as np
import pytest

from mjx_grasp.posture.cover import Part, cells


@pytest.mark.parametrize("spanned", [(), (0,), (0, 2), (0, 1, 2)], ids=len)
def test_points_are_in_one_cell_each_whatever_they_span(spanned):
    rng = np.random.default_rng(0)
    at = np.full((40, 3), 0.5)
    at[:, spanned] = rng.uniform(-0.05, 0.05, (40, len(spanned)))
    groups = cells([Part(1, point, point, 0.01) for point in at])
    assert sorted(k for group in groups for k in group) == list(range(40))
    assert (len(groups) > 1) == bool(spanned)
