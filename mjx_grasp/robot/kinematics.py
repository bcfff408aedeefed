"""Forward kinematics and Jacobians in JAX, from any compiled MuJoCo model of hinges and slides.

A pass goes through the depths of the tree: all fingers advance together, in as many small steps
as the longest chain has joints. Products of 3x3 matrices are written as sums of elementwise
products: they fuse across a large batch, and no accelerator rounds them to TF32, as it does with
dot products by default.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_grasp.geometry.so3 import product
from mjx_grasp.geometry.vectors import turned
from mjx_grasp.robot.chains import Chains, compile_chains


class Motion(NamedTuple):
    """Where the frames are, and how each joint moves whatever is fixed to what it carries.

    Attributes:
        pos: ``[frames, 3]`` origins in world, [m].
        mat: ``[frames, 3, 3]`` rotations; columns are the frame's axes.
        screws: ``[joints, 6]`` the joints' axes ω (zero for a slide), then the velocity at the
            world's origin of a body turning or sliding with them. A point p that joint j moves has
            velocity ``ω_j × p + v_j`` per unit of joint velocity; along a direction n that is
            ``screws[j] · (p × n, n)``.
    """

    pos: Float[Array, "frames 3"]
    mat: Float[Array, "frames 3 3"]
    screws: Float[Array, "joints 6"]


@jax.tree_util.register_static
@dataclass(frozen=True, eq=False)
class Kinematics:
    """Kinematics of some frames of a model; static under jit, its methods work under vmap.

    A configuration q holds the model's hinge and slide joints in model order (rad or m); free
    and ball joints are no part of it and must not carry a requested frame.
    """

    chains: Chains

    @classmethod
    def from_model(
        cls, model: mujoco.MjModel, sites: Sequence[str] = (), bodies: Sequence[str] = ()
    ) -> Kinematics:
        """Kinematics of the named sites, then bodies (their frames, not their centres of mass).

        Raises:
            InputError: A name is unknown, nothing is asked for, or a free or ball joint is in a
                frame's chain.
        """
        return cls(compile_chains(model, sites, bodies))

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames, in the order of the results."""
        return self.chains.frame_names

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the order of q."""
        return self.chains.joint_names

    @property
    def moves(self) -> Bool[np.ndarray, "frames joints"]:
        """Whether a joint moves a frame."""
        moves = np.zeros((len(self.frames), len(self.joints)), bool)
        moves[:, self.chains.column] = self.chains.moves
        return moves

    @partial(jax.jit, static_argnums=0)
    def motion(self, q: Float[Array, " joints"]) -> Motion:
        """Frames and joint screws from one pass; rows of any point's Jacobian are dot products."""
        chains = self.chains
        node_pos, node_mat = self._nodes(q)
        parent_mat = node_mat[chains.parent]
        axis = turned(parent_mat, _constant(chains.axis, q))
        anchor = node_pos[chains.parent] + turned(parent_mat, _constant(chains.anchor, q))
        hinge = jnp.asarray(chains.hinge)[:, None]
        angular = jnp.where(hinge, axis, 0.0)
        linear = jnp.where(hinge, jnp.cross(anchor, axis), axis)
        screws = jnp.zeros((len(self.joints), 6), q.dtype)
        screws = screws.at[chains.column].set(jnp.concatenate([angular, linear], axis=-1))
        return Motion(*self._frames(node_pos, node_mat), screws)

    def forward(
        self, q: Float[Array, " joints"]
    ) -> tuple[Float[Array, "frames 3"], Float[Array, "frames 3 3"]]:
        """Origins [m] and rotations (columns are the frame's axes) of the frames, in the world."""
        return self._frames(*self._nodes(q))

    def _nodes(
        self, q: Float[Array, " joints"]
    ) -> tuple[Float[Array, "nodes 3"], Float[Array, "nodes 3 3"]]:
        """Origins and rotations of the chains' nodes: the world, then joint by joint."""
        chains = self.chains
        s = q[chains.column] - _constant(chains.reference, q)
        cos, sin = jnp.cos(s)[:, None, None], jnp.sin(s)[:, None, None]
        # A slide has no cosine and sine part, a hinge is displaced by its offset alone.
        mat = (
            _constant(chains.fixed, q)
            + cos * _constant(chains.cosine, q)
            + sin * _constant(chains.sine, q)
        )
        slid = jnp.where(jnp.asarray(chains.hinge), 0.0, s)[:, None] * _constant(chains.axis, q)
        pos = _constant(chains.anchor, q) + slid - turned(mat, _constant(chains.offset, q))

        level_pos, level_mat = [jnp.zeros((1, 3), q.dtype)], [jnp.eye(3, dtype=q.dtype)[None]]
        first = 0
        for level in chains.levels:
            parent = chains.parent[level] - first
            first += len(level_pos[-1])
            above_pos, above_mat = level_pos[-1][parent], level_mat[-1][parent]
            level_pos.append(above_pos + turned(above_mat, pos[level]))
            level_mat.append(product(above_mat, mat[level]))
        return jnp.concatenate(level_pos), jnp.concatenate(level_mat)

    def _frames(
        self, node_pos: Float[Array, "nodes 3"], node_mat: Float[Array, "nodes 3 3"]
    ) -> tuple[Float[Array, "frames 3"], Float[Array, "frames 3 3"]]:
        """The frames on their nodes."""
        pos, mat = node_pos[self.chains.frame_node], node_mat[self.chains.frame_node]
        return (
            pos + turned(mat, _constant(self.chains.frame_pos, pos)),
            product(mat, _constant(self.chains.frame_mat, mat)),
        )


def _constant(value: np.ndarray, like: Array) -> Array:
    return jnp.asarray(value, like.dtype)
