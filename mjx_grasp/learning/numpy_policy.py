"""A policy without JAX, for the computer beside the robot: NumPy is all that it computes with."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mjx_grasp.errors import InputError
from mjx_grasp.learning.stored_policy import StoredPolicy


class NumpyPolicy(StoredPolicy):
    """A policy that answers in NumPy: `NumpyPolicy.load("policy.npz")(observation)`.

    Neither this module nor any that it needs imports JAX.
    """

    def __call__(self, obs: Float[np.ndarray, "*b d"]) -> Float[np.ndarray, "*b a"]:
        """Actions in ±1 for observations, as `Policy` gives them; float32.

        Raises:
            InputError: The observations are not finite, or not of as many numbers as the policy
                reads.
        """
        if np.shape(obs)[-1:] != (self.observation_size,):
            expected = f"{self.observation_size} numbers last, which the policy reads"
            raise InputError("obs", f"shape {np.shape(obs)}", expected)
        seen = np.asarray(obs, np.float32)
        if not np.isfinite(seen).all():
            raise InputError("obs", "numbers that are not finite", "finite ones")
        x = (seen - self.mean) / self.std
        *hidden, (last, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in hidden:
            x = x @ w + b
            x = np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))  # ELU
        return np.clip(x @ last + bias, -1.0, 1.0)
