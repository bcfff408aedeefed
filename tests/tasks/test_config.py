"""The closing task's numbers: their values, their ranges, and where those of old files go."""

import json
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.learning.policy import load_policy
from mjx_grasp.records.settings import to_record
from mjx_grasp.tasks.config import ClosingTaskConfig, RewardConfig, StartNoise, SuccessConfig
from mjx_grasp.tasks.record import task_from_record
from mjx_grasp.training import config as training_config
from mjx_grasp.training.config import preset_config, stored_config

FLAT = {
    "control_dt": (0.01, "control_dt"),
    "episode_s": (4.0, "episode_s"),
    "finger_action_rate": (5.0, "action.finger_rate"),
    "arm_action_rate": (0.15, "action.arm_rate"),
    "residual": ("leaky", "action.residual"),
    "residual_keep": (0.8, "action.keep"),
    "residual_limit": (0.25, "action.limit"),
    "guidance_speed": (0.08, "guidance.speed"),
    "guidance_slowdown": (0.02, "guidance.slowdown"),
    "guidance_return": (4.0, "guidance.return_rate"),
    "guidance_turn": (4.0, "guidance.turn_rate"),
    "command_angular_weight": (0.003, "guidance.turn_weight"),
    "hold_lead": (0.1, "guidance.lead"),
    "finger_damping": (1e-4, "guidance.damping"),
    "finger_rate_limit": (3.0, "guidance.rate_limit"),
    "grip_force": (1.0, "grip.force"),
    "grip_ramp_s": (0.5, "grip.ramp_s"),
    "arrival_distance": (0.005, "grip.arrival"),
    "grip_together": (True, "grip.together"),
    "approach_s": (1.0, "grip.approach_s"),
    "acquisition_s": (1.6, "stages.acquisition_s"),
    "acquisition_fingers": (2, "stages.fingers"),
    "lift_speed": (0.15, "lift.speed"),
    "lift_height": (0.15, "lift.height"),
    "lift_ramp_s": (0.2, "lift.ramp_s"),
    "lift_delay_s": (0.5, "lift.delay_s"),
    "arm_damping": (1e-4, "lift.damping"),
    "observer_gain": (50.0, "observer.gain"),
    "stall_speed": (0.1, "observer.stall_speed"),
    "contact_torque": (0.03, "observer.contact_torque"),
    "contact_ticks": (3, "observer.contact_ticks"),
    "stop_margin": (0.03, "observer.stop_margin"),
    "reach_weight": (3.0, "reward.reach"),
    "reach_scale": (0.5, "reward.reach_scale"),
    "reach_floor": (0.02, "reward.reach_floor"),
    "angular_weight": (0.05, "reward.turn_weight"),
    "contact_weight": (1.0, "reward.contact"),
    "lift_weight": (2.0, "reward.lift"),
    "lift_reward_scale": (0.1, "reward.lift_scale"),
    "action_rate_weight": (-0.01, "reward.action_rate"),
    "action_acceleration_weight": (-0.005, "reward.action_acceleration"),
    "success_height": (0.10, "success.height"),
    "success_hold_s": (0.5, "success.hold_s"),
    "success_slip": (0.03, "success.slip"),
}
"""The first version's flat task: its names, its defaults, and where each number stands today."""

FIRST = {name: value for name, (value, _) in FLAT.items()}


OTHERS = {
    **{"residual": "integrated", "grip_together": False},
    **{"acquisition_fingers": 1, "contact_ticks": 4},
}
"""Possible values that are not the default, of fields that are no fractions."""


PATHS = {path for _, path in FLAT.values()}


def numbers(config, prefix=""):
    """Every value of a nested configuration by its path."""
    found = {}
    for field in fields(config):
        value, path = getattr(config, field.name), prefix + field.name
        found |= numbers(value, f"{path}.") if is_dataclass(value) else {path: value}
    return found


