"""What all commands are made of: short files, light imports, and an end without a traceback."""

import ast
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mjx_grasp.cli import run_command, starting

PACKAGE = Path(__file__).resolve().parent.parent / "mjx_grasp"
COMMANDS = sorted(
    path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    for path in (*PACKAGE.glob("*.py"), *PACKAGE.glob("viz/*.py"))
    if '__name__ == "__main__"' in path.read_text() and path.name != "__main__.py"
)


def source(command):
    return (PACKAGE / f"{command.replace('.', '/')}.py").read_text()


def test_the_commands_are_known():
    assert [
        *(
            "demo",
            "evaluate",
            "export",
            "ground",
            "handoffs",
            "heatmaps",
            "scenarios",
            "sweep_reach",
        ),
        *("train", "tune", "view"),
        "viz.video",
    ] == COMMANDS


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_short_and_imports_nothing_before_it_is_watched_over(command):
    text = source(command)
    assert len(text.splitlines()) <= 50
    top = [node for node in ast.parse(text).body if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {
        node.module if isinstance(node, ast.ImportFrom) else node.names[0].name for node in top
    }
    assert names - {"sys"} == {"mjx_grasp.cli"}


# Interrupts itself where a module is looked for.
INTERRUPTED = """
import os, runpy, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)

class Interrupt:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
command, sys.argv[2:] = sys.argv[2], ["--help"]
runpy.run_module(command, run_name="__main__")
"""


@pytest.mark.parametrize(
    ("command", "module"),
    [
        ("evaluate", "tyro"),
        ("evaluate", "jaxlib.xla_client"),
        ("evaluate", "jaxlib._jax"),
        ("train", "mujoco._structs"),
        ("view", "numpy._core._multiarray_umath"),
        ("heatmaps", "trimesh"),
    ],
)
def test_an_interrupt_while_modules_are_imported_is_one_word(command, module):
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, module, f"mjx_grasp.{command}"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode, done.stderr, done.stdout) == (130, "interrupted\n", "")


def test_an_interrupt_of_the_work_is_left_to_the_work(monkeypatch):
    """So that files are taken back, and a training says how to go on."""
    monkeypatch.setattr("mjx_grasp.cli._end_now", lambda status: pytest.fail("ended"))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with starting():
            pass
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with starting():
            os.kill(os.getpid(), signal.SIGINT)  # as in the background of a shell
    finally:
        signal.signal(signal.SIGINT, before)


def test_too_little_memory_is_an_error_without_a_traceback(capsys):
    def command():
        raise MemoryError("Unable to allocate 80 GiB")

    with pytest.raises(SystemExit) as end:
        run_command(command)
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: not enough memory (Unable to allocate 80 GiB)\n"


@pytest.mark.parametrize("own", [None, "cuda"])
@pytest.mark.parametrize(("name", "alone"), [("demo", True), ("view", True), ("scenarios", False)])
def test_one_robot_is_planned_for_on_the_cpu_unless_the_user_says_otherwise(
    monkeypatch, name, alone, own
):
    """Minutes of compiling for a GPU are not worth it; thousands of worlds are another matter."""
    monkeypatch.setenv("JAX_PLATFORMS", own or "")
    if own is None:
        monkeypatch.delenv("JAX_PLATFORMS")
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit):
        runpy.run_module(f"mjx_grasp.{name}", run_name="__main__")
    assert os.environ.get("JAX_PLATFORMS") == (own or ("cpu" if alone else None))
