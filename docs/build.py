"""Builds the documentation: `python docs/build.py FOLDER`; a warning is an error.

To the pages of docs/ it adds what is written elsewhere or follows from the code: results, the map
for contributors, changes, examples, each command's `--help`, and a reference page per package in
the order of the map.
"""

from __future__ import annotations

import ast
import contextlib
import io
import os
import posixpath
import re
import runpy
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from unittest import mock

ROOT = Path(__file__).resolve().parent.parent
DOCS, PACKAGE = ROOT / "docs", ROOT / "mjx_grasp"
GUIDE = ("tutorial", "method", "own-object", "heatmaps", "own-robot", "own-driver")
GUIDE += ("training", "policies", "reproduction")
ELSEWHERE = {
    "experiments/README.md": "results.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Documents of the repository that are pages, and what these are called."""
EXAMPLES = "examples.md"
BASE = ("errors", "assets", "cli")
"""Modules that serve all packages."""
HELP_COLUMNS = 88

_LINK = re.compile(r"(!?)\[([^]\n]+)\]\(([^)\s#]*)(#[^)\s]*)?\)")
_FENCE = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)
_NAME = re.compile(r"(?<!`)`(mjx_grasp(?:\.\w+)+)`(?!`)")


def main(out: Path) -> int:
    """Puts the pages together and builds them; the exit status."""
    from sphinx.cmd.build import main as sphinx

    sys.path.insert(0, str(ROOT))
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "source"
        for name, text in pages().items():
            page = source / name
            page.parent.mkdir(parents=True, exist_ok=True)
            page.write_text(text)
        for path, name in files().items():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, source / name)
        shutil.rmtree(out, ignore_errors=True)
        quiet = ("-q", "-W", "--keep-going", "-E")
        where = ("-c", DOCS, "-d", Path(folder) / "doctrees", source, out)
        return sphinx([*quiet, *map(str, where)])


# Pages


def pages() -> dict[str, str]:
    """All pages by name."""
    found = {name: with_links(path, (ROOT / path).read_text()) for path, name in sources().items()}
    found["index.md"] += with_links("README.md", section_of("README.md", "Limitations"))
    found["index.md"] += contents()
    found["commands.md"] = with_help(found["commands.md"])
    found[EXAMPLES] = examples()
    found["reference/public.md"] = public_names()
    found["reference/base.md"] = reference(", ".join(BASE), "what everything may use", BASE)
    for name, about in packages().items():
        modules = [
            ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
            for path in sorted((PACKAGE / name).rglob("*.py"))
            if path.name != "__init__.py"
        ]
        found[f"reference/{name}.md"] = reference(name, about, modules, automodule(name, bare=True))
    return found


def sources() -> dict[str, str]:
    """The documents of the repository that are pages, by path, with the names of the pages."""
    return {f"docs/{path.name}": path.name for path in sorted(DOCS.glob("*.md"))} | ELSEWHERE


def section_of(path: str, title: str) -> str:
    """A section of a document."""
    text = (ROOT / path).read_text()
    (found,) = re.findall(rf"^## {title}\n.*?(?=^## |\Z)", text, re.M | re.S)
    return f"\n{found}"


def packages() -> dict[str, str]:
    """What each package holds, in the order of the map."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    return dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", text, re.M))


def contents() -> str:
    """What leads from the first page to all others."""
    chapters = {
        "Guide": GUIDE,
        "Reference": (
            *("commands", "reference/public", "reference/base"),
            *(f"reference/{name}" for name in packages()),
        ),
        "Project": ("examples", "results", "contributing", "changelog"),
    }
    trees = [
        "\n".join(["```{toctree}", ":hidden:", f":caption: {caption}", "", *names, "```"])
        for caption, names in chapters.items()
    ]
    return "\n\n" + "\n\n".join(trees) + "\n"


def reference(title: str, about: str, modules: Iterable[str], head: str = "") -> str:
    """The page of a package: its modules, one after the other."""
    parts = [f"# {title}\n\n{about[0].upper()}{about[1:]}.\n{head}"]
    parts += [f"\n## {module.rpartition('.')[2]}\n{automodule(module)}" for module in modules]
    return "".join(parts)


def automodule(module: str, bare: bool = False) -> str:
    """A module's docstring and, unless it is bare, what it holds."""
    options = "\n   :no-members:" if bare else ""
    return f"\n```{{eval-rst}}\n.. automodule:: mjx_grasp.{module}{options}\n```\n"


