"""Bodies and problems that several tests share."""

import pytest


@pytest.fixture(scope="session")
def reacher(body):
    """The published controller with few via-points, for speed."""
    from dataclasses import replace

    from mjx_grasp.grasp.config import SelectionConfig
    from mjx_grasp.reaching.config import ReachConfig
    from mjx_grasp.reaching.controller import Reacher

    config = ReachConfig()
    config = replace(config, fields=replace(config.fields, via_points=20))
    return Reacher(body, config, SelectionConfig())
