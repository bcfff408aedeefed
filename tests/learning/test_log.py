import csv
import sys
import types
from importlib.machinery import ModuleSpec

import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.learning.log import MetricLog

COLUMNS = ("iteration", "env_steps", "return")
STEPS = 1000


def write(folder, iterations, start=0, value=1.0):
    log = MetricLog(folder, COLUMNS, start)
    for i in iterations:
        log.write({"iteration": i, "env_steps": i * STEPS, "return": value, "unlisted": 0.0})
    log.close()


def rows(folder):
    with (folder / "metrics.csv").open(newline="") as stream:
        return [(int(r["iteration"]), float(r["return"])) for r in csv.DictReader(stream)]


def test_rows_are_on_disk_at_once(tmp_path):
    log = MetricLog(tmp_path, COLUMNS)
    log.write({"iteration": 1, "env_steps": STEPS, "return": 2.5})
    assert rows(tmp_path) == [(1, 2.5)]
    log.close()


def test_resume_keeps_rows_up_to_the_checkpoint_and_no_others(tmp_path):
    write(tmp_path, range(1, 6))
    write(tmp_path, range(4, 7), start=3, value=2.0)
    assert rows(tmp_path) == [(1, 1.0), (2, 1.0), (3, 1.0), (4, 2.0), (5, 2.0), (6, 2.0)]


def test_a_log_that_cannot_be_written_anew_stays_as_it_was(tmp_path, monkeypatch):
    write(tmp_path, range(1, 6))

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(csv.DictWriter, "writerows", full)
    with pytest.raises(OSError, match="no space"):
        MetricLog(tmp_path, COLUMNS, 3)
    assert [i for i, _ in rows(tmp_path)] == [1, 2, 3, 4, 5]


def test_new_run_starts_an_empty_log(tmp_path):
    write(tmp_path, range(1, 4))
    write(tmp_path, [1])
    assert rows(tmp_path) == [(1, 1.0)]


def test_resume_without_an_old_log_works(tmp_path):
    write(tmp_path, [8], start=7)
    assert rows(tmp_path) == [(8, 1.0)]


def test_means_over_nothing_do_not_reach_tensorboard(tmp_path, board):
    write(tmp_path, [1], value=float("nan"))
    assert [name for name, *_ in board.scalars] == ["env_steps"]


def test_resume_purges_the_board_of_what_comes_after_the_checkpoint_only(tmp_path, board):
    """TensorBoard drops events from `purge_step` on; its steps are environment steps."""
    write(tmp_path, range(1, 6))
    board.scalars.clear()
    write(tmp_path, range(4, 7), start=3)
    first = min(step for _, _, step in board.scalars)
    assert 3 * STEPS < board.purge_step <= first


def test_missing_wandb_is_an_error_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(InputError, match=r"wandb.*pip install"):
        MetricLog(tmp_path, COLUMNS, wandb_project="grasping")


def test_a_project_of_wandb_gets_the_configuration_and_every_row(tmp_path, wandb):
    log = MetricLog(tmp_path, COLUMNS, wandb_project="grasping", config={"seed": 3})
    lines = [{"iteration": i, "env_steps": i * STEPS, "return": 2.0 * i} for i in (1, 2)]
    for line in lines:
        log.write(line)
    assert wandb.finished == 0
    log.close()
    (begun,) = wandb.begun
    assert len(begun.pop("id")) == 32
    asked = {"project": "grasping", "dir": str(tmp_path), "config": {"seed": 3}}
    assert begun == asked | {"resume": "allow"}
    assert wandb.logged == [(line, line["env_steps"]) for line in lines]
    assert wandb.finished == 1
    assert rows(tmp_path) == [(1, 2.0), (2, 4.0)]  # beside the CSV, not instead of it


def test_a_resumed_run_goes_on_with_its_curves_in_wandb(tmp_path, wandb):
    for folder in (tmp_path / "a", tmp_path / "a", tmp_path / "b"):
        folder.mkdir(exist_ok=True)
        MetricLog(folder, COLUMNS, wandb_project="grasping").close()
    first, again, other = (begun["id"] for begun in wandb.begun)
    assert first == again != other


def test_without_a_project_wandb_is_left_alone(tmp_path, wandb):
    write(tmp_path, [1])
    assert wandb.begun == wandb.logged == [] and wandb.finished == 0


@pytest.fixture
def wandb(monkeypatch):
    """A package of that name that records what is asked of it."""
    module = types.ModuleType("wandb")
    module.__spec__ = ModuleSpec("wandb", loader=None)
    module.begun, module.logged, module.finished = [], [], 0

    class Run:
        def log(self, row, step):
            module.logged.append((row, step))

        def finish(self):
            module.finished += 1

    def init(**settings):
        module.begun.append(settings)
        return Run()

    module.init = init
    monkeypatch.setitem(sys.modules, "wandb", module)
    return module


@pytest.fixture
def board(monkeypatch):
    """Records what is written to TensorBoard."""
    import tensorboardX

    class Board:
        scalars: list = []  # noqa: RUF012
        purge_step = None

        def __init__(self, folder, purge_step=None):
            Board.purge_step = purge_step

        def add_scalar(self, name, value, step):
            self.scalars.append((name, value, step))

        def close(self):
            pass

    Board.scalars = []
    monkeypatch.setattr(tensorboardX, "SummaryWriter", Board)
    return Board
