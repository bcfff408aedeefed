"""Times `make test` from a fresh clone, and keeps what passed with which Python and JAX.

  python experiments/time_tests.py --clone /tmp/fresh --python python3.12

clones this repository's last commit, runs `make setup` and `make test` there with that Python, and
adds a row to `experiments/results/tests_cpu.json`; one of the same versions is replaced. Nothing
else should run meanwhile.
"""

from __future__ import annotations

import json
import subprocess
import time
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from time_make_train import ROOT, fresh_clone

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import check_writable, read_json, write_json
from mjx_grasp.records.provenance import command_line
from mjx_grasp.records.settings import CommandSettings

SCHEMA = "mjx_grasp.tests/1"
_PROVENANCE = "import json, mjx_grasp.records.provenance as p; print(json.dumps(p.provenance(0)))"


@dataclass(frozen=True)
class TimeConfig(CommandSettings):
    """Where to clone to and where to write."""

    clone: Path
    """folder to make; it must not be there"""
    python: str = "python3"
    """the Python that `make` is given"""
    out: Path = ROOT / "experiments" / "results" / "tests_cpu.json"
    """results file"""


def counts(path: Path) -> dict[str, Any]:
    """How many tests passed, failed and were skipped, by pytest's JUnit report; who failed.

    Raises:
        FileError: It is missing or no such report.
    """
    try:
        cases = list(ElementTree.parse(path).getroot().iter("testcase"))
    except (OSError, ElementTree.ParseError) as error:
        raise FileError(path, f"no test report ({error})", "pytest's JUnit report") from None
    failed = [c for c in cases if c.find("failure") is not None or c.find("error") is not None]
    skipped = [c for c in cases if c.find("skipped") is not None]
    return {
        "passed": len(cases) - len(failed) - len(skipped),
        "failed": [f"{c.get('classname')}.{c.get('name')}" for c in failed],
        "skipped": [f"{c.get('classname')}.{c.get('name')}" for c in skipped],
    }


def write(out: Path, row: dict[str, Any]) -> None:
    """Adds a row, in place of one of the same Python and JAX."""

    def key(row: dict[str, Any]) -> tuple[str, str]:
        found = row["provenance"]["versions"]
        return found["python"], found["jax"]

    rows = read_json(out, "a results file")["rows"] if out.exists() else []
    rows = sorted([*(r for r in rows if key(r) != key(row)), row], key=key)
    write_json(out, {"schema": SCHEMA, "rows": rows, "provenance": row["provenance"]})


def main(config: TimeConfig) -> None:
    """Clones, tests, and writes the row, also of tests that fail."""
    check_writable("--out", config.out)
    setup_s = fresh_clone(config.clone, config.python)
    report = config.clone.resolve() / ".cache" / "tests.xml"
    command = ["make", "test", f"PYTHON={config.python}", f"ARGS=--junitxml={report}"]
    began = time.perf_counter()
    code = subprocess.run(command, cwd=config.clone, check=False).returncode
    test_s = time.perf_counter() - began
    made = subprocess.run(
        [config.clone.resolve() / ".venv" / "bin" / "python", "-c", _PROVENANCE],
        cwd=config.clone, capture_output=True, text=True, check=True,
    )  # fmt: skip
    row = {
        "setup_s": setup_s,
        "test_s": test_s,
        **counts(report),
        "provenance": json.loads(made.stdout) | {"command": command_line()},
    }
    write(config.out, row)
    print(f"{row['passed']} passed, {len(row['failed'])} failed in {test_s / 60:.1f} min")
    if code != 0:
        raise InputError("make test", f"it returned {code}", "every test to pass")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(TimeConfig, description=__doc__)))