@cache
def public() -> dict[str, str]:
    """Where each public name comes from."""
    text = (PACKAGE / "__init__.pyi").read_text()
    found = re.findall(r"^from (\S+) import (\w+) as \w+$", text, re.M)
    return {name: f"{module}.{name}" for module, name in found}


def public_names() -> str:
    """What `mjx_grasp` offers by itself, by what it is about."""
    parts = ["# Public names", "All of them are in `mjx_grasp` itself: `mjx_grasp.load_robot`."]
    for line in (PACKAGE / "__init__.pyi").read_text().splitlines():
        if line.startswith("# "):
            parts.append(f"\n## {line[2:]}\n\n| name | what it is |\n| --- | --- |")
        elif match := re.fullmatch(r"from (\S+) import (\w+) as \w+", line):
            module, name = match.groups()
            about = first_sentence(module, name).replace("|", "\\|")
            parts[-1] += f"\n| {{py:obj}}`{name} <{module}.{name}>` | {about} |"
    return "\n\n".join(parts)


def first_sentence(module: str, name: str) -> str:
    """Of the docstring of a class or a function."""
    tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text())
    kinds = (ast.ClassDef, ast.FunctionDef)
    node = next(n for n in tree.body if isinstance(n, kinds) and n.name == name)
    first = (ast.get_docstring(node) or "").split("\n\n")[0].replace("\n", " ")
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", first)


def examples() -> str:
    """The scripts of examples/."""
    parts = ["# Examples", "Short scripts to copy. Each runs as its first lines say."]
    for path in sorted((ROOT / "examples").glob("*.py")):
        parts += [f"## {path.name}", f"```python\n{path.read_text()}```"]
    return "\n\n".join(parts)


def with_help(text: str) -> str:
    """The page of the commands with what each says of itself below its section."""

    def section(mark: re.Match[str]) -> str:
        said = f"```text\n{command_help(f'mjx_grasp.{mark[1]}')}\n```"
        folded = f"<details>\n<summary>--help</summary>\n\n{said}\n\n</details>"
        return f"{mark[0].rstrip()}\n\n{folded}\n\n"

    return re.sub(r"^## ([\w.]+)\n.*?(?=^## |\Z)", section, text, flags=re.M | re.S)


def command_help(module: str) -> str:
    """What `python -m module --help` prints."""
    said = io.StringIO()
    plain = {"COLUMNS": str(HELP_COLUMNS), "NO_COLOR": "1", "TERM": "dumb"}
    with (
        mock.patch.dict(os.environ, plain),
        mock.patch.object(sys, "argv", [module, "--help"]),
        contextlib.redirect_stdout(said),
        contextlib.suppress(SystemExit),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", RuntimeWarning)  # modules that have been imported before
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    text = re.sub(r"^usage: \S+", f"usage: python -m {module}", said.getvalue())
    assert text.startswith("usage:"), f"{module} --help: {text[:80]!r}"
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


# Links


def in_repository(home: str, link: str) -> str:
    """The path, from the repository's root, that a document's link means."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(home), link))


def in_site(path: str) -> str | None:
    """Where a path of the repository stands in the site; None where it does not."""
    if path == "README.md":
        return "index.md"
    if path == "examples" or re.fullmatch(r"examples/\w+\.py", path):
        return EXAMPLES
    if path in sources():
        return sources()[path]
    return path.removeprefix("docs/") if (ROOT / path).is_file() else None


def with_links(home: str, text: str) -> str:
    """A document whose links lead to pages, and whose names of the code lead to the reference."""

    def link(mark: re.Match[str]) -> str:
        image, shown, target, anchor = mark.groups()
        if not target or re.match(r"\w+:", target):
            return mark[0]
        name = in_site(in_repository(home, target))
        return shown if name is None else f"{image}[{shown}]({name}{anchor or ''})"

    def named(mark: re.Match[str]) -> str:
        name = mark[1].removeprefix("mjx_grasp.")
        return f"{{py:obj}}`~{public().get(name, mark[1])}`"

    parts = _FENCE.split(text)
    parts[::2] = [_NAME.sub(named, _LINK.sub(link, part)) for part in parts[::2]]
    return "".join(parts)


def files() -> dict[Path, str]:
    """Pictures and other files that pages show or link to, with their places."""
    found = {}
    for home in sources():
        for mark in _LINK.finditer((ROOT / home).read_text()):
            path = in_repository(home, mark[3])
            name = in_site(path)
            if name and not name.endswith(".md"):
                found[ROOT / path] = name
    return found


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1] if len(sys.argv) > 1 else "site")))
