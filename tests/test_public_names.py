"""Every public name of the package can be used, and an unknown one is refused as usual."""

from __future__ import annotations

import pytest

import mjx_grasp


@pytest.mark.parametrize("name", mjx_grasp.__all__)
def test_public_name_exists(name: str) -> None:
    assert getattr(mjx_grasp, name) is not None


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'catch'"):
        _ = mjx_grasp.catch
