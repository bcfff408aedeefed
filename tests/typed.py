"""A command as it is typed, run in the process of the tests: it need not import JAX anew."""

import io
import runpy
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from typing import NamedTuple

import pytest


class Done(NamedTuple):
    """A command that has ended."""

    returncode: int
    stdout: str
    stderr: str


def typed(module, *arguments):
    """`python -m mjx_grasp.MODULE ARGUMENTS` to its end; neither JAX nor meshes are loaded anew."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        try:
            _run(patch, module, arguments)
        except SystemExit as end:
            code = end.code or 0
    return Done(code, out.getvalue(), err.getvalue())


def _run(monkeypatch, module, arguments):
    # With its shapes checked, the module would be cached as if it were the plain one.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "argv", [module, *map(str, arguments)])
    with warnings.catch_warnings():
        # The module may be imported already: it is run again, under the name `__main__`.
        warnings.simplefilter("ignore", RuntimeWarning)
        runpy.run_module(f"mjx_grasp.{module}", run_name="__main__", alter_sys=True)


def refusal(monkeypatch, capsys, module, *arguments):
    """Exit status and stderr of `python -m mjx_grasp.MODULE ARGUMENTS`, which must end early.

    An exception that would have shown a traceback comes out of here as it is.
    """
    with pytest.raises(SystemExit) as end:
        _run(monkeypatch, module, arguments)
    return end.value.code, capsys.readouterr().err
