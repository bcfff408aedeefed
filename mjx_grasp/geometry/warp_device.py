"""NVIDIA Warp on JAX's device: its start, kernels, arrays, and threads on a CPU.

Warp takes half a second to import: import this module, and what it is used by, where it is needed.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType
from typing import Any, TypeVar

import jax
import numpy as np
import warp as wp

from mjx_grasp.records.provenance import usable_cores

S = TypeVar("S")
T = TypeVar("T")


@functools.cache
def device() -> Any:
    """Warp's name for JAX's device; the first call starts Warp, quietly."""
    return _quietly(_started)


@functools.cache
def load(module: ModuleType) -> None:
    """Compiles the kernels of a module, or takes them from Warp's cache, quietly."""
    at = device()
    _quietly(lambda: wp.load_module(module, device=at))


def put(array: np.ndarray, dtype: Any) -> wp.array:
    """An array of NumPy as one of Warp on the device."""
    return wp.array(np.ascontiguousarray(array), dtype=dtype, device=device())


def launch(kernel: Any, count: int | Sequence[int], inputs: list[Any]) -> None:
    """Runs a kernel to its end, in this thread if the device is a CPU."""
    wp.launch(kernel, dim=count, inputs=inputs, device=device())
    # JAX does not know of Warp's stream.
    wp.synchronize_device(device())


def in_threads(function: Callable[[S], T], parts: Iterable[S]) -> list[T]:
    """``function`` of all parts, on a CPU on all of its cores at once."""
    return list(_pool().map(function, parts) if device().is_cpu else map(function, parts))


def start(build: Callable[..., T], *arguments: Any) -> Callable[[], T]:
    """What gives a result that on a CPU is worked out in another thread meanwhile."""
    if device().is_cpu:
        return _pool().submit(build, *arguments).result
    built = build(*arguments)
    return lambda: built


def once(build: Callable[[], T]) -> Callable[[], T]:
    """What gives a result that is worked out when it is first wanted, once for all threads.

    `functools.cached_property` has no lock since Python 3.12: threads that want it at the same time
    each work it out, and all but one lose theirs while a kernel still reads it.
    """
    lock, found = threading.Lock(), functools.cache(build)

    def result() -> T:
        with lock:
            return found()

    return result


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """Threads that stay: to start them takes as long as a query of a whole mesh."""
    return ThreadPoolExecutor(usable_cores())


def _started() -> Any:
    wp.init()
    return wp.device_from_jax(jax.devices()[0])


def _quietly(function: Callable[[], T]) -> T:
    level = wp.config.log_level
    try:
        wp.config.log_level = wp.LOG_ERROR
        return function()
    finally:
        wp.config.log_level = level
