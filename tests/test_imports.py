"""Data pass through the packages in one order; what is imported goes against it nowhere."""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ORDER = (
    *("records", "geometry", "objects", "robot", "heatmap", "language"),
    *("sim", "posture", "grasp", "reaching", "closing", "pipeline", "handoff"),
    *("tasks", "learning", "evaluation", "training", "gym", "viz"),
)
"""Each package imports from itself and from those before it."""
LAST = 1 + len(ORDER)
"""The rank of the commands."""
EXCEPTIONS: set[tuple[str, str]] = set()
"""Who imports what against the order, and why that is so for now."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(p): p.read_text() for p in sorted((ROOT / "mjx_grasp").rglob("*.py"))}


def imported(text: str) -> set[str]:
    """The modules of the project that a source imports anywhere, in functions and for types too."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"a relative import in line {node.lineno}"
            # Names of a package may be modules: `from mjx_grasp.viz import video`.
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    found = {name for name in found if name.split(".")[0] == "mjx_grasp"}
    return {name if name in SOURCES else name.rpartition(".")[0] for name in found}


def rank(module: str) -> int:
    """0 for single modules that serve all, then the packages in order, then the commands."""
    if module == "mjx_grasp":  # its public names are of any package
        return LAST
    part = module.split(".")[1]
    if (ROOT / "mjx_grasp" / part).is_dir():
        return 1 + ORDER.index(part)
    return LAST if '__name__ == "__main__"' in SOURCES[module] else 0


def against_the_order(module: str, text: str) -> set[tuple[str, str]]:
    """What a module imports of a later rank; of its own too if it is a command."""
    own = rank(module)
    later = own - 1 if own == LAST else own
    return {(module, name) for name in imported(text) if rank(name) > later}


def test_every_package_has_its_place():
    packages = {p.parent.name for p in (ROOT / "mjx_grasp").glob("*/__init__.py")}
    assert packages == set(ORDER)


def test_imports_follow_the_order():
    found = set().union(*(against_the_order(*source) for source in SOURCES.items()))
    assert sorted(found - EXCEPTIONS) == []
    assert sorted(EXCEPTIONS - found) == [], "no longer imported: take them out of EXCEPTIONS"


@pytest.mark.parametrize(
    ("module", "line", "name"),
    [
        ("training.job", "from mjx_grasp.evaluate import main", "evaluate"),
        ("training.job", "from mjx_grasp import handoffs", "handoffs"),
        ("handoff.make", "import mjx_grasp.handoffs as command", "handoffs"),
        ("handoff", "def f():\n    from mjx_grasp.tasks import closing", "tasks.closing"),
        ("robot.spec", "from mjx_grasp.evaluation import results", "evaluation.results"),
        ("robot.spec", "from mjx_grasp import ClosingTask", ""),
        ("cli", "from mjx_grasp.robot.spec import load_robot", "robot.spec"),
        ("train", "from mjx_grasp.evaluate import main", "evaluate"),
    ],
)
def test_what_goes_against_it_is_found(module, line, name):
    module = f"mjx_grasp.{module}"
    assert against_the_order(module, line) == {(module, f"mjx_grasp.{name}".rstrip("."))}


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("evaluate", "from mjx_grasp.evaluation.run import evaluate"),
        ("evaluation.run", "from mjx_grasp.evaluation.config import EvaluateConfig"),
        ("tasks.closing", "from mjx_grasp.handoff import HandoffSet\nimport jax.numpy as jnp"),
        ("evaluation.reach.results", "from mjx_grasp.records.table import Table"),
        ("records.table", "from mjx_grasp.errors import InputError"),
    ],
)
def test_what_follows_it_passes(module, line):
    assert against_the_order(f"mjx_grasp.{module}", line) == set()


def reached(module: str) -> set[str]:
    """A module, what it imports, what that imports, and so on, within the project."""
    found, open_ends = set(), {module}
    while open_ends:
        name = open_ends.pop()
        found.add(name)
        parents = {name.rsplit(".", k)[0] for k in range(1, name.count("."))}  # run before it
        open_ends |= (imported(SOURCES[name]) | parents) - found - {"mjx_grasp"}
    return found


def names(text: str) -> set[str]:
    """Every name that a source defines, imports or uses, comments and strings apart."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        for part in ("id", "attr", "name"):
            if isinstance(name := getattr(node, part, None), str):
                found.add(name)
    return found


def within(*packages: str) -> list[str]:
    return [m for m in SOURCES if m.split(".")[1:2] and m.split(".")[1] in packages]


def test_control_laws_reach_nothing_that_only_a_simulator_knows():
    """No `Truth` in a controller nor in whatever it is made of."""
    privileged = {m for m, text in SOURCES.items() if "Truth" in names(text)}
    assert "mjx_grasp.sim.physics" in privileged and "mjx_grasp.tasks.rewards" in privileged
    for module in within("pipeline", "closing", "reaching", "grasp", "posture", "robot"):
        assert reached(module) & privileged == set(), module


def test_learner_and_evaluation_know_no_task_by_name():
    for module in (*within("learning", "training"), "mjx_grasp.evaluation.trials"):
        found = names(SOURCES[module])
        assert not found & {"ClosingTask", "ClosingTaskConfig", "ClosingState"}, module
        assert "mjx_grasp.tasks.closing" not in imported(SOURCES[module]), module


def calls_without_arguments(text: str, function: str) -> list[int]:
    """The lines in which a function is called with nothing in its brackets."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and function in (getattr(node.func, "id", None), getattr(node.func, "attr", None))
        and not node.args
        and not node.keywords
    ]


def test_nothing_in_the_package_takes_a_robot_of_its_own():
    """The robot is an argument: which one it is, is said at the top."""
    assert calls_without_arguments("spec.load_robot()\nload_robot(name)", "load_robot") == [1]
    for module, text in SOURCES.items():
        assert calls_without_arguments(text, "load_robot") == [], module


SCRIPTS = [p for f in ("experiments", "benchmarks", "examples") for p in (ROOT / f).glob("*.py")]


@pytest.mark.parametrize(
    "path", sorted(SCRIPTS), ids=lambda path: f"{path.parent.name}/{path.stem}"
)
def test_scripts_import_what_there_is(path):
    """Nobody runs all of them after a name has moved."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "mjx_grasp":
            module = import_module(node.module)
            for alias in node.names:
                found = hasattr(module, alias.name) or find_spec(f"{node.module}.{alias.name}")
                assert found, f"{node.module} has no {alias.name}"
