"""The iterations as a kernel of a GPU, which Pallas can also interpret without one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.reaching.admm import Splitting, in_one_kernel, iterated

COUNT, N, BATCH = 27, 158, 3
"""variables and bounded numbers of a reach: neither is a power of two"""


@pytest.fixture(scope="module")
def problems():
    """Some at random, with finite and infinite bounds, and what their iterations start from."""
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(BATCH, N - COUNT, COUNT))
    rows /= np.linalg.norm(rows, axis=2, keepdims=True)
    both = np.concatenate([np.broadcast_to(np.eye(COUNT), (BATCH, COUNT, COUNT)), rows], axis=1)
    there = np.swapaxes(both, 1, 2)
    inverse = np.linalg.inv(1.5 * np.eye(COUNT) + there @ both)
    splitting = Splitting(
        there=there,
        back=both @ inverse,
        begin=rng.normal(size=(BATCH, N)),
        least=rng.uniform(-1.0, 0.0, (BATCH, N)),
        most=np.where(np.arange(N) < COUNT, rng.uniform(0.0, 1.0, (BATCH, N)), np.inf),
    )
    start = rng.normal(size=(2, BATCH, N))
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), (splitting, *start))


@pytest.mark.parametrize("count", [1, 7, 50])
def test_the_kernel_does_what_the_loop_does(problems, count):
    kernel = jax.vmap(lambda s, c, d: in_one_kernel(s, c, d, 1.6, count, interpret=True))
    loop = jax.vmap(lambda s, c, d: iterated(s, c, d, 1.6, count))
    for found, wanted in zip(kernel(*problems), loop(*problems), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_one_iteration_against_the_formulas(problems):
    """In float64: with what is free of its bounds no multiplier is left."""
    splitting, copy, dual = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64)[0], problems)
    found = splitting.begin + splitting.back @ (splitting.there @ (copy - dual))
    relaxed = 1.6 * found - 0.6 * copy
    wanted = np.clip(relaxed + dual, splitting.least, splitting.most)
    of_one = jax.tree.map(lambda leaf: leaf[0], problems)
    new, multiplier = iterated(*of_one, 1.6, 1)
    np.testing.assert_allclose(new, wanted, atol=1e-5)
    np.testing.assert_allclose(multiplier, dual + relaxed - wanted, atol=1e-5)
    free = (wanted > splitting.least) & (wanted < splitting.most)
    assert 20 < free.sum() < N - 20
    np.testing.assert_allclose(np.asarray(multiplier)[free], 0.0, atol=1e-5)


def test_triton_knows_the_kernel(problems):
    """Everything but the last step, which takes a GPU: for many problems, and for one."""

    def kernel(splitting, copy, dual):
        return in_one_kernel(splitting, copy, dual, 1.6, 50)

    for function, given in (
        (jax.vmap(kernel), problems),
        (kernel, jax.tree.map(lambda leaf: leaf[0], problems)),
    ):
        lowered = jax.jit(function).trace(*given).lower(lowering_platforms=("cuda",))
        assert "triton" in lowered.as_text()