def test_defaults_are_the_published_task():
    c = ClosingTaskConfig()
    assert (c.control_dt, c.episode_s, c.episode_ticks) == (0.01, 4.0, 400)
    assert (c.reward.reach, c.reward.contact, c.reward.lift) == (3.0, 1.0, 2.0)
    assert (c.reward.action_rate, c.reward.action_acceleration) == (-0.01, -0.005)
    assert (c.success.height, c.success.hold_s, c.success.slip) == (0.10, 0.5, 0.03)


def test_no_default_has_changed_since_the_first_version():
    assert first_numbers(ClosingTaskConfig()) == {path: value for value, path in FLAT.values()}


def first_numbers(task):
    """The numbers that the first version had too."""
    return {path: value for path, value in numbers(task).items() if path in PATHS}


def test_what_came_later_changes_nothing_where_it_is_not_asked_for():
    later = {path: x for path, x in numbers(ClosingTaskConfig()).items() if path not in PATHS}
    off = {
        "grip.split": "even",
        "grip.direction": "normals",
        "grip.follow": 0.0,
        "grip.friction": None,
        "grip.settles": False,
        "observation.forces": False,
        "observation.budget": False,
        "observation.ticks_ago": (0, 1),
        "reward.held": 0.0,
        "reward.force": 0.0,
        "reward.over_budget": 0.0,
        "reward.spent": 0.0,
        "reward.hard": 0.0,
        "action.grip_range": 1.0,
    }
    assert {path: later[path] for path in off} == off


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (ClosingTaskConfig, "control_dt", 0.0),
        (ClosingTaskConfig, "episode_s", -1.0),
        (ClosingTaskConfig, "episode_s", 0.001),
        (RewardConfig, "reach", float("nan")),
        (RewardConfig, "lift_scale", 0.0),
        (SuccessConfig, "height", 0.0),
        (StartNoise, "offset_m", -0.001),
        (StartNoise, "offset_m", 5.0),
        (StartNoise, "angle_rad", 5.0),
        (StartNoise, "friction", (0.0, 0.8)),
        (StartNoise, "friction", (0.9, 0.8)),
        (StartNoise, "mass_scale", (0.0, 1.0)),
        (StartNoise, "mass_scale", (1.0, float("inf"))),
    ],
)
def test_impossible_tasks_and_noises_are_refused_by_name(kind, field, value):
    with pytest.raises(InputError, match=rf"^{kind.__name__}\.{field}: "):
        kind(**{field: value})


def test_the_first_versions_task_is_read_number_by_number():
    stored = load_policy(Path(__file__).parents[1] / "data" / "v1" / "policy.npz").meta["task"]
    assert stored == FIRST
    read = first_numbers(task_from_record(stored))
    assert read == {path: stored[name] for name, (_, path) in FLAT.items()}


@pytest.mark.parametrize("name", FLAT)
def test_each_number_of_a_flat_task_goes_to_its_own_place(name):
    """Also where two of them have the same default."""
    value, path = FLAT[name]
    other = value * 1.25 if isinstance(value, float) else OTHERS[name]
    changed = numbers(task_from_record(FIRST | {name: other}))
    assert changed == numbers(ClosingTaskConfig()) | {path: other}


def test_todays_task_survives_being_written():
    task = task_from_record(FIRST | {"grip_force": 2.5, "grip_together": False})
    record = json.loads(json.dumps(to_record(task)))
    assert task_from_record(record) == task
    assert record["grip"]["force"] == 2.5 and "grip_force" not in record


