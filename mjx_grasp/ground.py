"""`python -m mjx_grasp.ground`: where on an object an instruction means, in a camera's picture.

A pointing model, Rex-Omni, is asked; the extra `language` brings what runs it, the weights are
yours to get. The answer is an anchor that `heatmaps` and `view` take as it is printed.
"""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, asks, prints the anchor."""
    with starting():
        from mjx_grasp.language.seen import GroundConfig, ground_seen
        from mjx_grasp.records.command_line import parsed

        config = parsed(GroundConfig, __doc__)

    anchor, target = ground_seen(config)
    centre = 0.5 * (target.vertices.min(axis=0) + target.vertices.max(axis=0))
    for point, frame in (
        (anchor.point, "frame of the mesh"),
        (anchor.point - centre, "object frame, for demo"),
    ):
        x, y, z = (f"{value + 0.0:.4f}" for value in point.round(4))
        print(f"--anchor {x} {y} {z}   # {frame}")
    print(anchor.source)


if __name__ == "__main__":
    run_command(main)
