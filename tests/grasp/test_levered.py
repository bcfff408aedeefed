"""Grasps of thin walls beside the centre of mass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry import so3
from mjx_grasp.geometry.vectors import dot, unit
from mjx_grasp.grasp.candidates import Candidates
from mjx_grasp.grasp.levered import LEVER_M, THIN_M, levered
from mjx_grasp.grasp.wrench_margin import ContactConfig, Load, holding_force

UP = jnp.array([[0.0, 0.0, 1.0]])
COM = jnp.array([-0.08, 0.0, 0.0])


def wall(width=0.003, score=0.5):
    """Both sides of an upright plate in the plane of y and z, every 3 mm; thumbs on −x first."""
    y, z = np.meshgrid(np.arange(-0.03, 0.031, 0.003), np.arange(-0.03, 0.031, 0.003))
    plane = np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1)
    sides = []
    for sign in (-1.0, 1.0):
        out = np.tile([sign, 0.0, 0.0], (len(plane), 1))
        thumb, across = plane + 0.5 * width * out, plane - 0.5 * width * out
        apart = np.array([0.0, 0.01, 0.0])
        sides.append((thumb, out, np.stack([across + apart, across - apart], 1), -out, -out))
    thumb, normal, wrap, wrap_normal, axis = (
        jnp.asarray(np.concatenate(leaf), jnp.float32) for leaf in zip(*sides, strict=True)
    )
    count = len(thumb)
    ones = jnp.ones(count)
    return Candidates(thumb, normal, wrap, wrap_normal, axis, width * ones, score * ones, ones > 0)


def some(candidates, rows):
    return jax.tree.map(lambda leaf: leaf[jnp.asarray(rows)], candidates)


def middle(candidates):
    """The candidate in the middle of each side."""
    half = len(candidates.score) // 2
    return [half // 2, half + half // 2]


def test_the_thumb_is_higher_on_the_side_of_the_centre_of_mass_and_lower_on_the_other():
    all_ = wall()
    bases = some(all_, middle(all_))
    made = levered(bases, all_, COM, UP)
    assert made.valid.all()
    moved = np.asarray(made.thumb - bases.thumb)
    np.testing.assert_allclose(moved, [[0, 0, LEVER_M], [0, 0, -LEVER_M]], atol=1e-6)
    for name in ("normal", "wrap", "wrap_normal", "axis", "width", "score"):
        np.testing.assert_allclose(getattr(made, name), getattr(bases, name), atol=1e-6)


def test_of_a_plate_that_is_held_from_above_and_below_the_lower_one_moves_to_the_centre_of_mass():
    all_ = wall()
    up = jnp.array([[1.0, 0.0, 0.0]])  # thumbs on −x press upwards
    com = jnp.array([0.0, 0.0, -0.08])
    made = levered(some(all_, middle(all_)), all_, com, up)
    moved = np.asarray(made.thumb - all_.thumb[jnp.array(middle(all_))])
    np.testing.assert_allclose(moved, [[0, 0, -LEVER_M], [0, 0, LEVER_M]], atol=1e-6)


def test_it_takes_far_less_force_to_hold_the_object():
    all_ = wall()
    bases = some(all_, middle(all_))
    load = Load(jnp.array([0.0, 0.0, -1.5]), COM)

    def force(candidates):
        spread = jnp.array([0.0, 0.02, 0.0])
        c = candidates.centre
        contacts = jnp.stack([candidates.thumb, c + spread, c - spread], axis=1)
        normals = jnp.stack([candidates.normal, *[candidates.wrap_normal] * 2], axis=1)
        config = ContactConfig(friction=0.6)
        return np.asarray(
            jax.vmap(lambda at, n: holding_force(at, -n, load, config))(contacts, normals)
        )

    straight, moved = force(bases), force(levered(bases, all_, COM, UP))
    assert np.all(moved < 0.15 * straight)
    # What is left is the weight's moment over the lever, and a little for the weight itself.
    np.testing.assert_allclose(moved, 1.5 * 0.08 / LEVER_M, rtol=0.2)


def test_each_base_has_one_for_each_direction_in_its_order():
    all_ = wall()
    ups = jnp.concatenate([UP, -UP, jnp.array([[0.0, 1.0, 0.0]])])
    bases = some(all_, [*middle(all_), 0])
    made = levered(bases, all_, COM, ups)
    one_by_one = [levered(some(bases, [k]), all_, COM, up[None]) for k in range(3) for up in ups]
    expected = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *one_by_one)
    jax.tree.map(np.testing.assert_array_equal, made, expected)


@pytest.mark.parametrize(
    ("change", "com", "up"),
    [
        ({"width": THIN_M * 1.01}, COM, UP),
        ({}, jnp.array([-0.017, 0.0, 0.0]), UP),  # no moment to speak of
        ({}, COM, jnp.array([[1.0, 0.0, 0.0]])),  # it hangs straight down
    ],
)
def test_no_thin_wall_or_no_moment_makes_none(change, com, up):
    all_ = wall(**change)
    made = levered(some(all_, middle(all_)), all_, com, up)
    assert not made.valid.any() and not made.score.any()
    assert np.isfinite(np.asarray(made.thumb)).all()


def test_there_has_to_be_a_wall_where_the_thumb_moves_and_the_base_has_to_be_valid():
    all_ = wall()
    top = int(jnp.argmax(all_.thumb[:, 2] - all_.thumb[:, 0]))  # upper edge, on −x
    assert not levered(some(all_, [top]), all_, COM, UP).valid.any()
    bases = some(all_, middle(all_))
    assert not levered(bases._replace(valid=jnp.zeros(2, bool)), all_, COM, UP).valid.any()
    hole = all_._replace(valid=all_.valid & (jnp.abs(all_.thumb[:, 2]) < 0.008))
    assert not levered(bases, hole, COM, UP).valid.any()
    # The other side of the wall, 3 mm away, is not where the thumb goes.
    apart = dot(levered(bases, all_, COM, UP).normal, bases.normal)
    np.testing.assert_allclose(apart, 1.0)


def test_a_turned_object_has_turned_candidates():
    all_, R = wall(), so3.exp(jnp.array([0.3, -0.8, 0.5]))
    bases = some(all_, middle(all_))

    def turn(c):
        directions = ("thumb", "normal", "wrap", "wrap_normal", "axis")
        return c._replace(**{name: getattr(c, name) @ R.T for name in directions})

    made = levered(bases, all_, COM, UP)
    turned = levered(turn(bases), turn(all_), R @ COM, UP @ R.T)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), turned, turn(made))
    np.testing.assert_allclose(unit(turned.axis), turned.axis, atol=1e-5)


def test_it_compiles():
    all_ = wall()
    bases = some(all_, middle(all_))
    eager, compiled = levered(bases, all_, COM, UP), jax.jit(levered)(bases, all_, COM, UP)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), eager, compiled)
