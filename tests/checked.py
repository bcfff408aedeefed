"""Which modules have the shapes and types of their signatures checked in the tests."""

from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "mjx_grasp"
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.stem != "__init__"  # a package's name would mean all that is in it
}
CHECKED = [
    name
    for name, path in MODULES.items()
    if "jaxtyping" in path.read_text() and "_kernel" not in name
]
"""Those that say shapes; of the others mypy knows the types, and checks at every call would take a
tenth of the time. Without the kernels, which Warp compiles from their source."""
