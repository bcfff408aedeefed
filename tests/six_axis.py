"""Another robot, that of examples/: six arm axes, a palm and three fingers of boxes."""

from pathlib import Path

_FOLDER = Path(__file__).resolve().parent.parent / "examples" / "robot"
MJCF = (_FOLDER / "six_axis.xml").read_text()
DESCRIPTION = (_FOLDER / "six_axis.yaml").read_text()


def write_six_axis(folder: Path) -> Path:
    """Copies MJCF and description; returns the description."""
    (folder / "six_axis.xml").write_text(MJCF)
    path = folder / "six_axis.yaml"
    path.write_text(DESCRIPTION)
    return path
