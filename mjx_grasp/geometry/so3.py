"""Rotations: quaternions w-x-y-z, matrices, exponential and logarithm, for any leading batch.

Conventions: a matrix R of a frame has the frame's axes as columns, v_world = R v_frame; rotation
vectors are axis times angle in rad. Small matrix products are elementwise sums, so that no
accelerator rounds them to TF32. Every function is differentiable where the rotation itself is,
and none returns NaN or infinite gradients at the identity.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

# Below this squared length the series are exact to 1e-13, and a division would spoil gradients.
_SMALL = 1e-4
# Below this sine of the angle between two opposite vectors their cross product is rounding.
_OPPOSITE = 1e-6


def product(
    a: Float[Array, "*#batch 3 3"], b: Float[Array, "*#batch 3 3"]
) -> Float[Array, "*batch 3 3"]:
    """``a b`` of matrices, written out: a reduction would end the fusion with what comes before."""
    parts = a[..., :, :, None] * b[..., None, :, :]
    return parts[..., 0, :] + parts[..., 1, :] + parts[..., 2, :]


def _hat(w: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """The matrix of v ↦ w × v."""
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    zero = jnp.zeros_like(x)
    rows = (zero, -z, y), (z, zero, -x), (-y, x, zero)
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def quat_mul(
    a: Float[Array, "*#batch 4"], b: Float[Array, "*#batch 4"]
) -> Float[Array, "*batch 4"]:
    """Hamilton product: the rotation b followed by a."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_rotate(
    q: Float[Array, "*#batch 4"], v: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch 3"]:
    """The vector v rotated by a unit quaternion."""
    w, u = q[..., :1], q[..., 1:]
    u, v = jnp.broadcast_arrays(u, v)
    turned = 2.0 * jnp.cross(u, v)
    return v + w * turned + jnp.cross(u, turned)


def quat_from_axis_angle(
    axis: Float[Array, "*#batch 3"], angle: Float[Array, "*#batch"] | float
) -> Float[Array, "*batch 4"]:
    """Unit quaternion of a turn by ``angle`` [rad] about a unit axis."""
    half = 0.5 * jnp.asarray(angle)[..., None]
    vector = jnp.sin(half) * axis
    return jnp.concatenate([jnp.broadcast_to(jnp.cos(half), (*vector.shape[:-1], 1)), vector], -1)


def quat_to_mat(q: Float[Array, "*batch 4"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of a quaternion of any length but zero."""
    w, x, y, z = (q[..., i] for i in range(4))
    s = 2.0 / jnp.sum(q * q, axis=-1)
    rows = (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def mat_to_quat(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 4"]:
    """Unit quaternion of a rotation matrix, with w ≥ 0.

    Of the four equivalent formulas (each divides by one component) the one with the largest
    divisor is taken, so that half turns are as accurate as any other rotation.
    """
    m = [[R[..., i, j] for j in range(3)] for i in range(3)]
    trace = m[0][0] + m[1][1] + m[2][2]
    # Row k is 4 q_k · q, with q_k the k-th component of the quaternion q.
    rows = jnp.stack(
        [
            jnp.stack(row, axis=-1)
            for row in (
                (1 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]),
                (m[2][1] - m[1][2], 1 + 2 * m[0][0] - trace, m[0][1] + m[1][0], m[0][2] + m[2][0]),
                (m[0][2] - m[2][0], m[0][1] + m[1][0], 1 + 2 * m[1][1] - trace, m[1][2] + m[2][1]),
                (m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1 + 2 * m[2][2] - trace),
            )
        ],
        axis=-2,
    )
    largest = jnp.argmax(jnp.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = jnp.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    q = row / jnp.sqrt(jnp.sum(row * row, axis=-1, keepdims=True))
    return jnp.where(q[..., :1] < 0, -q, q)


def exp(w: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    squared = jnp.sum(w * w, axis=-1)
    small = squared < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    half = jnp.sin(0.5 * angle) / (0.5 * angle)
    first = jnp.where(small, 1 - squared / 6 + squared**2 / 120, jnp.sin(angle) / angle)
    # (1 − cos a)/a² as ½ (sin(a/2)/(a/2))²: without cancellation.
    second = jnp.where(small, 0.5 - squared / 24 + squared**2 / 720, 0.5 * half * half)
    hat = _hat(w)
    identity = jnp.eye(3, dtype=w.dtype)
    return identity + first[..., None, None] * hat + second[..., None, None] * product(hat, hat)


def log(R: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3"]:
    """Rotation vector of a rotation matrix, of length in [0, π].

    Taken through the quaternion, where neither end is singular: angle = 2 atan2(|u|, w), with
    u the vector part. At a half turn both signs of the axis are right; one of them is returned.
    """
    q = mat_to_quat(R)
    w, u = q[..., 0], q[..., 1:]
    squared = jnp.sum(u * u, axis=-1)
    small = squared < _SMALL
    length = jnp.sqrt(jnp.where(small, 1.0, squared))
    # angle/|u| by its series in |u| near the identity (w ≥ 0): 2 asin(x)/x.
    series = 2.0 + squared / 3.0 + 0.15 * squared**2
    factor = jnp.where(small, series, 2.0 * jnp.arctan2(length, w) / length)
    return factor[..., None] * u


def align_vectors(
    a: Float[Array, "*#batch 3"], b: Float[Array, "*#batch 3"]
) -> Float[Array, "*batch 3 3"]:
    """The least rotation that takes the unit vector a to the unit vector b.

    For exactly opposite vectors, where the axis is free, it is a half turn about some normal of a.
    Obtuse angles are split into a half turn about the common normal, a to −a, and the acute rest:
    a is taken to b to full precision even where that normal is mostly rounding.
    """
    a, b = jnp.broadcast_arrays(a, b)
    obtuse = jnp.sum(a * b, axis=-1, keepdims=True) < 0
    start = jnp.where(obtuse, -a, a)
    normal = _common_normal(a, b)
    identity = jnp.eye(3, dtype=a.dtype)
    half_turn = 2.0 * normal[..., :, None] * normal[..., None, :] - identity
    first = jnp.where(obtuse[..., None], half_turn, identity)
    cosine = jnp.sum(start * b, axis=-1)[..., None, None]
    hat = _hat(jnp.cross(start, b))
    return product(identity + hat + product(hat, hat) / (1.0 + cosine), first)


def _common_normal(a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]) -> Array:
    """Unit vector exactly normal to a: along a × b, or anywhere if that vanishes."""
    cross = jnp.cross(a, b)
    defined = jnp.sum(cross * cross, axis=-1, keepdims=True) > _OPPOSITE**2
    # The coordinate axis that is least along a is far from parallel to it.
    other = jnp.eye(3, dtype=a.dtype)[jnp.argmin(jnp.abs(a), axis=-1)]
    normal = jnp.where(defined, cross / _length(cross, defined), other)
    normal = normal - jnp.sum(normal * a, axis=-1, keepdims=True) * a
    return normal / jnp.sqrt(jnp.sum(normal * normal, axis=-1, keepdims=True))


def _length(v: Float[Array, "*batch 3"], where: Array) -> Array:
    """Length of v where asked, else 1, with finite gradients in both cases."""
    return jnp.sqrt(jnp.where(where, jnp.sum(v * v, axis=-1, keepdims=True), 1.0))
