import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.results import (
    ResultRow,
    ThroughputRow,
    mean_success,
    read_results,
    schema_of,
    write_results,
)
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity
from mjx_grasp.tasks.config import RobotErrors

PROVENANCE = {"command": "c", "git": "g", "versions": {}, "device": "d", "seed": 0}


def row(counts=(6, 2, 1, 1), **changes):
    n = sum(counts)
    values = dict(
        object="apple", controller="policy", engine="mujoco", episodes=n,
        successes=counts[0], never_lifted=counts[1], not_held=counts[2], slipped=counts[3],
        ci95=wilson_interval(counts[0], n), force_mean_n=4.0, force_peak_n=9.5,
        squeeze_force_n=None, offset_mm=5.0, angle_deg=0.0, friction=0.8, handoffs="ik",
    )  # fmt: skip
    return ResultRow(**(values | changes))


@given(st.lists(st.integers(0, 40), min_size=4, max_size=4).filter(sum))
def test_rows_survive_the_file(tmp_path_factory, counts):
    path = tmp_path_factory.mktemp("r") / "results.json"
    noisy = RobotErrors(stiffness=(0.7, 1.3), torque_std=0.02)
    rows = (
        row(counts),
        row(counts, object="pear", force_mean_n=None, squeeze_force_n=3.0),
        row(counts, robot_errors=noisy),
    )
    write_results(path, rows, PROVENANCE, FIRST_ROBOT, label="mine")
    found = read_results(path)
    assert found.rows == rows
    assert found.provenance == PROVENANCE
    assert found.extra == {"label": "mine"}
    assert rows[0].success_percent == pytest.approx(100 * counts[0] / sum(counts))


def test_the_file_is_plain_json_with_the_documented_names(tmp_path):
    write_results(tmp_path / "r.json", [row()], PROVENANCE, FIRST_ROBOT)
    document = json.loads((tmp_path / "r.json").read_text())
    assert set(document) == {"schema", "robot", "rows", "provenance"}
    assert set(document["rows"][0]) == {
        "object", "controller", "engine", "episodes", "successes", "never_lifted", "not_held",
        "slipped", "ci95", "force_mean_n", "force_peak_n", "squeeze_force_n", "offset_mm",
        "angle_deg", "friction", "handoffs", "outcomes", "force_held_n", "force_peak_p50_n",
        "force_peak_p99_n", "forces_n", "starts", "squeeze_split", "grip_force_n",
        "grip_friction", "mass_scale", "force_budget_n", "robot_errors",
        "keeping_gain", "reached_share", "friction_spread", "label",
    }  # fmt: skip


@pytest.mark.wrong_types
def test_the_robot_comes_back_and_is_the_first_one_in_files_that_do_not_say(tmp_path):
    path, robot = tmp_path / "r.json", RobotIdentity("six_axis", "a1" * 32)
    write_results(path, [row()], PROVENANCE, robot, label="mine")
    document = json.loads(path.read_text())
    assert document["robot"] == {"name": "six_axis", "digest": "a1" * 32}
    found = read_results(path)
    assert found.robot == robot and found.extra == {"label": "mine"}
    for wrong in ("six_axis", None, {}, {"name": 3}, {"name": "a", "colour": "red"}):
        path.write_text(json.dumps(document | {"robot": wrong}))
        with pytest.raises(FileError, match=r"r\.json: found robot|r\.json: found RobotIdentity"):
            read_results(path)
    del document["robot"]
    path.write_text(json.dumps(document))
    assert read_results(path).robot == FIRST_ROBOT


def test_rows_from_before_outcomes_were_kept_are_read(tmp_path):
    path = tmp_path / "r.json"
    write_results(path, [row()], PROVENANCE, FIRST_ROBOT)
    document = json.loads(path.read_text())
    del document["rows"][0]["outcomes"]
    path.write_text(json.dumps(document))
    assert read_results(path).rows == (row(),)
    write_results(path, [row(outcomes="SSLSSLSHPS")], PROVENANCE, FIRST_ROBOT)
    assert read_results(path).rows[0].outcomes == "SSLSSLSHPS"


