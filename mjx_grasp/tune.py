"""`python -m mjx_grasp.tune PLAN.yaml --out FOLDER`: many trainings as Ray tasks, and their table.

A plan names settings, sets of objects and seeds; every combination is a training. One that is
finished is not run again, one that was cut short goes on from its checkpoint, and one whose worker
is lost is run by another.
"""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, trains, writes the table."""
    with starting():
        import os

        # What looks here for a GPU must not take its memory from those who train.
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
        from rich.console import Console

        from mjx_grasp.records.command_line import parsed
        from mjx_grasp.training.tuning import TuneConfig, tune

        config = parsed(TuneConfig, __doc__)

    Console().print(tune(config, Console(stderr=True)))


if __name__ == "__main__":
    run_command(main)
