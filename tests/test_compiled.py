"""What commands compile is kept for the next ones."""

import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from mjx_grasp import compiled
from mjx_grasp.compiled import VARIABLE, keep_compiled

PROGRAM = """
import logging, sys
from mjx_grasp.cli import run_command

def main():
    import jax, jax.numpy as jnp
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    logging.getLogger("jax").addHandler(logging.StreamHandler(sys.stdout))
    jax.config.update("jax_explain_cache_misses", True)
    print(float(jax.jit(lambda x: jnp.sin(x) @ x)(jnp.arange(40.0))))

run_command(main)
"""


def run(home, **variables):
    kept = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    env = kept | {"HOME": str(home), "JAX_PLATFORMS": "cpu"} | variables
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def entries(folder):
    return sorted(path.name for path in folder.rglob("*-cache"))


def test_a_second_command_takes_over_what_the_first_has_compiled(tmp_path):
    first = run(tmp_path)
    kept = entries(tmp_path / ".cache/mjx_grasp/compiled")
    assert kept and any(line.startswith("PERSISTENT COMPILATION CACHE MISS") for line in first)
    second = run(tmp_path)
    assert second[-1] == first[-1]
    assert not any(line.startswith("PERSISTENT COMPILATION CACHE MISS") for line in second)
    assert entries(tmp_path) == kept


def test_who_has_named_a_folder_keeps_it(tmp_path):
    own = tmp_path / "own"
    run(tmp_path, **{VARIABLE: str(own)})
    assert entries(own) and not (tmp_path / ".cache").exists()


def test_who_wants_nothing_kept_names_none(tmp_path):
    run(tmp_path, **{VARIABLE: ""})
    assert not entries(tmp_path)


def test_without_a_place_to_write_nothing_is_kept(tmp_path):
    home = tmp_path / "home"
    home.write_text("no folder")
    assert run(home)


@pytest.fixture
def unnamed(monkeypatch):
    """A process that has no folder yet; JAX's own is put back."""
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.delenv(VARIABLE)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


def test_what_is_old_goes_and_the_rest_stays(unnamed, tmp_path):
    for name, days in (("old-cache", 40), ("new-cache", 3), ("old.txt", 40)):
        (tmp_path / name).touch()
        then = time.time() - 24 * 3600 * days
        os.utime(tmp_path / name, (then, then))
    keep_compiled(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new-cache", "old.txt"]
    assert os.environ[VARIABLE] == jax.config.jax_compilation_cache_dir == str(tmp_path)


def test_processors_have_folders_of_their_own(monkeypatch):
    def folder(text):
        monkeypatch.setattr(Path, "read_text", lambda self: text)
        return compiled._processor()

    one = "processor: 0\nmodel name: A\nflags: sse\nMHz: 1\n\nprocessor: 1"
    assert folder(one) == folder(one.replace("MHz: 1", "MHz: 2"))
    others = [one.replace("A", "B"), one.replace("sse", "sse avx512f")]
    assert len({folder(text) for text in (one, *others)}) == 3
