"""YAML without keys that stand twice, and otherwise as everybody reads it."""

import pytest
import yaml

from mjx_grasp.records.strict_yaml import load_yaml

MERGED = "a: &a {x: 1, y: 2}\nb: &b {<<: *a, x: 3}\nc: {z: 4, <<: *b}"
NESTED = "base: &base {k: 1, z: 0}\na: {deep: {x: &x {<<: *base, k: 2}}}\nb: {<<: *x, q: 1}"


@pytest.mark.parametrize(
    "text", ["", "a", "[1, 2.5]", "a: {b: [1], c: x}\nd: null", "1: a\n2: b", MERGED, NESTED]
)
def test_what_is_read_is_what_it_says(text):
    assert load_yaml(text) == yaml.safe_load(text)


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\na: 2",
        "x: {b: 1, c: 2, b: 3}",
        "- {1: a, 1: b}",
        "<<: {a: 1}\na: 2\na: 3",
        "{<<: {a: 1}, <<: {b: 2}}",
    ],
)
def test_a_key_that_stands_twice_is_refused(text):
    with pytest.raises(yaml.YAMLError, match="stands twice"):
        load_yaml(text)