def test_a_row_says_how_many_of_its_trials_began_from_reached_states(tmp_path):
    path, mixed = tmp_path / "r.json", row(handoffs="mixed", reached_share=0.25)
    write_results(path, [mixed], PROVENANCE, FIRST_ROBOT)
    assert read_results(path).rows == (mixed,)
    document = json.loads(path.read_text())
    del document["rows"][0]["reached_share"]
    path.write_text(json.dumps(document))
    assert read_results(path).rows[0].reached_share is None


def test_throughput_rows_have_a_schema_of_their_own(tmp_path):
    path = tmp_path / "throughput.json"
    speeds = (ThroughputRow("ppo", "mjx", 1024, 24, 1.2e5, None),)
    write_results(path, speeds, PROVENANCE, FIRST_ROBOT)
    assert read_results(path, ThroughputRow).rows == speeds
    assert schema_of(path) == "mjx_grasp.throughput/1"
    with pytest.raises(FileError, match="schema"):
        read_results(path)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("episodes", 11),
        ("successes", -1),
        ("ci95", (70.0, 90.0)),
        ("ci95", (10.0, 101.0)),
        ("handoffs", "home"),
        ("reached_share", 0.5),
        ("reached_share", -0.1),
        ("outcomes", "SSSSSSLLHH"),
        ("outcomes", "SSSSSSLLHPX"),
        ("force_mean_n", -1.0),
        ("force_peak_n", float("nan")),
        ("friction", float("inf")),
    ],
)
def test_a_row_that_contradicts_itself_is_refused(field, value, tmp_path):
    with pytest.raises(InputError, match=field if field != "successes" else "episodes"):
        row(**{field: value})
    path = tmp_path / "r.json"
    write_results(path, [row()], PROVENANCE, FIRST_ROBOT)
    document = json.loads(path.read_text())
    document["rows"][0][field] = value
    path.write_text(json.dumps(document))
    with pytest.raises(FileError, match="row 0"):
        read_results(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("{", "no JSON"),
        ("[]", "JSON list"),
        ("{}", "schema None"),
        ('{"schema": "mjx_grasp.results/1"}', "no rows"),
        ('{"schema": "mjx_grasp.results/1", "rows": [{}]}', "no whole provenance"),
    ],
)
def test_a_foreign_file_is_refused_by_name(tmp_path, text, message):
    path = tmp_path / "foreign.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(FileError, match=f"foreign.json.*{message}"):
        read_results(path)


@pytest.mark.parametrize("change", ["lacks friction", "has unknown colour"])
def test_a_row_with_other_fields_is_refused(tmp_path, change):
    path = tmp_path / "r.json"
    write_results(path, [row()], PROVENANCE, FIRST_ROBOT)
    document = json.loads(path.read_text())
    if change == "lacks friction":
        del document["rows"][0]["friction"]
    else:
        document["rows"][0]["colour"] = 1
    path.write_text(json.dumps(document))
    with pytest.raises(FileError, match=change):
        read_results(path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "r.json"
    write_results(path, [row()], PROVENANCE, FIRST_ROBOT)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        write_results(path, [row()], PROVENANCE, FIRST_ROBOT, score=float("nan"))
    with pytest.raises(InputError, match="seed"):
        write_results(
            path, [row()], {k: v for k, v in PROVENANCE.items() if k != "seed"}, FIRST_ROBOT
        )
    with pytest.raises(InputError, match="rows"):
        write_results(path, [], PROVENANCE, FIRST_ROBOT)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_the_mean_counts_every_object_the_same():
    mean, (low, high) = mean_success([row((1, 1, 0, 0)), row((90, 10, 0, 0), object="pear")])
    assert mean == pytest.approx(70.0)
    assert low < mean < high
    one = row((7, 3, 0, 0))
    assert mean_success([one]) == (70.0, pytest.approx(one.ci95))
    with pytest.raises(InputError):
        mean_success([])


def test_counts_from_numpy_are_refused_by_json_and_leave_nothing(tmp_path):
    with pytest.raises(TypeError):
        write_results(tmp_path / "r.json", [row()], PROVENANCE, FIRST_ROBOT, n=np.int64(3))
    assert not list(tmp_path.iterdir())
