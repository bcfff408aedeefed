"""The public face: names can be used, type checkers see the same ones, importing costs nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import mjx_grasp


@pytest.mark.parametrize("name", mjx_grasp.__all__)
def test_public_name_exists(name: str) -> None:
    assert getattr(mjx_grasp, name) is not None


def test_editors_are_told_the_names() -> None:
    assert set(mjx_grasp.__all__) <= set(dir(mjx_grasp))


def test_no_name_is_that_of_a_module() -> None:
    """A command of the same name would take its place as soon as somebody imports that."""
    modules = {path.stem for path in Path(mjx_grasp.__file__).parent.iterdir()}
    assert not modules & set(mjx_grasp._PUBLIC)


@pytest.mark.long
def test_a_type_checker_knows_the_types(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    script = tmp_path / "script.py"
    script.write_text("import mjx_grasp\nreveal_type(mjx_grasp.load_robot)\nmjx_grasp.grasp_it\n")
    # Beside the package, where lint has left what it found out.
    command = [sys.executable, "-m", "mypy", "--config-file", "pyproject.toml", script]
    root = Path(mjx_grasp.__file__).parent.parent
    said = subprocess.run(command, capture_output=True, text=True, cwd=root).stdout
    assert "RobotSpec" in said and 'has no attribute "grasp_it"' in said, said


def test_importing_starts_nothing_and_prints_nothing() -> None:
    heavy = {"jax", "mujoco", "warp", "numpy"}
    code = f"import sys, mjx_grasp; sys.exit(bool({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'grasp_it'"):
        _ = mjx_grasp.grasp_it
