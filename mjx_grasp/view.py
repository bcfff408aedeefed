"""`python -m mjx_grasp.view`: a heatmap in the browser, with an anchor to drag.

Takes a mesh (metres) or the .npz of a heatmap. With `--live` also an object of the catalogue: a
simulated robot grasps it there, and you may push it meanwhile. Needs the extra `viewer` (viser).
"""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line and serves until it is interrupted."""
    with starting():
        from mjx_grasp.records.command_line import parsed
        from mjx_grasp.viz.viewing import ViewConfig, serve

        config = parsed(ViewConfig, __doc__)

    serve(config, lambda text: print(text, flush=True))


if __name__ == "__main__":
    run_command(main, alone=True)
