"""`python -m mjx_grasp.demo`: one grasp from home, as a film and a page."""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, grasps, films, writes the page."""
    with starting():
        from functools import partial

        from rich.console import Console

        from mjx_grasp.records.command_line import parsed
        from mjx_grasp.viz.demo.config import DemoConfig
        from mjx_grasp.viz.demo.page import verdict
        from mjx_grasp.viz.demo.run import run_demo

        config = parsed(DemoConfig, __doc__)

    console = Console(stderr=True)
    say = partial(console.print, markup=False, highlight=False)  # names may have brackets
    result = run_demo(config, console)
    if result["mesh"] == "parametric":
        say(f"{result['object']}: a simple stand-in; --objects-dir takes scans")
    say(f"{result['object']}: {verdict(result)}")
    say(f"written: {config.out / 'index.html'}")


if __name__ == "__main__":
    run_command(main, alone=True)
