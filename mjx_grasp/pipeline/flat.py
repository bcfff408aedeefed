"""`Grasper.tick` for the control loop of one robot, where every microsecond of a tick counts.

What a compiled function takes and returns costs time for every array, however small, and the state
of a grasp is some eighty of them. Here it is one vector.
"""

from __future__ import annotations

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.state import GraspState, GraspTick, Known, Seen
from mjx_grasp.robot.interface import Measured


class FlatTick:
    """A grasper's compiled tick, between states as vectors.

    Args:
        grasper: The controller.
        state: Any of its states, as from `Grasper.start`; all others have to be of its shapes.
    """

    def __init__(self, grasper: Grasper, state: GraspState):
        vector, unravel = ravel_pytree(state)
        leaves, self._tree = jax.tree.flatten(state)
        self._leaves = [(leaf.shape, leaf.dtype) for leaf in leaves]
        self._ends = np.cumsum([leaf.size for leaf in leaves])[:-1]
        self._size = vector.size

        def tick(
            vector: Array, measured: Measured, known: Known, seen: Seen
        ) -> tuple[Array, GraspTick]:
            after, done = grasper.tick(unravel(vector), measured, known, seen)
            return ravel_pytree(after)[0], done

        self._tick = jax.jit(tick)

    def __call__(
        self, vector: Float[Array, " s"], measured: Measured, known: Known, seen: Seen
    ) -> tuple[Float[Array, " s"], GraspTick]:
        """One control period, as `Grasper.tick`; the first call compiles.

        Args:
            vector: From :meth:`flat` or the last tick.
            measured: Now.
            known: The object.
            seen: Where it is now, what touches, what is in the way.
        """
        return self._tick(vector, measured, known, seen)

    def flat(self, state: GraspState) -> Float[Array, " s"]:
        """A state as a vector.

        Args:
            state: Of the shapes of the first.

        Raises:
            ValueError: If it is of other shapes.
        """
        vector = ravel_pytree(state)[0]
        if vector.size != self._size:
            raise ValueError(f"a state of {vector.size} numbers, expected one of {self._size}")
        return vector

    def state(self, vector: Float[Array, " s"]) -> GraspState:
        """The state that a vector is, in NumPy's arrays.

        Args:
            vector: From :meth:`flat` or a tick.
        """
        parts = np.split(np.asarray(vector), self._ends)
        leaves = [
            part.reshape(shape).astype(dtype)
            for part, (shape, dtype) in zip(parts, self._leaves, strict=True)
        ]
        return jax.tree.unflatten(self._tree, leaves)
