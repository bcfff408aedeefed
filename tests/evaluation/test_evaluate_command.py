"""What the command refuses, before anything is built, and what it writes."""

import hashlib
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from mjx_grasp.assets import asset_path
from mjx_grasp.closing.config import GripConfig
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation import job as module
from mjx_grasp.evaluation import run
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.results import read_results
from mjx_grasp.evaluation.run import chosen_states
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.tasks.config import MAX_ANGLE_RAD, MAX_OFFSET_M, EndToEndConfig, RewardConfig


def evaluate(config):
    return module.evaluate_to_file(config, Console(quiet=True))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("friction", -1.0),
        ("friction", 0.0),
        ("friction", float("nan")),
        ("offset_mm", -5.0),
        ("offset_mm", 51.0),
        ("angle_deg", -1.0),
        ("angle_deg", 46.0),
        ("squeeze_force", -1.0),
        ("squeeze_force", float("nan")),
        ("episodes", 0),
        ("worlds", 0),
    ],
)
def test_impossible_conditions_are_refused_by_their_flag(field, value):
    with pytest.raises(InputError) as error:
        EvaluateConfig(out=Path("x.json"), **{field: value})
    assert error.value.field == "--" + field.replace("_", "-")


@pytest.mark.parametrize(
    ("controller", "field", "value"),
    [
        ("policy", "squeeze_force", 5.0),
        ("policy", "grip", GripConfig(force=5.0)),
        ("squeeze", "policy", Path("policy.npz")),
        ("squeeze", "force_budget", 8.0),
        ("grip", "squeeze_split", "balanced"),
        ("grip", "keeping_gain", 0.0),
    ],
)
def test_settings_of_another_controller_are_refused(monkeypatch, controller, field, value):
    monkeypatch.setattr(module, "_loaded", None)
    config = EvaluateConfig(out=Path("x.json"), controller=controller, **{field: value})
    with pytest.raises(InputError, match=f"expected nothing beside --controller {controller}") as e:
        evaluate(config)
    assert e.value.field == "--" + field.replace("_", "-")


def test_the_largest_errors_of_a_start_are_allowed():
    most = {"offset_mm": 1e3 * MAX_OFFSET_M, "angle_deg": 45.8}
    noise = EvaluateConfig(out=Path("x.json"), **most).noise
    assert noise.offset_m == pytest.approx(MAX_OFFSET_M)
    assert noise.angle_rad == pytest.approx(MAX_ANGLE_RAD, rel=1e-3)


def test_objects_without_states_are_refused_before_the_scene(monkeypatch):
    monkeypatch.setattr(module, "build_scene_of", None)
    with pytest.raises(InputError, match=r"--objects: found 'bowl'.*foam_brick"):
        evaluate(EvaluateConfig(out=Path("x.json"), objects=("bowl",)))


def test_an_object_needs_states_in_the_chosen_part():
    """Of an object with one state, training or evaluation has none."""
    stored = load_handoffs(shipped_handoffs(None)).select(["foam_brick", "sugar_box"])
    brick, box = (np.flatnonzero(stored.object_index == k) for k in range(2))
    stored = stored.take(np.concatenate([brick, box[:1]]))
    names, without = {}, {}
    for part in ("training", "evaluation", "all"):
        config = EvaluateConfig(
            out=Path("x.json"), objects=("sugar_box", "bowl", "foam_brick"), states=part
        )
        names[part], without[part], states = chosen_states(stored, config)
        assert states.object_names == tuple(names[part]) and states.counts()["foam_brick"] > 1
    assert names["all"] == ["sugar_box", "foam_brick"] and without["all"] == ["bowl"]
    assert names["evaluation"] == ["foam_brick"]
    assert without["evaluation"] == ["sugar_box", "bowl"]


def with_task(policy, **changes):
    """The policy with changed fields of its task; those that are None are left out."""
    task = {k: v for k, v in (policy.meta["task"] | changes).items() if v is not None}
    return replace(policy, meta=policy.meta | {"task": task})


