"""Which modules have the shapes and types of their signatures checked in the tests."""

from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "mjx_grasp"
MODULES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path.stem != "__init__"  # a package's name would mean all that is in it
}
CHECKED = [name for name in MODULES if "_kernel" not in name]
"""All but the kernels, which Warp compiles from their source."""
