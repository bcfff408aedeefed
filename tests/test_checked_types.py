"""In the tests, shapes and types are checked in every module that says shapes."""

import inspect
import re
from importlib import import_module

import jax.numpy as jnp
import pytest
from checked import CHECKED, MODULES
from jaxtyping import TypeCheckError

from mjx_grasp.geometry.so3 import exp


def functions(module):
    """The annotated functions and methods that are written in a module, as they are called."""
    classes = [c for _, c in inspect.getmembers(module, inspect.isclass)]
    for owner in (module, *(c for c in classes if c.__module__ == module.__name__)):
        for found in vars(owner).values():
            for part in ("fget", "func", "__func__"):  # of properties, cached ones, class methods
                found = getattr(found, part, found)
            written = inspect.unwrap(found) if callable(found) else None
            code = getattr(written, "__code__", None)
            if code and code.co_filename == module.__file__ and written.__annotations__:
                yield found, written


def is_checked(function):
    """Whether one of the wrappers around a function is that of jaxtyping."""
    while function is not None:
        if getattr(function, "__globals__", {}).get("__name__") == "jaxtyping._decorator":
            return True
        function = getattr(function, "__wrapped__", None)
    return False


def test_kernels_and_what_says_no_shape_are_left_out():
    kernels = {name for name, path in MODULES.items() if "@wp.kernel" in path.read_text()}
    left_out = MODULES.keys() - set(CHECKED)
    assert kernels and kernels <= left_out
    for name in left_out - kernels:
        for _, written in functions(import_module(name)):
            assert not re.search(r"(Float|Int|Bool|Shaped)\[", str(written.__annotations__)), name


@pytest.mark.parametrize("name", CHECKED)
def test_every_function_is_checked(name):
    for function, written in functions(import_module(name)):
        assert is_checked(function), written.__qualname__


@pytest.mark.parametrize("name", CHECKED)
def test_annotations_of_arrays_can_be_read(name):
    """What cannot be read when the module is imported is not checked at all."""
    for _, written in functions(import_module(name)):
        for annotation in written.__annotations__.values():
            if isinstance(annotation, str) and ("Array" in annotation or "ndarray" in annotation):
                eval(annotation, written.__globals__)


def test_what_has_another_shape_is_refused():
    assert exp(jnp.ones(3)).shape == (3, 3)
    with pytest.raises(TypeCheckError, match=r"f32\[4\]"):
        exp(jnp.ones(4))
