"""`python -m mjx_grasp.train`: from objects to a trained policy, its evaluation and a report.

Picks its preset from the hardware: `gpu` trains on the eight objects in MJX, `cpu` trains the
shipped policy further, on one object in native MuJoCo within minutes; `paper` is the published
setting.
"""

import sys

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, trains, evaluates, reports."""
    with starting():
        import jax
        from rich.console import Console

        from mjx_grasp.training.command_line import parse
        from mjx_grasp.training.job import run_training
        from mjx_grasp.viz.report import report_run

        console, config = Console(stderr=True), parse(sys.argv[1:], __doc__)

    folder = run_training(config, console)
    if config.evaluation_episodes and jax.process_index() == 0:
        report_run(folder, console)


if __name__ == "__main__":
    run_command(main)
