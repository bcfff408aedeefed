"""`python -m mjx_grasp.handoffs`: a dataset of start states for a list of objects."""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, makes the set, prints the table."""
    with starting():
        from rich.console import Console

        from mjx_grasp.evaluation.handoff_tables import tip_error_table
        from mjx_grasp.handoff.config import HandoffConfig
        from mjx_grasp.handoff.make import make_handoffs
        from mjx_grasp.handoff.report import report_table
        from mjx_grasp.records.command_line import parsed

        config = parsed(HandoffConfig, __doc__)

    console = Console()
    handoffs, reports = make_handoffs(config, console)
    console.print(report_table(reports))
    if handoffs.reached.any():
        console.print(tip_error_table(reports))
    count = sum(n > 0 for n in handoffs.counts().values())
    reached = "" if handoffs.kind == "ik" else f", {handoffs.reached.sum()} of them reached"
    console.print(f"{len(handoffs)} states of {count} objects{reached}")
    console.print(f"written: {config.out}, {config.out.with_suffix('.json')}")


if __name__ == "__main__":
    run_command(main)
