"""Of many worlds, those that need something."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjx_grasp.pipeline import worlds
from mjx_grasp.pipeline.worlds import for_those


@pytest.fixture(params=["cpu", "gpu", "gpu, few"])
def backend(request, monkeypatch):
    """As it is computed on either, of many worlds or few."""
    device, _, few = request.param.partition(", ")
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    monkeypatch.setattr(worlds, "_FEW", 64 if few else 0)
    return request.param


# Few sizes, as each is compiled for itself.
needs = st.sampled_from((1, 7, 16, 40)).flatmap(
    lambda worlds: st.lists(st.booleans(), min_size=worlds, max_size=worlds)
)


def square(row):
    return {"a": row**2, "b": jnp.stack([row, row + 1.0])}


@cache
def jitted(backend, cheap):
    """Compiled once for each size."""
    return jax.jit(lambda need, rows, had: for_those(need, square, rows, had, cheap))


@pytest.mark.parametrize("cheap", [False, True])
@given(needs)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_those_that_need_it_get_it_and_the_others_keep_theirs(backend, cheap, need):
    need, rows = np.array(need), np.arange(len(need))
    had = {"a": -rows, "b": np.zeros((len(need), 2), np.float32)}
    found = jitted(backend, cheap)(need, rows, had)
    everyone = np.stack([rows, rows + 1.0], axis=1)
    np.testing.assert_array_equal(found["a"], np.where(need, rows**2, -rows))
    np.testing.assert_array_equal(found["b"], np.where(need[:, None], everyone, 0.0))


@pytest.mark.parametrize(
    ("needy", "on_cpu", "on_gpu", "of_few"),
    [
        (0, 0, 0, 0),
        (1, 4, 4, 64),
        (4, 4, 4, 64),
        (5, 8, 16, 64),
        (16, 16, 16, 64),
        (17, 20, 64, 64),
        (64, 64, 64, 64),
    ],
)
def test_it_is_computed_as_often_as_needed(backend, needy, on_cpu, on_gpu, of_few):
    """In parts of a sixteenth; on a GPU at once, a sixteenth, a fourth or all of them."""
    sizes = []

    def compute(row):
        jax.debug.callback(lambda row: sizes.append(int(row)), row)
        return row

    def run(need):
        return for_those(need, compute, jnp.arange(64), jnp.full(64, -1))

    jax.jit(run)(jnp.arange(64) >= 64 - needy).block_until_ready()
    jax.effects_barrier()
    assert len(sizes) == {"cpu": on_cpu, "gpu": on_gpu, "gpu, few": of_few}[backend]
