"""The comparison of controllers: what is known of squeezes and grips is not run again."""

import importlib
import itertools
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from mjx_grasp.closing.learned import ObservationConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.tasks.config import ClosingTaskConfig

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
NAMES = ["apple", "foam_brick"]


@pytest.fixture(params=[False, True], ids=["no budget", "budget"])
def script(monkeypatch, request, committed):
    """The module, with two objects that are none and a count of what was run."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    module = importlib.import_module("evaluate_controllers")
    from mjx_grasp.evaluation.results import ResultRow

    module.ran, number = [], itertools.count(1)

    def evaluated(own, job):
        return [alone(chosen, job.names) for chosen in job.chosen]

    def alone(chosen, names):
        module.ran.append(chosen)
        budget = request.param and chosen.controller == "policy"
        force = {"policy": None, "squeeze": chosen.squeeze_force, "grip": None}
        row = ResultRow(
            object="", controller=chosen.controller, engine="mujoco", episodes=1, successes=1,
            never_lifted=0, not_held=0, slipped=0, ci95=(20.0, 100.0),
            force_mean_n=float(next(number)), force_peak_n=2.0,
            squeeze_force_n=force[chosen.controller], offset_mm=chosen.offset_mm,
            angle_deg=0.0, friction=chosen.friction, handoffs="reached",
            force_budget_n=chosen.force_budget if budget else None,
        )  # fmt: skip
        rows = [asdict(replace(row, object=name)) for name in names]
        return {"rows": rows, "incidents": {"overflows": 1}}

    def load(config):
        return module._Evaluator(None, NAMES, [], None, np.ones(1, bool), None)

    monkeypatch.setattr(module, "_evaluated", evaluated)
    monkeypatch.setattr(module, "_load", load)
    task = ClosingTaskConfig(observation=ObservationConfig(forces=True, budget=request.param))
    monkeypatch.setattr(module, "policy_task", lambda policy: task)
    module.policies = 2 if request.param else 1
    return module


@pytest.fixture
def first(script, tmp_path):
    """A comparison of a policy, two squeezes and a grip under two conditions."""
    config = script.ComparisonConfig(
        out=tmp_path / "first.json",
        conditions=("nominal", "hard"),
        force_budgets=(1.5, 3.0),
        squeeze_forces=(3.0, 5.0),
        grip_frictions=(0.4,),
    )
    script.main(config)
    assert len(script.ran) == 2 * (script.policies + 3)
    script.ran.clear()
    return config


def of_another_policy(path):
    record = json.loads(path.read_text())
    record["sha256"]["policy"] = "0" * 64
    path.write_text(json.dumps(record))


def test_only_the_policy_is_run_where_the_others_are_known(script, first, tmp_path):
    of_another_policy(first.out)
    second = replace(first, out=tmp_path / "second.json", known=(first.out,))
    script.main(second)
    assert [each.controller for each in script.ran] == 2 * script.policies * ["policy"]
    old, new = (json.loads(each.out.read_text()) for each in (first, second))
    for was, is_now in zip(old["rows"], new["rows"], strict=True):
        assert (was == is_now) == (was["controller"] != "policy")
    (origin,) = new["known"]
    assert origin.items() >= old["provenance"].items() and "known" not in origin
    third = replace(first, out=tmp_path / "third.json", known=(second.out,))
    script.main(third)
    assert json.loads(third.out.read_text())["known"][0]["known"] == new["known"]


def test_what_is_known_of_the_same_policy_is_not_run_either(script, first, tmp_path):
    more = replace(first, out=tmp_path / "more.json", known=(first.out,), force_budgets=(1.5, 6.0))
    script.main(more)
    budgets = [6.0] if script.policies == 2 else []
    assert [each.force_budget for each in script.ran] == 2 * budgets
    script.ran.clear()
    both = replace(more, out=tmp_path / "both.json", known=(first.out, more.out))
    script.main(replace(both, force_budgets=(1.5, 3.0, 6.0)))
    assert not script.ran


def test_how_a_policy_is_held_to_its_budget_is_its_own_affair(script, first, tmp_path):
    """The others are known whatever it is, from files of before it was a setting as well."""
    told = replace(first, out=tmp_path / "told.json", known=(first.out,), keeping_gain=0.0)
    script.main(told)
    assert [each.controller for each in script.ran] == 2 * script.policies * ["policy"]
    assert all(each.keeping_gain == 0.0 for each in script.ran)
    script.ran.clear()
    record = json.loads(told.out.read_text())
    del record["settings"]["keeping_gain"]
    told.out.write_text(json.dumps(record))
    script.main(replace(first, out=tmp_path / "kept.json", known=(told.out,)))
    assert [each.controller for each in script.ran] == 2 * script.policies * ["policy"]
    assert all(each.keeping_gain > 0.0 for each in script.ran)


def test_squeezes_have_the_task_of_the_policy_where_asked(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    module, given = importlib.import_module("evaluate_controllers"), []

    def beside(world, names, chosen, policy, reached, console, task, room):
        given.append(task)
        return []

    monkeypatch.setattr(module, "evaluate_beside", beside)
    for task in (None, ClosingTaskConfig(episode_s=2.0)):
        own = module._Evaluator(None, NAMES, [], None, np.ones(1, bool), task)
        squeeze = EvaluateConfig(tmp_path / "out.json", controller="squeeze")
        assert module._evaluated(own, module._Job([squeeze], NAMES, 1)) == []
    assert given == [None, ClosingTaskConfig(episode_s=2.0)]


def test_squeezes_in_the_task_of_another_policy_are_not_known(script, first, tmp_path):
    own = replace(first, out=tmp_path / "own.json", own_task=True)
    script.main(own)
    script.ran.clear()
    script.main(replace(own, out=tmp_path / "same.json", known=(own.out,)))
    assert not script.ran
    of_another_policy(own.out)
    script.main(replace(own, out=tmp_path / "other.json", known=(own.out,)))
    assert len(script.ran) == 2 * (script.policies + 3)


def test_what_is_known_of_other_tasks_is_refused(script, first, tmp_path):
    asked = replace(first, out=tmp_path / "x.json", known=(first.out,), own_task=True)
    with pytest.raises(FileError, match=r"own_task False.*True, as asked for now"):
        script.main(asked)


def test_what_a_file_that_was_cut_off_lacks_is_run(script, first, tmp_path):
    record = json.loads(first.out.read_text())
    record["rows"] = record["rows"][: len(NAMES) * (script.policies + 1)]
    first.out.write_text(json.dumps(record))
    script.main(replace(first, out=tmp_path / "second.json", known=(first.out,)))
    assert [each.squeeze_force for each in script.ran if each.controller == "squeeze"] == [5, 3, 5]


def test_a_comparison_that_is_killed_loses_nothing_that_was_finished(
    script, first, tmp_path, monkeypatch
):
    """Of controllers that end in the reverse of their order, too."""
    from mjx_grasp.records import journal

    def as_done(over, work, jobs, setup, kind):
        context = setup()
        for k in reversed(range(len(jobs))):
            yield k, work(context, jobs[k])

    monkeypatch.setattr(journal, "as_done", as_done)
    whole, second = json.loads(first.out.read_text()), replace(first, out=tmp_path / "second.json")
    evaluated = script._evaluated

    def stops(own, job):
        if len(script.ran) == 3:
            raise KeyboardInterrupt
        return evaluated(own, job)

    monkeypatch.setattr(script, "_evaluated", stops)
    with pytest.raises(KeyboardInterrupt):
        script.main(second)
    monkeypatch.setattr(script, "_evaluated", evaluated)
    script.main(second)
    assert len(script.ran) == 2 * (script.policies + 3), "none twice"
    found = json.loads(second.out.read_text())
    assert found["overflows"] == whole["overflows"] == len(script.ran)
    for ours, theirs in zip(found["rows"], whole["rows"], strict=True):
        # The stand-in for a force tells when a controller was run.
        assert ours | {"force_mean_n": 0.0} == theirs | {"force_mean_n": 0.0}
    assert sorted(tmp_path.iterdir()) == [first.out, second.out]


@pytest.mark.parametrize("stop", [1, 2, 3])
def test_a_comparison_in_mjx_that_is_killed_loses_no_batch(
    script, first, tmp_path, monkeypatch, stop
):
    """Also of batches part of whose rows are in the file, as those of others come between."""
    config = replace(first, out=tmp_path / "second.json", engine="mjx", worlds=384)
    config = replace(config, conditions=("nominal", "heavy", "hard"), force_budgets=(1.5, 2.0, 3.0))
    evaluated, done = script._evaluated, []

    def stops(own, job):
        if len(done) == stop:
            raise KeyboardInterrupt
        done.append(job)
        assert len(job.chosen) <= job.room <= 3
        return evaluated(own, job)

    monkeypatch.setattr(script, "_evaluated", stops)
    with pytest.raises(KeyboardInterrupt):
        script.main(config)
    stop = None
    script.main(config)
    asked = script.asked_of(config, script.policies == 2)
    assert len(script.ran) == len(asked), "none twice"
    rows = json.loads(config.out.read_text())["rows"]
    assert [row["controller"] for row in rows[:: len(NAMES)]] == [each.controller for each in asked]
    assert config.out.exists() and not list(tmp_path.glob(".*.begun"))


def test_objects_are_shared_out_in_parts_and_rows_keep_their_order(
    script, first, tmp_path, monkeypatch
):
    whole, second = json.loads(first.out.read_text()), replace(first, out=tmp_path / "second.json")
    monkeypatch.setattr(script, "_TOGETHER", 1)
    script.main(second)
    assert len(NAMES) > 1 and len(script.ran) == 2 * (script.policies + 3) * len(NAMES)
    found = json.loads(second.out.read_text())
    assert found["overflows"] == len(NAMES) * whole["overflows"]
    for ours, theirs in zip(found["rows"], whole["rows"], strict=True):
        assert ours | {"force_mean_n": 0.0} == theirs | {"force_mean_n": 0.0}


def test_in_mjx_conditions_of_one_function_are_beside_each_other(
    script, first, tmp_path, monkeypatch
):
    """As many as have room, and the file is as if they had not been."""
    jobs, evaluated = [], script._evaluated

    def noted(own, job):
        jobs.append(job)
        return evaluated(own, job)

    monkeypatch.setattr(script, "_evaluated", noted)
    config = replace(first, out=tmp_path / "second.json", engine="mjx", episodes=64, worlds=384)
    script.main(config)  # three of them, as each has 2 objects
    kinds = [{script._compiled(each) for each in job.chosen} for job in jobs]
    assert all(len(kind) == 1 for kind in kinds)
    policies = [2, 2] if script.policies == 2 else [2]
    assert [len(job.chosen) for job in jobs] == [*policies, 2, 2, 2]
    whole, found = (json.loads(each.out.read_text()) for each in (first, config))
    assert found["overflows"] == whole["overflows"]
    for ours, theirs in zip(found["rows"], whole["rows"], strict=True):
        assert ours | {"force_mean_n": 0.0} == theirs | {"force_mean_n": 0.0}


@pytest.mark.parametrize("noisy", [False, True])
def test_softer_and_stiffer_fingers_keep_the_noise_of_their_sensors(script, tmp_path, noisy):
    config = script.ComparisonConfig(out=tmp_path / "soft.json", noisy_torque=noisy)
    usual = script.under("nominal", config)
    assert (usual.robot_errors == script.NOISY_TORQUE) is noisy
    for name, factor in (("soft", 0.5), ("stiff", 2.0)):
        errors = replace(usual.robot_errors, stiffness=(factor, factor))
        assert script.under(name, config) == replace(usual, robot_errors=errors)


def test_the_known_file_is_not_written_over(script, first):
    before = first.out.read_text()
    with pytest.raises(InputError, match=r"--known.*another file"):
        script.main(replace(first, known=(first.out,)))
    assert first.out.read_text() == before


def test_what_is_not_known_is_run(script, first, tmp_path):
    conditions, forces = ("hard", "heavy"), (5.0, 8.0)
    second = replace(
        first,
        out=tmp_path / "second.json",
        known=(first.out,),
        conditions=conditions,
        squeeze_forces=forces,
        with_policy=False,
    )
    script.main(second)
    ran = [(each.friction, each.controller, each.squeeze_force) for each in script.ran]
    assert ran == [(0.5, "squeeze", 8.0), (0.8, "squeeze", 5.0), (0.8, "squeeze", 8.0),
                   (0.8, "grip", 3.0)]  # fmt: skip
    assert all(each.mass_scale == 2.0 for each in script.ran[1:])


def test_evaluations_that_share_compiled_functions_follow_each_other(script, first, tmp_path):
    script.main(replace(first, out=tmp_path / "second.json", conditions=("nominal", "heavy")))
    kinds = [script._compiled(each) for each in script.ran]
    changes = sum(one != other for one, other in itertools.pairwise(kinds))
    assert len(set(kinds)) == 3 and changes == 2
    rows = json.loads((tmp_path / "second.json").read_text())["rows"]
    in_order = [row["controller"] for row in rows[:: len(NAMES)]]
    assert in_order == 2 * [*script.policies * ["policy"], "squeeze", "squeeze", "grip"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(seed=2), "seed 1"),
        (dict(episodes=32), "episodes 64"),
        (dict(states="all"), "states 'evaluation'"),
        (dict(objects=("apple",)), r"objects \('eight',\)"),
        (dict(engine="mjx"), "engine 'mujoco'"),
        (dict(noisy_torque=True), "noisy_torque False"),
    ],
)
def test_other_draws_are_refused(script, first, tmp_path, change, message):
    second = replace(first, out=tmp_path / "second.json", known=(first.out,), **change)
    with pytest.raises(FileError, match=message):
        script.main(second)
    assert not script.ran and not second.out.exists()


def test_other_start_states_are_refused(script, first, tmp_path):
    record = json.loads(first.out.read_text())
    record["sha256"]["handoffs"] = "0" * 64
    first.out.write_text(json.dumps(record))
    with pytest.raises(FileError, match="other start states"):
        script.main(replace(first, out=tmp_path / "second.json", known=(first.out,)))


def test_a_file_that_is_not_there_is_named(script, first, tmp_path):
    with pytest.raises(FileError, match=r"none\.json"):
        script.main(replace(first, known=(tmp_path / "none.json",)))
