"""Sphinx's settings: nothing is loaded from elsewhere, no font, no script; equations are MathML.

`docs/build.py` puts the pages together and calls Sphinx with these.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import typing
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config, GoogleDocstring
from sphinx.util import logging

project = "mjx_grasp"
copyright = "The mjx_grasp contributors, Apache-2.0"
extensions = ["sphinx.ext.autodoc", "myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
templates_path: list[str] = []
html_theme = "furo"
html_title = project
html_static_path = [str(Path(__file__).with_name(name)) for name in ("site.css", "site.js")]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"
add_module_names = False
toc_object_entries_show_parents = "hide"
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

METHOD = ("scene", "heatmap", "selection", "reaching", "start-states", "closing")
METHOD += ("baselines", "success")
"""Sections of the method, which docstrings cite, and their anchors."""

_LITERAL = re.compile(r"(:\w+:`[^`]+`|``.+?``|`[^`]+`)", re.DOTALL)
_NAME = re.compile(r"mjx_grasp[\w.]+|[A-Z]\w*(\.\w+)*")
_SETTINGS = Config(napoleon_use_ivar=True)
_log = logging.getLogger(__name__)


def _as_written(*_: Any, **__: Any) -> typing.NoReturn:
    """In place of `typing.get_type_hints`: Sphinx then shows annotations as they are written.

    Evaluated they are unreadable: `Float[Array, "*b 3"]` and `Positive` say more than the classes
    that are made of them.
    """
    raise NameError("annotations stay as they are written")


def docstring(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """From the project's docstrings to reStructuredText.

    Names in single marks are links where there is something of the name, all else is code. What
    would be markup by accident, as in |x|² and R*, is not. A field's is free of sections: a colon
    in it is a colon.
    """
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()
        return
    parts = _LITERAL.split("\n".join(lines))
    parts[::2] = [re.sub(r"([*|\\]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    parts[::2] = [re.sub(r"method §(\d)", _section, part) for part in parts[::2]]
    parts[1::2] = [_marked(part) for part in parts[1::2]]
    lines[:] = "".join(parts).split("\n")
    if what not in ("attribute", "data", "property"):
        lines[:] = GoogleDocstring(lines, _SETTINGS, app, what, name, obj, options).lines()


def _marked(text: str) -> str:
    if text.startswith(("``", ":")):
        return text
    inside = text[1:-1]
    return f":py:obj:`{inside}`" if _NAME.fullmatch(inside) else f"``{inside}``"


def _section(mark: re.Match[str]) -> str:
    return f"`{mark[0]} <../method.html#{METHOD[int(mark[1])]}>`__"


def signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, arguments: str, returns: str
) -> tuple[str, None] | None:
    """Of records none: their fields follow."""
    record = dataclasses.is_dataclass(obj) or hasattr(obj, "_fields")
    protocol = getattr(obj, "_is_protocol", False)
    return ("", None) if what == "class" and (record or protocol) else None


def missing(app: Sphinx, env: Any, node: Any, content: Any) -> None:
    """A page that names what the reference does not have; it has no type variables."""
    if node.get("reftype") == "obj" and node["reftarget"].startswith("mjx_grasp."):
        module, _, name = node["reftarget"].rpartition(".")
        if not isinstance(getattr(sys.modules.get(module), name, None), typing.TypeVar):
            _log.warning("no %s in the reference", node["reftarget"], location=node)


def resolve_types(app: Sphinx, doctree: nodes.document) -> None:
    """Names in annotations are those of the module in which they stand."""
    for node in doctree.findall(addnodes.pending_xref):
        if node.get("refspecific") is False:  # of an annotation
            module = sys.modules.get(node.get("py:module") or "")
            found = getattr(module, node["reftarget"], None)
            if isinstance(found, type):
                node["reftarget"] = f"{found.__module__}.{found.__qualname__}"
            del node["refspecific"]  # or anything of that name is taken


def _mathml(latex: str, display: str) -> str:
    """An equation; bars stand close to what is between them."""
    found = convert(latex, display=display)
    return re.sub(r"<mo([^>]*)>(?=&#x0007C;|&#x02016;)", r'<mo\1 lspace="0" rspace="0">', found)


def inline_equation(writer: Any, node: nodes.math) -> typing.NoReturn:
    """As MathML, which browsers draw by themselves."""
    writer.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def equation(writer: Any, node: nodes.math_block) -> typing.NoReturn:
    """The same in a line of its own."""
    writer.body.append(f'<div class="equation">{_mathml(node.astext(), "block")}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Connects all this."""
    typing.get_type_hints = _as_written
    app.connect("autodoc-process-docstring", docstring)
    app.connect("autodoc-process-signature", signature)
    app.connect("doctree-read", resolve_types)
    app.connect("missing-reference", missing)
    app.add_html_math_renderer("mathml", (inline_equation, None), (equation, None))
