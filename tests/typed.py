"""A command as it is typed, run in the process of the tests: a refusal need not import JAX anew."""

import runpy
import sys
import warnings

import pytest


def refusal(monkeypatch, capsys, module, *arguments):
    """Exit status and stderr of `python -m mjx_grasp.MODULE ARGUMENTS`, which must end early.

    An exception that would have shown a traceback comes out of here as it is.
    """
    # With its shapes checked, the module would be cached as if it were the plain one.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "argv", [module, *map(str, arguments)])
    with pytest.raises(SystemExit) as end, warnings.catch_warnings():
        # The module may be imported already: it is run again, under the name `__main__`.
        warnings.simplefilter("ignore", RuntimeWarning)
        runpy.run_module(f"mjx_grasp.{module}", run_name="__main__", alter_sys=True)
    return end.value.code, capsys.readouterr().err
