"""The publication's own figures (method §7), shown beside this project's."""

from __future__ import annotations

from typing import NamedTuple


class PaperRow(NamedTuple):
    """Figures of one object."""

    ours: float
    """Success of the published policy [%]."""
    squeeze: float
    """Success of the squeeze baseline at 3 N [%]."""
    reach_mm: tuple[float, float]
    """Reach error, mean and spread [mm]."""


OBJECTS: dict[str, PaperRow] = {
    "potted_meat_can": PaperRow(100.0, 82.5, (13.8, 1.3)),
    "master_chef_can": PaperRow(99.1, 46.8, (21.1, 2.0)),
    "rubiks_cube": PaperRow(95.8, 86.6, (14.1, 1.5)),
    "sugar_box": PaperRow(93.9, 14.3, (13.8, 2.5)),
    "apple": PaperRow(93.4, 70.1, (12.9, 1.4)),
    "tomato_soup_can": PaperRow(87.5, 20.8, (13.2, 0.9)),
    "foam_brick": PaperRow(84.7, 71.7, (9.8, 3.7)),
    "pitcher_base_scaled": PaperRow(80.5, 55.9, (14.6, 0.8)),
}
MEAN = PaperRow(91.9, 56.1, (13.3, 2.1))

EPISODES = 448
"""Of each object and condition."""

FAILURES = {
    "ours": {"never_lifted": 4.9, "not_held": 2.7, "slipped": 0.8},
    "squeeze": {"never_lifted": 23.8, "not_held": 12.0, "slipped": 8.3},
}
"""Share of all episodes by failure class [%]."""

POSE_ERROR = {(0.0, 0.0): 89.3, (10.0, 5.0): 80.4}
"""Success of the published policy by the errors of the object's pose that it names: moved by up to
[mm] and turned by up to [deg]."""

WITHOUT_GRASP = 4
"""Of 28 objects those without a pre-grasp."""

END_TO_END = 0.07
"""Success of its end-to-end baseline, one policy from home to the lift [%]."""

ALL_ELIGIBLE = (40.3, 29.8)
"""Success of policy and squeeze over all 24 objects that have a pre-grasp [%]."""
