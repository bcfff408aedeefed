"""What is packed on the host comes back on the device; arrays are filled up to few sizes."""

import jax
import numpy as np

from mjx_grasp.geometry.packing import Layout, filled_size, pack, unpack_on_device

TREE = {
    "points": np.array([[0.1, -2.5, np.inf], [np.nan, -0.0, 3e-40]], np.float32),
    "faces": np.array([[-1, 2**31 - 1, 0]], np.int32),
    "valid": (np.array([True, False]), np.array(True)),
    "none": np.zeros((0, 3), np.float32),
}


def same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        assert x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()


def test_what_is_packed_comes_back_bit_for_bit():
    layout = Layout.of(TREE)
    words = pack(TREE)
    assert words.dtype == np.uint32 and words.ndim == 1
    same_bits(jax.jit(unpack_on_device, static_argnums=1)(words, layout), TREE)


def test_layouts_are_equal_if_their_trees_are_alike():
    assert Layout.of(TREE) == Layout.of(jax.tree.map(np.copy, TREE))
    assert hash(Layout.of(TREE)) == hash(Layout.of(jax.tree.map(np.copy, TREE)))
    assert Layout.of(TREE) != Layout.of({**TREE, "none": np.zeros((1, 3), np.float32)})


def test_sizes_are_few_and_fill_up_by_little():
    sizes = np.unique(np.geomspace(1, 1e6, 5000).astype(int))
    filled = np.array([filled_size(int(n)) for n in sizes])
    assert np.all(filled >= sizes) and np.all(np.diff(filled) >= 0)
    assert np.all(filled - sizes <= np.maximum(512, sizes / 8)) and len(set(filled)) < 120
