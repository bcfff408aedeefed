import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.conditions import Column
from mjx_grasp.evaluation.front_tables import fronts
from mjx_grasp.evaluation.results import ResultRow
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.viz.plots import (
    read_metrics,
    success_against_force,
    success_within_budgets,
    training_curves,
)

BLUE, ORANGE, VIOLET = (37, 99, 168), (200, 100, 30), (122, 79, 163)


def pixels(png):
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def of_colour(picture, colour):
    return np.abs(picture - colour).max(2) < 30


def column(label, successes, force, squeeze=None):
    row = ResultRow(
        object="apple", controller="c", engine="mujoco", episodes=64, successes=successes,
        never_lifted=64 - successes, not_held=0, slipped=0, ci95=wilson_interval(successes, 64),
        force_mean_n=force, force_peak_n=force, squeeze_force_n=squeeze, offset_mm=5.0,
        angle_deg=0.0, friction=0.8, handoffs="ik",
    )  # fmt: skip
    return Column(label, {"apple": row}, family="squeeze" if squeeze else label)


def test_metrics_keep_their_numbers_and_turn_the_rest_to_nan(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("env_steps,return,note\n100,,x\n200,1.5\n300,nan,\n")
    metrics = read_metrics(path)
    assert metrics["env_steps"].tolist() == [100, 200, 300]
    assert np.isnan(metrics["return"][[0, 2]]).all() and metrics["return"][1] == 1.5
    assert np.isnan(metrics["note"]).all()


@pytest.mark.parametrize("text", [None, "", "env_steps,return\n", "a,b\n1,2\n", b"\xff\xfe\x00"])
def test_metrics_without_rows_are_refused_by_name(tmp_path, text):
    path = tmp_path / "metrics.csv"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(FileError, match=r"metrics\.csv"):
        read_metrics(path)


def test_a_rising_curve_rises_in_the_picture():
    steps = np.arange(1.0, 200.0)
    nothing = np.full(len(steps), np.nan)
    metrics = {"env_steps": steps, "return": steps, "success": nothing, "force_n": nothing}
    picture = pixels(training_curves(metrics))
    rows, columns = np.nonzero(of_colour(picture, BLUE))
    height, width = picture.shape[:2]
    assert rows.max() < height / 2 and columns.max() < width / 2  # the only curve with numbers
    assert np.corrcoef(rows, columns)[0, 1] < -0.99


def test_one_row_is_visible():
    one = {name: np.array([1.0]) for name in ("env_steps", "return", "success", "steps_per_s")}
    assert of_colour(pixels(training_curves(one)), BLUE).sum() > 50


def test_points_lie_by_force_and_success():
    picture = pixels(
        success_against_force(
            {
                "easy": [
                    column("policy", 60, 2.0),
                    column("s", 20, 1.0, 3.0),
                    column("s", 62, 4.0, 8.0),
                ]
            }
        )
    )
    picture = picture[: int(0.85 * len(picture))]  # without the legend
    policy_rows, policy_columns = np.nonzero(of_colour(picture, BLUE))
    squeeze_rows, squeeze_columns = np.nonzero(of_colour(picture, ORANGE))
    assert squeeze_columns.min() < policy_columns.min() < squeeze_columns.max()
    assert squeeze_rows.max() > policy_rows.max()  # 31 % lies below 94 %


def test_controllers_without_a_force_are_left_out():
    with_one = success_against_force({"easy": [column("p", 60, 2.0), column("q", 0, None)]})
    assert with_one == success_against_force({"easy": [column("p", 60, 2.0)]})
    with pytest.raises(InputError, match="force"):
        success_against_force({"easy": [column("q", 0, None)]})


def test_conditions_stand_side_by_side_and_policies_share_their_label():
    front = [column("squeeze 3 N", 20, 1.0, 3.0), column("squeeze 8 N", 62, 4.0, 8.0)]
    policies = [column("few worlds", 60, 2.0), column("many worlds", 50, 3.0)]
    one = {"easy": [*front, *policies]}
    two = one | {"hard": [*front, column("many worlds", 40, 3.0)]}
    first, both = (pixels(success_against_force(p)) for p in (one, two))
    assert both.shape[0] == first.shape[0] and both.shape[1] == pytest.approx(
        2 * first.shape[1], rel=0.01
    )
    half = both.shape[1] // 2
    right = both[: int(0.85 * len(both)), half:]  # without the legend
    assert of_colour(both, BLUE).any() and not of_colour(right, BLUE).any()
    assert of_colour(right, VIOLET).any() and of_colour(right, ORANGE).any()
    with pytest.raises(InputError, match="panels"):
        success_against_force({})


def kept(label, successes, force, squeeze=None):
    made = column(label, successes, force, squeeze)
    letters = "S" * successes + "L" * (64 - successes)
    rows = {
        name: replace(row, outcomes=letters, forces_n=(force,) * 64, starts=tuple(range(64)))
        for name, row in made.rows.items()
    }
    return made._replace(rows=rows)


def test_what_always_lifts_stands_near_the_top_of_its_picture():
    always = [kept("policy", 64, 2.0), kept("squeeze 5 N", 64, 4.0, 5.0)]
    picture = pixels(success_against_force({"easy": always}))
    rows, _ = np.nonzero(of_colour(picture[: int(0.85 * len(picture))], BLUE))
    assert rows.max() < 0.5 * len(picture)


def test_success_within_a_budget_is_a_rising_curve_of_its_colour():
    """A policy that lifts everything at 2 N, beside a squeeze that lifts half of it at 4 N."""

    (front,) = fronts([kept("policy", 64, 2.0), kept("squeeze 5 N", 32, 4.0, 5.0)])
    picture = pixels(success_within_budgets({"easy": front}))
    picture = picture[: int(0.85 * len(picture))]  # without the legend
    (blue_rows, blue_columns), (rows, columns) = (
        np.nonzero(of_colour(picture, colour)) for colour in (BLUE, ORANGE)
    )
    assert blue_rows.min() < rows.min() - 50  # everything lies above half
    rise, later = blue_columns[blue_rows == blue_rows.min()], columns[rows == rows.min()]
    assert rise.min() < later.min() - 50  # at 2 N, not at 4 N
    with pytest.raises(InputError, match="panels"):
        success_within_budgets({})
