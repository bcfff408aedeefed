"""Where a training's numbers go: CSV and TensorBoard by default, Weights & Biases on request."""

from __future__ import annotations

import csv
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO
from uuid import uuid4

from mjx_grasp.errors import InputError
from mjx_grasp.records.atomic import replacing


class MetricLog:
    """Appends one row per iteration to `metrics.csv` and to TensorBoard.

    A resumed run first drops the rows that were written after its checkpoint.

    Args:
        folder: The run's folder.
        columns: Columns of the CSV, `iteration` first.
        from_iteration: Iterations already done; later rows are dropped.
        wandb_project: Project of Weights & Biases, if it is to be used (extra `wandb`).
        config: The run's configuration, for Weights & Biases.

    Raises:
        InputError: Weights & Biases is asked for and not installed.
    """

    def __init__(
        self,
        folder: Path,
        columns: tuple[str, ...],
        from_iteration: int = 0,
        wandb_project: str | None = None,
        config: dict[str, Any] | None = None,
    ):
        from tensorboardX import SummaryWriter

        require_wandb(wandb_project)
        self._columns = columns
        path = folder / "metrics.csv"
        kept = _rows_until(path, from_iteration) if from_iteration else []
        with replacing(path) as temporary, temporary.open("w", newline="") as stream:
            rows = self._writer(stream)
            rows.writeheader()
            rows.writerows(kept)
        self._file = path.open("a", newline="")
        self._csv = self._writer(self._file)
        self._last = kept[-1] if kept else {}
        done = int(self.number_of_last("env_steps"))
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=done + 1)
        self._wandb = _wandb_run(wandb_project, folder, config) if wandb_project else None

    def _writer(self, stream: TextIO) -> csv.DictWriter:
        return csv.DictWriter(stream, self._columns, restval="nan", extrasaction="ignore")

    def number_of_last(self, name: str) -> float:
        """A figure of the last row that a resumed run has kept; 0 where there is none."""
        return float(self._last.get(name) or 0.0)

    def write(self, row: dict[str, float]) -> None:
        """Adds a row; it is on disk when this returns."""
        self._csv.writerow({name: row[name] for name in self._columns})
        self._file.flush()
        step = int(row["env_steps"])
        for name in self._columns[1:]:
            if row[name] == row[name]:  # a mean over no episodes is not a number
                self._board.add_scalar(name, row[name], step)
        if self._wandb is not None:
            self._wandb.log(row, step=step)

    def close(self) -> None:
        """Flushes and closes all of it."""
        self._file.close()
        self._board.close()
        if self._wandb is not None:
            self._wandb.finish()


class NoLog:
    """The log of a process beside the one that writes."""

    def number_of_last(self, name: str) -> float:
        """Nothing has been kept."""
        return 0.0

    def write(self, row: dict[str, float]) -> None:
        """Goes nowhere."""

    def close(self) -> None:
        """Nothing is open."""


def _rows_until(path: Path, iteration: int) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as stream:
        return [r for r in csv.DictReader(stream) if int(float(r["iteration"])) <= iteration]


def require_wandb(project: str | None) -> None:
    """Refuses a project of Weights & Biases where that is not installed.

    Raises:
        InputError: There is a project but no package.
    """
    if project is not None and find_spec("wandb") is None:
        raise InputError(
            "--loop.wandb-project", project, "the extra 'wandb' (pip install 'mjx_grasp[wandb]')"
        )


def _wandb_run(project: str, folder: Path, config: dict[str, Any] | None) -> Any:
    """The folder's run there: a resumed training goes on with its curves."""
    import wandb

    known = folder / "wandb_id"
    if not known.exists():
        with replacing(known) as temporary:
            temporary.write_text(uuid4().hex)
    which = {"id": known.read_text(), "resume": "allow"}
    return wandb.init(project=project, dir=str(folder), config=config, **which)
