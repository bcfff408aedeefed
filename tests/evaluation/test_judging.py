"""Success at equal force and within a budget: laws, and what can be counted by hand."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kept_trials import groups_of, row, squeeze
from scipy import stats

from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.front_tables import (
    budget_table,
    equal_force_table,
    fronts,
    object_budget_table,
)
from mjx_grasp.evaluation.judging import (
    gain,
    gain_at_equal_force,
    gains_within,
    mean_force,
    mean_success,
    resampled,
    same_starts,
    success_within,
    success_within_by_any,
)

BUDGETS = np.array([0.5, 1.0, 2.0, 4.0, 9.0])


@st.composite
def trials(draw, controllers=3):
    """Outcomes and forces of controllers on two objects, from the same starts."""

    def many(elements, n):
        return draw(st.lists(elements, min_size=n, max_size=n))

    sizes = {name: draw(st.integers(2, 9)) for name in ("apple", "pear")}
    starts = {name: many(st.integers(0, 3), n) for name, n in sizes.items()}
    return [
        [
            ("".join(many(st.sampled_from("SLHP"), n)), many(st.floats(0.2, 6.0), n), starts[name])
            for name, n in sizes.items()
        ]
        for _ in range(controllers)
    ]


def as_rows(drawn):
    return [
        [row(*of, name) for of, name in zip(both, ("apple", "pear"), strict=True)] for both in drawn
    ]


def test_only_trials_of_the_same_starts_are_compared():
    first = [row("SL", (1.0, 2.0))]
    assert same_starts([first, first]).success.tolist() == [[True, False]] * 2
    for other in (
        row("SL", (1.0, 2.0), (4, 5)),
        row("SLL", (1.0, 2.0, 2.0)),
        row("SL", (1.0, 2.0), name="pear"),
        replace(first[0], forces_n=()),
        replace(first[0], starts=()),
    ):
        with pytest.raises(InputError):
            same_starts([first, [other]])


@given(trials())
def test_the_trials_as_they_were_run_give_the_rows_own_means(drawn):
    rows = as_rows(drawn)
    found = same_starts(rows)
    weights = resampled(found, resamples=5)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    for c, of in enumerate(rows):
        success = np.mean([r.success_percent for r in of])
        assert mean_success(found, weights)[0, c] == pytest.approx(success)
        assert mean_force(found, weights)[0, c] == pytest.approx(
            np.mean([r.force_mean_n for r in of])
        )


@given(trials())
def test_trials_of_one_start_are_drawn_together_and_objects_count_the_same(drawn):
    rows = as_rows(drawn)
    found = same_starts(rows)
    weights = resampled(found, resamples=20)
    for k in (0, 1):
        part = found.object == k
        np.testing.assert_allclose(weights[:, part].sum(axis=1), 0.5)
        for start in np.unique(found.start[part]):
            together = weights[:, part & (found.start == start)]
            np.testing.assert_array_equal(together, together[:, :1].repeat(together.shape[1], 1))


def test_the_interval_of_single_starts_agrees_with_scipys_bootstrap():
    rng = np.random.default_rng(0)
    success = rng.random(80) < 0.7
    rows = [[row("".join("LS"[int(s)] for s in success), [2.0] * 80)]]
    found = same_starts(rows)
    drawn = mean_success(found, resampled(found, resamples=20_000))[1:, 0]
    expected = stats.bootstrap(
        (100.0 * success,), np.mean, method="percentile", n_resamples=20_000, rng=1
    ).confidence_interval
    assert np.quantile(drawn, [0.025, 0.975]) == pytest.approx(tuple(expected), abs=0.8)


def test_a_gain_is_that_of_the_pairs():
    """What both fail or both do adds no doubt; the other way round it is the opposite."""
    rows = [[row("SSSSLLLL", [2.0] * 8)], [row("SSLLLLLL", [2.0] * 8)]]
    found = same_starts(rows)
    weights = resampled(found)
    there, back = (gain(found, weights, *order) for order in ((0, 1), (1, 0)))
    assert there.value == 25.0 and there.value == -back.value
    assert there.ci95 == pytest.approx((-back.ci95[1], -back.ci95[0]))
    apart = np.array([0, 0, 100, 100, 0, 0, 0, 0])
    expected = stats.bootstrap((apart,), np.mean, method="percentile", rng=1).confidence_interval
    assert there.ci95 == pytest.approx(tuple(expected), abs=7)
    assert there.ci95[0] >= 0.0


def test_starts_that_are_used_twice_widen_the_interval():
    """The same trials, once each from a start of its own and once two from each start."""
    letters, forces = "SSLL" * 10, [2.0] * 40

    def width(starts):
        found = same_starts([[row(letters, forces, starts)]])
        return np.ptp(np.quantile(mean_success(found, resampled(found)), [0.025, 0.975]))

    assert width([k // 2 for k in range(40)]) == pytest.approx(
        np.sqrt(2) * width(range(40)), rel=0.1
    )


@given(trials(), st.permutations([0, 1, 2]))
def test_success_within_a_budget_rises_with_it_up_to_all_success(drawn, order):
    rows = as_rows(drawn)
    found = same_starts(rows)
    weights = resampled(found, resamples=3)
    for c in range(3):
        curve = success_within(found, weights, [c], BUDGETS)
        assert (np.diff(curve, axis=1) >= 0).all()
        np.testing.assert_allclose(curve[:, -1], mean_success(found, weights)[:, c], atol=1e-9)
    best = success_within(found, weights, order, BUDGETS)
    each = [success_within(found, weights, [c], BUDGETS) for c in range(3)]
    np.testing.assert_allclose(best, np.max(each, axis=0))
    of_each_trial = success_within_by_any(found, weights, BUDGETS)
    assert (of_each_trial >= best - 1e-9).all()


def test_success_within_a_budget_by_hand():
    found = same_starts([[row("SSLSP", (1.0, 3.0, 0.4, 2.0, 1.0))], [row("LLSLL", (2.0,) * 5)]])
    once = resampled(found, resamples=1)[:1]
    assert success_within(found, once, [0], BUDGETS)[0] == pytest.approx([0, 20, 40, 60, 60])
    gains = gains_within(found, resampled(found), [0], [1], BUDGETS)
    assert [g.value for g in gains] == pytest.approx([0, 20, 20, 40, 40])
    assert success_within_by_any(found, once, BUDGETS)[0] == pytest.approx([0, 20, 60, 80, 80])


@given(trials())
def test_against_itself_nothing_gains(drawn):
    rows = as_rows(drawn)
    found = same_starts([rows[0], rows[0]])
    weights = resampled(found, resamples=50)
    assert gain_at_equal_force(found, weights, [1]).value == pytest.approx(0.0)
    # So it is in every resampling.
    assert gain_at_equal_force(found, weights, [1]).ci95 == pytest.approx((0.0, 0.0))
    assert all(g.ci95 == (0, 0) for g in gains_within(found, weights, [0], [1], BUDGETS))


def test_at_equal_force_it_is_read_between_the_forces_and_level_beyond_them():
    def gain(force):
        light, hard = "SSSSLLLLLL", "SSSSSSSSLL"
        found = same_starts(
            [
                [row("S" * 10, (force,) * 10)],
                [row(hard, (4.0,) * 10)],
                [row(light, (2.0,) * 10)],
            ]
        )
        return gain_at_equal_force(found, resampled(found), [1, 2]).value

    # No success at no force, 40 % at 2 N, 80 % at 4 N.
    assert gain(1.0) == pytest.approx(100 - 20)
    assert gain(3.0) == pytest.approx(100 - 60)
    assert gain(6.0) == pytest.approx(100 - 80)


def test_at_equal_force_settings_that_a_lighter_one_beats_do_not_weaken_a_baseline():
    found = same_starts(
        [
            [row("S" * 10, (3.0,) * 10)],
            [row("SSSSLLLLLL", (2.0,) * 10)],
            [row("SSLLLLLLLL", (3.0,) * 10)],
            [row("SSSSSSSSLL", (4.0,) * 10)],
        ]
    )
    # 40 % at 2 N, 80 % at 4 N; those 20 % at 3 N are nobody's choice.
    gain = gain_at_equal_force(found, resampled(found), [1, 2, 3])
    assert gain.value == pytest.approx(100 - 60)


def test_a_trial_that_never_began_to_lift_has_no_force():
    found = same_starts([[row("SL", (3.0, None))], [row("LL", (None, None))]])
    weights = resampled(found, resamples=10)
    assert mean_force(found, weights)[0, 0] == 3.0
    assert np.isfinite(gain_at_equal_force(found, weights, [1]).ci95).all()


def test_policies_and_grips_stand_beside_the_fronts_of_the_baselines(tmp_path):
    forces = (2.0,) * 4
    rows = [
        row("SSSS", forces, force_budget_n=3.0, keeping_gain=3.0),
        row("SSSL", (1.0,) * 4, force_budget_n=1.5, keeping_gain=3.0),
        row("SSSL", forces, controller="grip", grip_force_n=2.5, grip_friction=0.4),
        squeeze(3.0, "SLLL", (1.0,) * 4),
        squeeze(5.0, "SSLL", forces),
    ]
    groups = groups_of(tmp_path, *rows)
    (front,) = fronts(next(iter(groups.values())))
    assert {name: len(part) for name, part in front.families.items()} == {
        "policy": 2, "grip": 1, "squeeze": 2,
    }  # fmt: skip
    lines = {line[1]: line for line in equal_force_table(groups).rows}
    assert set(lines) == {
        "policy, budget 3 N",
        "policy, budget 1.5 N",
        "grip 2.5 N, μ₀ 0.4",
    }
    against = {name: [cell.split(" ")[0] for cell in line[4:8]] for name, line in lines.items()}
    assert against["policy, budget 3 N"] == ["+50.0", "50.0", "+25.0", "25.0"]
    assert against["policy, budget 1.5 N"] == ["+50.0", "75.0", "+37.5", "62.5"]
    assert against["grip 2.5 N, μ₀ 0.4"] == ["+25.0", "50.0", "", ""]
    assert lines["policy, budget 3 N"][-1] == "3.0 / 7"

    budgets = {line[1]: line[2:] for line in budget_table(groups).rows}
    # 1.5 N, 2 N, 3 N …
    assert budgets["policy"][:3] == ("75.0", "100.0", "100.0")
    assert budgets["squeeze"][:3] == ("25.0", "50.0", "50.0")
    assert budgets["policy − squeeze"][0].startswith("+50.0 (")
    assert budgets["policy − grip"][1].startswith("+25.0 (")
    assert "squeeze − grip" not in budgets

    assert not object_budget_table(groups).rows, "of one object it is the table before"


def test_a_policy_that_is_only_told_its_budget_is_a_family_of_its_own(tmp_path):
    told = {"force_budget_n": 3.0}
    rows = [
        row("SSLL", (2.0,) * 4, **told, keeping_gain=3.0),
        row("SSSL", (2.0, 2.0, 4.0, 2.0), **told, keeping_gain=0.0),
        replace(row("SSSS", (2.5,) * 4, **told), label="mine"),
        squeeze(5.0, "LLLS", (2.0,) * 4),
    ]
    groups = groups_of(tmp_path, *rows)
    budgets = {line[1]: line[2:] for line in budget_table(groups).rows}
    assert budgets["policy"][2:4] == ("50.0", "50.0")  # 3 N, 4 N
    assert budgets["policy, not kept"][2:4] == ("50.0", "75.0")
    assert budgets["mine, not kept"][2:4] == ("100.0", "100.0")
    assert "policy, not kept, budget 3 N" in {line[1] for line in equal_force_table(groups).rows}


def test_what_is_lifted_within_a_budget_is_told_object_by_object(tmp_path):
    forces = (2.0, 3.5, 2.0, 5.0)
    rows = [
        replace(row("SSLS", forces, force_budget_n=3.0), object="apple"),
        replace(row("SSSS", forces, force_budget_n=8.0), object="apple"),
        replace(squeeze(5.0, "LLLS", (2.0, 2.0, 2.0, 2.5)), object="apple"),
        replace(row("LLLL", forces, force_budget_n=3.0), object="mug"),
        replace(row("LLLL", forces, force_budget_n=8.0), object="mug"),
        replace(squeeze(5.0, "LLLS", forces), object="mug"),
    ]
    table = object_budget_table(groups_of(tmp_path, *rows))
    assert [line[1:] for line in table.rows] == [
        ("apple", "50.0", "75.0", "75.0", "100.0"),
        ("mug", "0.0", "0.0", "0.0", "0.0"),
    ]


def test_files_of_before_have_no_front(tmp_path):
    groups = groups_of(
        tmp_path,
        replace(row("SL", (1.0, 2.0)), starts=()),
        replace(squeeze(3.0, "SL", (1.0, 2.0)), starts=()),
    )
    assert not equal_force_table(groups).rows and not budget_table(groups).rows
