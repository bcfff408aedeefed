"""`python -m mjx_grasp.viz.video`: a recorded trajectory as a video, a GIF or a picture."""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line and renders."""
    with starting():
        from mjx_grasp.records.command_line import parsed
        from mjx_grasp.viz.rendering import VideoConfig, make_video

        config = parsed(VideoConfig, __doc__)

    make_video(config)
    print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(main)