@pytest.mark.parametrize("name", FLAT)
def test_a_flat_task_has_to_be_whole(name):
    """What is missing from a list that had no optional fields is not known today either."""
    torn = {k: v for k, v in FIRST.items() if k != name}
    with pytest.raises(InputError, match=rf"^task\.{name}: found 'nothing', expected all fields"):
        task_from_record(torn)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (None, "^task: found None, expected a mapping of some of control_dt"),
        ([1.0], "^task: found"),
        (FIRST | {"grip_power": 2.0}, r"^task\.grip_power: found 2\.0.*no others"),
        (FIRST | {"grip": {"force": 1.0}}, r"^task\.grip: found .*no others"),
        ({"grip_power": 2.0}, "^task: found 'grip_power', expected some of control_dt"),
        ({"grip": {"power": 2.0}}, r"^task\.grip: found 'power', expected some of force"),
        ({"grip": 2.0}, r"^task\.grip: found 2\.0, expected a mapping of some of force"),
        ({"grip": {"force": -1.0}}, r"^task\.grip\.force: found -1\.0"),
        pytest.param(
            *(FIRST | {"contact_ticks": 2.5}, r"^task\.observer\.contact_ticks: found 2\.5.*whole"),
            marks=pytest.mark.wrong_types,
        ),
        (FIRST | {"lift_ramp_s": 1.1}, r"^LiftConfig\.ramp_s: found 1\.1"),
    ],
)
def test_other_tasks_are_refused_by_name(record, message):
    with pytest.raises(InputError, match=message):
        task_from_record(record)


def test_a_policys_file_may_hold_only_what_differs():
    """Fields that came later, or that a hand has left out, have their defaults."""
    task = task_from_record({"episode_s": 2.0, "grip": {"force": 3.0}})
    changed = {"episode_s": 2.0, "grip.force": 3.0}
    assert numbers(task) == numbers(ClosingTaskConfig()) | changed


def test_a_run_of_the_first_version_keeps_its_task(tmp_path):
    record = to_record(preset_config("cpu")) | {"task": FIRST | {"episode_s": 0.3}}
    (tmp_path / "config.json").write_text(json.dumps(record))
    assert numbers(stored_config(tmp_path).task) == numbers(ClosingTaskConfig(episode_s=0.3))
    (tmp_path / "config.json").write_text(json.dumps(record | {"task": {"grip_force": 1.0}}))
    with pytest.raises(FileError, match=r"config\.json.*task\."):
        stored_config(tmp_path)


TASK_OF_PAPER = {
    "action.residual": "integrated",
    "grip.together": False,
    "grip.arrival": 0.0,
    "grip.approach_s": None,
    "grip.freezes": False,
    "lift.delay_s": 0.0,
    "reward.lift_speed": 0.15,
}
"""What the publication has otherwise than our default."""
TASK_THAT_FEELS = {
    "action.grip_range": 3.0,
    "action.arm_settles": True,
    "grip.force": 1.5,
    "grip.split": "balanced",
    "grip.direction": "line",
    "grip.follow": 0.05,
    "grip.settles": True,
    "grip.friction": 0.4,
    "observation.forces": True,
    "observation.budget": True,
    "reward.held": 4.0,
    "reward.over_budget": -5.0,
    "reward.spent": -1.0,
    "reward.hard": -0.2,
}
"""What a policy that feels has otherwise."""


@pytest.mark.parametrize("gpu", [False, True])
def test_presets_change_what_they_must_and_no_more(monkeypatch, gpu):
    monkeypatch.setattr(training_config, "has_gpu", lambda: gpu)
    default, task = training_config.TrainConfig(), numbers(ClosingTaskConfig())
    feeling = ("cpu", "gpu") if gpu else ("cpu",)
    for name in (*feeling, "paper"):
        preset = preset_config(name)
        assert (
            numbers(preset.task)
            == task
            | {
                "paper": TASK_OF_PAPER,
                "cpu": TASK_THAT_FEELS | {"reward.hard": -1.0},
                "gpu": TASK_THAT_FEELS,
            }[name]
        )
        assert (preset.noise == default.noise) == (name == "paper")
        stiffness = (1.0, 1.0) if name == "paper" else (0.5, 2.0)
        assert preset.noise.robot == replace(default.noise.robot, stiffness=stiffness)
        assert preset.loop == default.loop
        for field in ("robot", "handoffs", "seed", "evaluation_episodes", "out", "resume"):
            assert getattr(preset, field) == getattr(default, field)