FIRST_POLICY = Path(__file__).parents[1] / "data" / "v1" / "policy.npz"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda p: replace(p, meta={}), "found task = None"),
        (lambda p: with_task(p, grip_power=2.0), r"found task\.grip_power = 2\.0.*no others"),
        (
            lambda p: with_task(p, grip_force=None),
            r"found task\.grip_force = 'nothing'.*all fields",
        ),
        (lambda p: with_task(p, grip_force=-1.0), r"task\.grip\.force = -1\.0, expected 0 or more"),
        pytest.param(
            lambda p: with_task(p, grip_force="much"),
            r"task\.grip\.force = 'much', expected 0 or more",
            marks=pytest.mark.wrong_types,
        ),
        (
            lambda p: replace(
                p, mean=p.mean[1:], std=p.std[1:], weights=(p.weights[0][1:], *p.weights[1:])
            ),
            r"\(65, 15\).*\(66, 15\)",
        ),
        (
            lambda p: replace(
                p,
                weights=(*p.weights[:-1], p.weights[-1][:, 1:]),
                biases=(*p.biases[:-1], p.biases[-1][1:]),
            ),
            r"\(66, 14\).*\(66, 15\)",
        ),
    ],
    ids=["no task", "unknown", "missing", "impossible", "no number", "observation", "action"],
)
def test_policies_of_another_task_or_robot_are_refused_by_name(monkeypatch, change, text):
    monkeypatch.setattr(module, "build_scene_of", None)
    path = Path("foreign.npz")
    change(load_policy(FIRST_POLICY)).save(path)
    with pytest.raises(FileError, match=rf"foreign\.npz: .*{text}"):
        evaluate(EvaluateConfig(out=Path("x.json"), objects=("foam_brick",), policy=path))


@pytest.mark.long
def test_rows_say_how_many_of_their_trials_began_from_reached_states(tmp_path):
    path, names = tmp_path / "mixed.npz", ["foam_brick"]
    stored = load_handoffs(shipped_handoffs(None)).select(names)
    mixed = replace(stored, reached=np.arange(len(stored)) % 3 == 0)
    mixed.save(path)
    out = tmp_path / "r.json"
    config = EvaluateConfig(
        out, "squeeze", objects=tuple(names), handoffs=path, episodes=4, states="evaluation"
    )
    evaluate(config)
    states = mixed.split()[1]
    for row in read_results(out).rows:
        assert row.handoffs == "mixed"
        assert row.reached_share == pytest.approx(states.reached[list(row.starts)].mean())


def test_the_shipped_policy_is_evaluated_and_named():
    policy, handoffs = asset_path("policy.npz"), asset_path("handoffs_standins.npz")
    out, condition = Path("policy.json"), {"objects": ("foam_brick",), "episodes": 2}
    evaluate(EvaluateConfig(out, "policy", policy=policy, handoffs=handoffs, **condition))
    results = read_results(out)
    (row,) = results.rows
    assert (row.object, row.controller, row.engine) == ("foam_brick", "policy", "mujoco")
    assert row.episodes == row.successes + row.never_lifted + row.not_held + row.slipped == 2
    assert row.squeeze_force_n is None
    settings = results.extra["settings"]
    assert (settings["controller"], settings["policy"]) == ("policy", str(policy))
    assert results.extra["sha256"] == {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in (("policy", policy), ("handoffs", handoffs))
    }


@pytest.mark.wrong_types
def test_a_policy_that_was_helped_near_its_contacts_can_be_judged(monkeypatch):
    """Its task refuses the reward for guidance, which others have by default."""
    own = module._loaded(EvaluateConfig(Path("x.json"), "policy", objects=("foam_brick",)))
    unpaid = RewardConfig(reach=0.0, way_left=3.0)
    helped = EndToEndConfig(assisted=True, within=0.1, reward=unpaid)
    asked = []

    def stopped(world, engine, worlds, config, noise):
        asked.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(run, "deployed_task", lambda policy, gain: helped)
    monkeypatch.setattr(run, "_task", stopped)
    with pytest.raises(KeyboardInterrupt):
        run.evaluate(own.world, own.names, own.config, own.policy, own.states.reached, Console())
    (task,) = asked
    assert replace(task, reward=unpaid) == helped


