"""`python -m mjx_grasp.sweep_reach`: how often the reaching controller reaches, and how fast.

Thousands of random cylinders on the table, reached for from home without physics, in batches. It
prints the rates by tolerance and time beside those of the publication.
"""

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, sweeps, prints the tables, writes what was asked for."""
    with starting():
        from rich.console import Console

        from mjx_grasp.evaluation.reach.poses import SweepConfig, check_outputs
        from mjx_grasp.records.command_line import parsed

        config = parsed(SweepConfig, __doc__)
        check_outputs(config)
        from mjx_grasp.evaluation.reach.results import tables
        from mjx_grasp.evaluation.reach.run import journal_of, run_sweep
        from mjx_grasp.reaching.presets import for_sweep, reach_preset
        from mjx_grasp.robot.spec import load_robot
        from mjx_grasp.viz.reach import write_outputs

    console, robot = Console(), load_robot(config.robot)
    settings = for_sweep(reach_preset(config.preset))
    with journal_of(config, robot, console) as journal:
        run = run_sweep(
            robot,
            settings,
            config.poses,
            config.seed,
            chunk=config.chunk,
            bound=config.bound,
            over=config,
            journal=journal,
            console=console,
        )
        for table in tables(run.result, config.preset):
            console.print(table)
        for path in write_outputs(config, settings, robot, run):
            console.print(f"written: {path}")


if __name__ == "__main__":
    run_command(main)
