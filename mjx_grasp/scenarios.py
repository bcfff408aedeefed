"""`python -m mjx_grasp.scenarios`: whole grasps from home while this or that happens, as a file."""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, grasps, prints the table."""
    with starting():
        from rich.console import Console

        from mjx_grasp.evaluation.grasps.config import ScenariosConfig
        from mjx_grasp.evaluation.grasps.job import run_scenarios
        from mjx_grasp.evaluation.grasps.tables import scenario_table
        from mjx_grasp.records.command_line import parsed

        config = parsed(ScenariosConfig, __doc__)

    console = Console(stderr=True)
    result = run_scenarios(config, console)
    Console().print(scenario_table(result["scenarios"]))
    console.print(f"written: {config.out}")


if __name__ == "__main__":
    run_command(main)
