"""A Ray cluster (extra `ray`): one of this machine's cores, or one that is there already."""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def connected(address: str | None, cores: int | None = None) -> Iterator[None]:
    """Connects for as long as the context lasts.

    Args:
        address: Of a cluster; None begins one on this machine.
        cores: That one on this machine has; by default all of them.
    """
    import ray

    # Modules are found where this process finds them; nobody takes all of a GPU.
    variables = {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "XLA_PYTHON_CLIENT_PREALLOCATE": os.environ.get("XLA_PYTHON_CLIENT_PREALLOCATE", "false"),
    }
    with warnings.catch_warnings():
        # What JAX says of forks does not concern the other programs that Ray begins.
        warnings.filterwarnings("ignore", r"os\.fork\(\)", RuntimeWarning)
        ray.init(
            address,
            num_cpus=cores if address is None else None,
            log_to_driver=False,
            logging_level=logging.ERROR,
            include_dashboard=False,
            runtime_env={"env_vars": variables},
        )
    try:
        yield
    finally:
        ray.shutdown()
