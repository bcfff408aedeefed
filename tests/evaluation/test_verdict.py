"""What came of a training in a sentence: better, worse, no different, begun with nothing."""

from dataclasses import replace

import pytest
from kept_trials import groups_of, row, squeeze

from mjx_grasp.evaluation.conditions import BEGAN_WITH
from mjx_grasp.evaluation.verdict import result_table, verdict

N = 40


def outcomes(lifted):
    return "S" * lifted + "L" * (N - lifted)


def said(tmp_path, now, before=None, squeezed=20, gripped=None, force=2.0, **changes):
    """The sentence on a policy that lifts so many of 40 objects."""
    forces = (force,) * N
    rows = [row(outcomes(now), forces, **changes), squeeze(5.0, outcomes(squeezed), (2.0,) * N)]
    if gripped is not None:
        grip = dict(controller="grip", grip_force_n=1.5, grip_friction=0.4)
        rows.append(row(outcomes(gripped), (2.0,) * N, **grip))
    if before is not None:
        rows.append(replace(row(outcomes(before), (2.0,) * N), label=BEGAN_WITH, **changes))
    (sentence,) = verdict(groups_of(tmp_path, *rows))
    return sentence


@pytest.mark.parametrize(
    ("before", "changed"),
    [
        (20, "Training raised success (50.0 → 90.0 % at 2.0 N)"),
        (35, "Training did not change success beyond its 95 % interval (87.5 → 90.0 % at 2.0 N)"),
        (36, "Training did not change success beyond its 95 % interval (90.0 → 90.0 % at 2.0 N)"),
        (40, "Training lowered success (100.0 → 90.0 % at 2.0 N)"),
    ],
)
def test_it_says_what_training_changed(tmp_path, before, changed):
    lifts = "; at an equal force of 2.0 N per finger the policy lifts 90.0 %, "
    more = "more than a squeeze (50.0 %)."
    assert said(tmp_path, 36, before) == changed + lifts + more


def test_another_force_than_before_is_said(tmp_path):
    assert "(100.0 % at 2.0 N → 100.0 % at 1.0 N)" in said(tmp_path, N, N, force=1.0)


def test_begun_with_nothing_it_is_compared_with_the_baselines_alone(tmp_path):
    same = "no different within the 95 % interval from a grip (87.5 %)"
    assert said(tmp_path, 36, gripped=35) == (
        "At an equal force of 2.0 N per finger the policy lifts 90.0 %, "
        f"more than a squeeze (50.0 %), {same}."
    )
    assert said(tmp_path, 10, gripped=36).endswith(
        "lifts 25.0 %, less than a squeeze (50.0 %) and a grip (90.0 %)."
    )


def test_a_policy_that_never_lifts_has_no_force(tmp_path):
    assert said(tmp_path, 0, 0, force=None) == (
        "Training did not change success beyond its 95 % interval (0.0 % at 2.0 N → 0.0 % without "
        "beginning to lift); policy never begins to lift."
    )


def test_budgets_are_judged_one_by_one(tmp_path):
    """One is raised and one not, and each is beside the same budget."""
    rows = [squeeze(5.0, outcomes(20), (2.0,) * N)]
    for budget, now, before in ((1.5, 36, 10), (3.0, 40, 40)):
        asked = dict(force_budget_n=budget, keeping_gain=3.0)
        policy = row(outcomes(now), (budget,) * N, **asked)
        rows += [policy, replace(row(outcomes(before), (budget,) * N, **asked), label=BEGAN_WITH)]
    groups = groups_of(tmp_path, *rows)
    (sentence,) = verdict(groups)
    assert sentence == (
        "Training raised success (25.0 → 90.0 % at 1.5 N); training did not change success beyond "
        "its 95 % interval (100.0 → 100.0 % at 3.0 N); at an equal force of 1.5 N per finger the "
        "policy lifts 90.0 %, more than a squeeze (37.5 %); at 3.0 N it lifts 100.0 %, more than a "
        "squeeze (50.0 %)."
    )

    lines = result_table(groups).rows
    assert [line[:2] for line in lines] == [
        ("policy, budget 1.5 N", "90.0"), ("vs. squeeze", "37.5"), (f"vs. {BEGAN_WITH}", "25.0"),
        ("policy, budget 3 N", "100.0"), ("vs. squeeze", "50.0"), (f"vs. {BEGAN_WITH}", "100.0"),
    ]  # fmt: skip
    assert lines[1][2].startswith("+52.5 (") and lines[0][2] == ""
    # Peaks of 3 and 7 N are measured at 2 N; three quarters of them are read at 1.5 N.
    assert [line[3:] for line in lines[:2]] == [("1.5", "3.0 / 7"), ("1.5", "2.2 / 5")]


def test_policies_and_conditions_are_named_where_there_are_several(tmp_path):
    forces = (2.0,) * N
    rows = [row(outcomes(36), forces), squeeze(5.0, outcomes(20), forces)]
    groups = groups_of(tmp_path, *rows, replace(rows[0], label="other"))
    assert [sentence.partition(": ")[0] for sentence in verdict(groups)] == [
        f"native MuJoCo, ±5 mm, friction 0.8, {name}" for name in ("policy", "other")
    ]


def test_files_of_before_have_no_verdict(tmp_path):
    rows = row("SL", (1.0, 2.0)), squeeze(3.0, "SL", (1.0, 2.0))
    groups = groups_of(tmp_path, *(replace(each, starts=()) for each in rows))
    assert verdict(groups) == [] and not result_table(groups).rows
