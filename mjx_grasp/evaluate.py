"""`python -m mjx_grasp.evaluate`: success, failures and forces of a controller, as a file."""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, evaluates, prints the table."""
    with starting():
        from rich.console import Console

        from mjx_grasp.evaluation.config import EvaluateConfig
        from mjx_grasp.evaluation.job import evaluate_to_file
        from mjx_grasp.evaluation.tables import success_table
        from mjx_grasp.records.command_line import parsed

        config = parsed(EvaluateConfig, __doc__)

    console = Console(stderr=True)
    rows = evaluate_to_file(config, console)
    Console().print(success_table(rows, scans=config.scans))
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(main)
