"""Parametric stand-ins for all objects of the catalogue, from their published dimensions.

Where the published dimensions and the public scans disagree (drill, airplane, banana, clamp,
mustard bottle, soccer ball), the scan's extents are taken. Hollow objects have inner walls;
handles and the parts of tools are closed components that overlap the body.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from mjx_grasp.errors import InputError
from mjx_grasp.objects.meshes import centred
from mjx_grasp.objects.shapes import (
    arc,
    capsule,
    ellipsoid,
    joined,
    lathe,
    loft,
    rounded_box,
    set_at,
    smooth,
    swept,
)

_VERTICES = 2000
"""About how many vertices a stand-in gets."""


def stand_in(name: str, scale: float = 1.0) -> trimesh.Trimesh:
    """The stand-in of an object in its object frame [m], axis-aligned box centred at the origin.

    Args:
        name: The object's name without a suffix for its scale.
        scale: Uniform scale.

    Raises:
        InputError: There is no stand-in of this name.
    """
    if name not in _SHAPES:
        raise InputError("object", name, f"one of {', '.join(sorted(_SHAPES))}")
    return centred(_SHAPES[name](), scale)


def _edge(*extents: float) -> float:
    """Edge length that gives a box of these extents about `_VERTICES` vertices [m]."""
    x, y, z = extents
    return float(np.sqrt(2.0 * (x * y + y * z + z * x) / _VERTICES))


def _box(x: float, y: float, z: float, radius: float = 0.003) -> trimesh.Trimesh:
    return rounded_box((x, y, z), radius, _edge(x, y, z))


def _can(radius: float, height: float, rim: float = 0.0015) -> trimesh.Trimesh:
    """A closed can with rounded rims."""
    edge = _edge(2 * radius, 2 * radius, height)
    bottom = arc((radius - rim, rim), rim, -90, 0)
    top = arc((radius - rim, height - rim), rim, 0, 90)
    return lathe(np.concatenate([[[0.0, 0.0]], bottom, top, [[0.0, height]]]), edge)


def _ball(radius: float) -> trimesh.Trimesh:
    return ellipsoid((radius, radius, radius))


def _tube(
    points: list[list[float]],
    radius: float,
    edge: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> trimesh.Trimesh:
    path = smooth(points)
    return swept(path, radius, radius, edge, up=up)


def _potted_meat_can() -> trimesh.Trimesh:
    rim = 0.002
    half = (0.0485, 0.025)
    rows = [
        (0.0, half[0] - rim, half[1] - rim),
        (rim, *half),
        (0.082 - rim, *half),
        (0.082, half[0] - rim, half[1] - rim),
    ]
    return loft(np.array([(0.0, 0.0, 0.0), *rows, (0.082, 0.0, 0.0)]), 0.0042, exponent=5.0)


def _pitcher_base() -> trimesh.Trimesh:
    wall, height, edge = 0.004, 0.235, 0.011
    profile = [
        (0.0, 0.0),
        (0.052, 0.0),
        (0.054, 0.003),
        (0.054, height),
        (0.054 - wall, height),
        (0.050 - wall, wall),
        (0.0, wall),
    ]
    body = lathe(np.array(profile), edge)
    handle = _tube(
        [
            [0.050, 0, 0.205],
            [0.078, 0, 0.208],
            [0.094, 0, 0.175],
            [0.090, 0, 0.110],
            [0.074, 0, 0.070],
            [0.050, 0, 0.066],
        ],
        0.008,
        0.006,
        up=(0.0, 1.0, 0.0),
    )
    # The handle stands where the scan has it.
    return set_at(joined(body, handle), degrees=138.0)


def _mustard_bottle() -> trimesh.Trimesh:
    rows = [
        (0.0, 0.0, 0.0),
        (0.0, 0.040, 0.023),
        (0.006, 0.0475, 0.029),
        (0.115, 0.0475, 0.029),
        (0.140, 0.030, 0.024),
        (0.150, 0.017, 0.017),
        (0.165, 0.016, 0.016),
        (0.170, 0.011, 0.011),
        (0.186, 0.006, 0.006),
        (0.190, 0.004, 0.004),
        (0.190, 0.0, 0.0),
    ]
    return loft(np.array(rows), 0.0055, exponent=2.6)


def _bleach_cleanser() -> trimesh.Trimesh:
    rows = [
        (0.0, 0.0, 0.0),
        (0.0, 0.044, 0.028),
        (0.006, 0.049, 0.0325),
        (0.140, 0.049, 0.0325),
        (0.180, 0.040, 0.028),
        (0.210, 0.022, 0.022),
        (0.220, 0.019, 0.019),
        (0.247, 0.019, 0.019),
        (0.250, 0.016, 0.016),
        (0.250, 0.0, 0.0),
    ]
    return loft(np.array(rows), 0.0068, exponent=3.0)


def _bowl() -> trimesh.Trimesh:
    outer, height, wall = 0.0795, 0.053, 0.003
    profile = [
        (0.0, 0.0),
        (0.030, 0.0),
        (0.050, 0.010),
        (0.070, 0.031),
        (outer, height),
        (outer - wall, height),
        (0.067, 0.033),
        (0.048, 0.013),
        (0.030, wall),
        (0.0, wall),
    ]
    return lathe(np.array(profile), 0.0055)


def _mug() -> trimesh.Trimesh:
    radius, height, wall = 0.040, 0.082, 0.003
    profile = [
        (0.0, 0.0),
        (radius - 0.002, 0.0),
        (radius, 0.002),
        (radius, height),
        (radius - wall, height),
        (radius - wall, 0.005),
        (0.0, 0.005),
    ]
    handle = _tube(
        [
            [0.038, 0, 0.066],
            [0.058, 0, 0.068],
            [0.066, 0, 0.045],
            [0.058, 0, 0.020],
            [0.038, 0, 0.018],
        ],
        0.0055,
        0.004,
        up=(0.0, 1.0, 0.0),
    )
    return set_at(joined(lathe(np.array(profile), 0.0062), handle), degrees=-39.0)


def _wine_glass() -> trimesh.Trimesh:
    profile = [
        (0.0, 0.0),
        (0.033, 0.0),
        (0.033, 0.002),
        (0.006, 0.006),
        (0.004, 0.012),
        (0.004, 0.060),
        (0.020, 0.066),
        (0.040, 0.085),
        (0.0445, 0.105),
        (0.040, 0.137),
        (0.0385, 0.137),
        (0.043, 0.105),
        (0.0385, 0.086),
        (0.019, 0.068),
        (0.0, 0.064),
    ]
    return lathe(np.array(profile), 0.0050)


def _banana() -> trimesh.Trimesh:
    angle = np.radians(np.linspace(-52, 52, 25))
    path = np.stack([0.125 * np.sin(angle), 0.125 * np.cos(angle), 0 * angle], axis=1)
    along = np.abs(np.linspace(-1, 1, 25))
    radius = 0.018 * np.sqrt(np.maximum(1.0 - along**4, 0.03))
    return swept(path, radius, radius, 0.0042)


def _pear() -> trimesh.Trimesh:
    z = np.linspace(0.0, np.pi, 25)
    height = 0.05 * (1 - np.cos(z))
    radius = np.sin(z) * (0.0331 - 0.012 * (height / 0.1 - 0.25))
    radius *= 0.0331 / radius.max()
    upright = lathe(np.column_stack([radius, height]), 0.0042)
    return set_at(upright, axis=(0.0, 1.0, 0.0), degrees=90.0)


def _power_drill() -> trimesh.Trimesh:
    barrel = capsule((-0.062, 0.065, 0), (0.060, 0.065, 0), 0.027, 0.0075)
    chuck = capsule((0.060, 0.065, 0), (0.077, 0.065, 0), 0.016, 0.006)
    grip = set_at(_box_at(0.042, 0.125, 0.036), (-0.040, 0.004, 0))
    battery = set_at(_box_at(0.085, 0.040, 0.0565), (-0.030, -0.072, 0))
    return joined(barrel, chuck, grip, battery)


def _box_at(x: float, y: float, z: float) -> trimesh.Trimesh:
    return rounded_box((x, y, z), 0.006, 0.009)


def _toy_airplane() -> trimesh.Trimesh:
    fuselage = capsule((-0.095, 0, 0), (0.095, 0, 0), 0.0355, 0.012)
    wing = set_at(rounded_box((0.070, 0.2547, 0.016), 0.005, 0.012), (0.025, 0, 0.030))
    tail = set_at(rounded_box((0.045, 0.120, 0.012), 0.004, 0.012), (-0.100, 0, 0.020))
    fin = set_at(rounded_box((0.045, 0.012, 0.090), 0.004, 0.012), (-0.100, 0, 0.070))
    gear = set_at(rounded_box((0.030, 0.070, 0.040), 0.008, 0.010), (0.040, 0, -0.050))
    return joined(fuselage, wing, tail, fin, gear)


def _large_clamp() -> trimesh.Trimesh:
    z = 0.034
    jaws = [
        _arm([(0.000, 0.010), (-0.045, 0.020), (-0.078, 0.006)], z),
        _arm([(0.000, -0.010), (-0.045, -0.020), (-0.078, -0.006)], z),
        _arm([(0.000, 0.010), (0.040, -0.030), (0.076, -0.055)], z),
        _arm([(0.000, -0.010), (0.040, 0.030), (0.076, 0.055)], z),
    ]
    spring = set_at(_can(0.014, 0.036), (0.0, 0.0, -0.018))
    return joined(*jaws, spring)


def _arm(points: list[tuple[float, float]], height: float) -> trimesh.Trimesh:
    path = smooth([(x, y, 0.0) for x, y in points], 12)
    return swept(path, 0.006, height / 2, 0.007, exponent=4.0)


_SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "potted_meat_can": _potted_meat_can,
    "master_chef_can": lambda: _can(0.051, 0.139),
    "rubiks_cube": lambda: _box(0.057, 0.057, 0.057, 0.002),
    "sugar_box": lambda: _box(0.089, 0.038, 0.175),
    "apple": lambda: _ball(0.0375),
    "tomato_soup_can": lambda: _can(0.033, 0.101),
    "foam_brick": lambda: _box(0.075, 0.050, 0.050),
    "pitcher_base": _pitcher_base,
    "mustard_bottle": _mustard_bottle,
    "cracker_box": lambda: _box(0.158, 0.060, 0.210),
    "pudding_box": lambda: _box(0.110, 0.089, 0.035),
    "gelatin_box": lambda: _box(0.085, 0.073, 0.028),
    "tuna_fish_can": lambda: _can(0.0425, 0.033),
    "chips_can": lambda: _can(0.0375, 0.250),
    "banana": _banana,
    "bowl": _bowl,
    "mug": _mug,
    "bleach_cleanser": _bleach_cleanser,
    "power_drill": _power_drill,
    "wood_block": lambda: _box(0.085, 0.085, 0.200, 0.002),
    "mini_soccer_ball": lambda: _ball(0.0635),
    "softball": lambda: _ball(0.048),
    "baseball": lambda: _ball(0.0375),
    "tennis_ball": lambda: _ball(0.03235),
    "racquetball": lambda: _ball(0.02765),
    "golf_ball": lambda: _ball(0.02135),
    "toy_airplane": _toy_airplane,
    "large_clamp": _large_clamp,
    "wine_glass": _wine_glass,
    "lemon": lambda: ellipsoid((0.034, 0.027, 0.027)),
    "pear": _pear,
    "orange": lambda: _ball(0.0365),
    "peach": lambda: _ball(0.0295),
}