def test_evaluations_that_differ_in_their_draws_alone_share_what_is_compiled(monkeypatch):
    """Another budget, friction, place, policy or force is the same task and function.

    Turning is not.

    Nor is it another task where a policy was only paid otherwise in its training.
    """
    own = module._loaded(EvaluateConfig(Path("x.json"), "policy", objects=("foam_brick",)))
    tasks, acts = [], []

    def remembered(task, controller, draw, worlds):
        tasks.append(task)
        acts.append(controller.func)
        none, nothing = np.zeros(len(draw.row), bool), np.zeros(len(draw.row))
        rest = *(none,) * 3, none.astype(int), *(nothing,) * 5
        return run.Trials(np.asarray(draw.row), ~none, none, *rest)

    monkeypatch.setattr(run, "run_trials", remembered)

    def evaluated(*changes, config, policy):
        tasks.clear(), acts.clear()
        for change in changes:
            new = replace(config, **change)
            run.evaluate(own.world, own.names, new, policy, own.states.reached, Console())
        return len({id(task) for task in tasks}), len({id(act) for act in acts})

    draws = {}, {"friction": 0.5}, {"offset_mm": 9.0}
    budgets, turned = {"force_budget": 8.0}, ({"angle_deg": 3.0}, {"angle_deg": 6.0})
    assert evaluated(*draws, budgets, config=own.config, policy=own.policy) == (1, 1)
    assert evaluated({}, {"keeping_gain": 7.0}, config=own.config, policy=own.policy) == (2, 1)
    assert [task.config.observation.keeping.gain for task in tasks][1] == 7.0
    assert evaluated({}, *turned, config=own.config, policy=own.policy) == (2, 1)
    task = own.policy.meta["task"]
    paid = task | {"reward": task["reward"] | {"hard": task["reward"]["hard"] - 1.0}}
    other = replace(own.policy, meta=own.policy.meta | {"task": paid})
    assert evaluated({}, config=own.config, policy=own.policy) == (1, 1)
    first = tasks[0]
    assert evaluated({}, config=own.config, policy=other) == (1, 1)
    assert tasks[0] is first
    squeeze = replace(own.config, controller="squeeze")
    assert evaluated(*draws, *turned[:1], config=squeeze, policy=None) == (2, 1)
    assert evaluated({}, {"squeeze_force": 1.0}, config=squeeze, policy=None) == (1, 1)
    assert evaluated({}, {"squeeze_split": "balanced"}, config=squeeze, policy=None)[0] == 2
    gripped = [{"grip": replace(own.config.grip, force=force)} for force in (1.0, 2.0)]
    grip = replace(own.config, controller="grip")
    assert evaluated(*gripped, config=grip, policy=None)[0] == 2


def test_evaluations_beside_each_other_are_those_alone(monkeypatch):
    """In MJX their trials share batches, of which each is as large as the others; rows are own."""
    names = "foam_brick", "rubiks_cube"
    own = module._loaded(EvaluateConfig(Path("x.json"), "squeeze", objects=names))
    batches = []

    def tried(task, controller, draw, worlds):
        batches.append((len(draw.row), worlds))
        none = np.zeros(len(draw.row))
        shown = dict.fromkeys(run.Trials._fields, none > 0) | {"row": np.asarray(draw.row)}
        numbers = {"overflow_ticks": none.astype(int), "reward": none, "force_held": none}
        lifted = np.asarray(draw.force) > 2.0
        forces = {"force_mean": np.asarray(draw.force), "force_peak": np.asarray(draw.friction)}
        rise = {"peak_rise": np.asarray(draw.offset)[:, 0]}
        ends = {"success": lifted, "never_lifted": ~lifted}
        return run.Trials(**shown | numbers | forces | rise | ends)

    monkeypatch.setattr(run, "run_trials", tried)
    usual = replace(own.config, engine="mjx", episodes=4)
    changes = {}, {"friction": 0.5}, {"squeeze_force": 1.0}, {"seed": 3, "angle_deg": 2.0}
    configs = [replace(usual, **change) for change in changes]

    def evaluated(*some):
        beside = own.world, own.names, some, None, own.states.reached, Console()
        return run.evaluate_beside(*beside)

    together = evaluated(*configs)
    assert batches == [(32, 32)]
    for found, config in zip(together, configs, strict=True):
        ((rows, trials),) = evaluated(config)
        assert found.rows == rows and [row.object for row in rows] == list(names)
        jax.tree.map(np.testing.assert_array_equal, found.trials, trials)
    assert [found.rows[0].successes for found in together] == [4, 4, 0, 4]
    batches.clear()
    evaluated(*(replace(config, worlds=10) for config in configs))
    assert batches == [(8, 8)] * 4, "whole objects"
    batches.clear()
    evaluated(*(replace(config, engine="mujoco") for config in configs))
    assert batches == [(4, 4)] * 8, "native worlds of one object are stepped together"
    others = {"squeeze_split": "balanced"}, {"episodes": 5}, {"engine": "mujoco"}
    for other in (*others, {"controller": "grip", "grip": GripConfig()}):
        with pytest.raises(ValueError, match="share no task"):
            evaluated(usual, replace(usual, **other))
    batches.clear()
    beside = own.world, own.names, configs[:2], None, own.states.reached, Console()
    run.evaluate_beside(*beside, room=3)
    assert batches == [(16, 24)], "of the size of fuller ones"
