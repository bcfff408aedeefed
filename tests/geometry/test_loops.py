"""A short loop gives the same however it is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.geometry.loops import short_loop


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
@pytest.mark.parametrize("count", [0, 1, 8, 10, 23])
def test_it_takes_each_step_once_in_order(backend, count, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)

    def step(number, state):
        digits, times = state
        return 2 * digits + number, times + 1

    def looped(begin):
        return short_loop(count, step, (begin, jnp.zeros(3, jnp.int32)))

    begin = jnp.arange(3)
    expected = np.arange(3)
    for number in range(count):
        expected = 2 * expected + number
    for run in (looped, jax.jit(looped), jax.vmap(lambda x: looped(x[None]))):
        digits, times = run(begin)
        np.testing.assert_array_equal(np.ravel(digits), expected)
        assert (np.asarray(times) == count).all()
