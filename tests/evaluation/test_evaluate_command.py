"""What the command refuses, before anything is built."""

from pathlib import Path

import numpy as np
import pytest

from mjx_grasp import evaluate as module
from mjx_grasp.closing.config import MAX_ANGLE_RAD, MAX_OFFSET_M
from mjx_grasp.errors import InputError
from mjx_grasp.evaluation.config import EvaluateConfig
from mjx_grasp.evaluation.run import chosen_states
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.states import shipped_handoffs


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


def test_the_largest_errors_of_a_start_are_allowed():
    most = {"offset_mm": 1e3 * MAX_OFFSET_M, "angle_deg": 45.8}
    noise = EvaluateConfig(out=Path("x.json"), **most).noise
    assert noise.offset_m == pytest.approx(MAX_OFFSET_M)
    assert noise.angle_rad == pytest.approx(MAX_ANGLE_RAD, rel=1e-3)


def test_objects_without_states_are_refused_before_the_scene(monkeypatch):
    monkeypatch.setattr(module, "build_scene_of", None)
    with pytest.raises(InputError, match=r"--objects: found 'bowl'.*foam_brick"):
        module.main(EvaluateConfig(out=Path("x.json"), objects=("bowl",)))


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
