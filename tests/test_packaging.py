import ast
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "mjx_grasp"
SOURCES = sorted(PACKAGE.rglob("*.py"))
COMMANDS = [
    p for p in SOURCES if '__name__ == "__main__"' in p.read_text() and p.name != "__main__.py"
]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GENERATED = re.compile(r"<!-- generated:([\w-]+) -->.*?<!-- /generated:\1 -->", re.DOTALL)
DOCUMENTS = "\n".join(
    GENERATED.sub("", path.read_text())  # results keep the commands of their time
    for path in (
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "experiments/README.md")),
        *(ROOT / "docs").glob("*.md"),
    )
)
EXTRAS = PROJECT["optional-dependencies"]


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def distribution(requirement: str) -> str:
    return normal(re.match(r"[\w.-]+", requirement)[0])


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def run_python(*args: str, **options) -> subprocess.CompletedProcess:
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    return subprocess.run(
        [sys.executable, *args],
        env=environment, cwd=ROOT, capture_output=True, text=True, check=False, **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel's names, built from a copy, so that the checkout stays clean."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source)
    for name in ("mjx_grasp", "assets"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = ["-m", "pip", "wheel", "--no-deps", "--quiet", "-w", str(out), str(source)]
    if int(importlib.metadata.version("setuptools").split(".")[0]) >= 77:
        command.append("--no-build-isolation")
    done = run_python(*command)
    assert done.returncode == 0, done.stderr
    (path,) = out.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield {i.filename: i.file_size for i in archive.infolist()}, archive


def test_the_wheel_carries_every_module_and_every_asset(wheel):
    sizes, _ = wheel
    modules = {p.relative_to(ROOT).as_posix() for p in SOURCES}
    assets = {
        f"mjx_grasp/_assets/{p.relative_to(ROOT / 'assets').as_posix()}": p.stat().st_size
        for p in (ROOT / "assets").rglob("*")
        if p.is_file()
    }
    assert assets, "nothing ships"
    others = {"py.typed", "__init__.pyi", "geometry/face_blocks_search.cpp"}
    assert modules | assets.keys() | {f"mjx_grasp/{name}" for name in others} <= sizes.keys()
    assert {name: sizes[name] for name in assets} == assets
    assert not [n for n in sizes if n.startswith(("tests/", "experiments/"))]


def test_the_wheel_names_its_licence_and_extras(wheel):
    sizes, archive = wheel
    licences = [n for n in sizes if n.endswith(("licenses/LICENSE", "licenses/NOTICE"))]
    assert len(licences) == 2
    metadata = archive.read(next(n for n in sizes if n.endswith("METADATA"))).decode()
    assert "License-Expression: Apache-2.0" in metadata
    assert set(re.findall(r"Provides-Extra: (\S+)", metadata)) == set(EXTRAS)


def test_importing_starts_no_device_prints_nothing_and_sets_no_renderer():
    names = [module_name(p) for p in SOURCES]
    done = run_python(
        "-c",
        "import importlib, os, sys\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
        "from jax._src import xla_bridge\n"
        "assert not xla_bridge._backends, xla_bridge._backends\n"
        "assert 'MUJOCO_GL' not in os.environ\n",
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


# In one process, which imports once: `python -m COMMAND --help` for each.
HELPS = """
import contextlib, io, json, runpy, sys
names, found = sys.argv[1:], {}
for name in names:
    sys.argv, out, code = [name, "--help"], io.StringIO(), None
    with contextlib.redirect_stdout(out):
        try:
            runpy.run_module(name, run_name="__main__", alter_sys=True)
        except SystemExit as end:
            code = end.code
    found[name] = [code, out.getvalue()]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def helps():
    done = run_python("-c", HELPS, *map(module_name, COMMANDS), timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("path", COMMANDS, ids=module_name)
def test_every_command_explains_itself(path, helps):
    text = path.read_text()
    assert "run_command" in text
    code, said = helps[module_name(path)]
    assert code in (0, None) and said.lower().startswith("usage:")
    assert f"python -m {module_name(path)}" in ast.get_docstring(ast.parse(text))
    options = set(re.findall(r"--[a-z][\w.-]*", said))
    assert not [option for option in options if "_" in option]
    assert shown_options(module_name(path)) <= options


def shown_options(module: str) -> set[str]:
    """The flags that the documents give to a command."""
    calls = re.findall(rf"python -m {re.escape(module)} ([^#`\n]*)", DOCUMENTS)
    return {option for call in calls for option in re.findall(r"--[a-z][\w.-]*", call)}


def test_the_documents_show_flags():
    assert shown_options("mjx_grasp.evaluate") >= {"--controller", "--objects", "--out"}
    assert shown_options("mjx_grasp.train") >= {"--preset", "--resume"}


def test_every_import_is_a_declared_dependency():
    declared = {distribution(r) for r in PROJECT["dependencies"]}
    optional = {distribution(r) for name in EXTRAS for r in EXTRAS[name] if name != "dev"}
    owners = importlib.metadata.packages_distributions()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = {node.module.split(".")[0]}
            else:
                continue
            for name in names - set(sys.stdlib_module_names) - {"mjx_grasp"}:
                dists = {normal(d) for d in owners.get(name, [name])}
                known = declared | optional | REQUIRED  # some come with a declared package
                assert dists & known, f"{path}: {name} is in no declared dependency"


def _required() -> set[str]:
    """What the declared dependencies require in their turn."""
    found: set[str] = set()
    todo = [distribution(r) for r in PROJECT["dependencies"]]
    while todo:
        name = todo.pop()
        if name in found:
            continue
        found.add(name)
        try:
            requires = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:
            continue
        todo += [distribution(r) for r in requires if "extra ==" not in r]
    return found


REQUIRED = _required()


def test_the_constraints_pin_what_make_setup_installs():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    for line in pins:
        assert re.fullmatch(r"[\w.-]+==[\w.]+( ; python_version [<>=]+ \"3\.\d+\")?", line), line
    pinned = {distribution(line) for line in pins}
    wanted = {distribution(r) for r in PROJECT["dependencies"] + EXTRAS["dev"]} | REQUIRED
    installed = {normal(d.metadata["Name"]) for d in importlib.metadata.distributions()}
    assert (wanted & installed) - pinned - {"mjx-grasp"} == set()
