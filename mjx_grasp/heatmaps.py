"""`python -m mjx_grasp.heatmaps`: grasp-affordance heatmaps of a mesh or a folder of meshes.

Needs no catalogue and no GPU, and of a robot only what its hand can span. Per mesh it writes
NAME.npz (everything, see `mjx_grasp.heatmap.files`), NAME.ply (coloured by score) and
NAME.triples.json (the best grasp triples, far enough from each other); for all of them
contact_sheet.png, summary.csv and summary.json.
"""

import sys

from mjx_grasp.cli import run_command, starting


def main() -> None:
    """Parses the command line, makes the heatmaps, prints the table."""
    with starting():
        from rich.console import Console

        from mjx_grasp.heatmap.summary import summary_table
        from mjx_grasp.records.command_line import parsed
        from mjx_grasp.viz.heatmap_folder import HeatmapsConfig, make_heatmaps

        config = parsed(HeatmapsConfig, __doc__)

    rows = make_heatmaps(config, Console(stderr=True))
    Console().print(summary_table(rows))
    failed = [row for row in rows if row.error]
    print(f"written: {len(rows) - len(failed)} of {len(rows)} heatmaps, in {config.out}")
    for row in rows:
        if row.hint:
            print(f"{row.name}: {row.hint}; see --span")
    for row in failed:
        print(f"failed: {row.name}: {row.error}", file=sys.stderr)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    run_command(main)
