"""Short loops, and sums of a few terms, at once or one after the other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry.loops import repeated, sum_over


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize("count", [1, 8, 23])
def test_sums_are_those_of_the_terms(monkeypatch, backend, count):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    powers = jnp.arange(1.0, 4.0)

    def sums(powers):
        return sum_over(count, lambda k: ((k + 1) * powers, k + 1.0, 2 * (k + 1)))

    for compute in (sums, jax.jit(sums)):
        a, b, c = compute(powers)
        total = sum(range(1, count + 1))
        np.testing.assert_allclose(a, total * np.array([1, 2, 3]))
        assert (float(b), int(c), c.dtype) == (total, 2 * total, jnp.int32)
    many = jax.vmap(sums)(jnp.stack([powers, 2 * powers]))
    np.testing.assert_allclose(many[0][1], 2 * many[0][0])


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_steps_follow_one_another(monkeypatch, backend, count):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)

    def after(start):
        return repeated(count, lambda s: {"x": 2.0 * s["x"] + 1.0, "steps": s["steps"] + 1}, start)

    begin = {"x": jnp.array([0.0, 3.0]), "steps": jnp.int32(0)}
    expected = (1.0 + np.array([0.0, 3.0])) * 2**count - 1.0
    for compute in (after, jax.jit(after)):
        found = compute(begin)
        np.testing.assert_allclose(found["x"], expected)
        assert int(found["steps"]) == count
    slope = jax.jit(jax.grad(lambda x: after({"x": x, "steps": jnp.int32(0)})["x"]))(1.0)
    assert float(slope) == 2**count
