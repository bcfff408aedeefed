"""The least mean force that holds a weight at three contacts, and what the table says of it."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_grasp.errors import InputError
from mjx_grasp.grasp.wrench_margin import ContactConfig
from mjx_grasp.objects.model import ObjectModel
from mjx_grasp.records.provenance import provenance

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
STATES = EXPERIMENTS.parent / "assets" / "handoffs_standins.npz"
WALLS = np.array([[0.03, 0.0, 0.0], [-0.03, 0.012, 0.0], [-0.03, -0.012, 0.0]])
INWARD = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
CENTRE = np.zeros(3)
Least = Callable[..., float]


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Scripts by name."""
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return importlib.import_module


@pytest.fixture
def least(script: Callable[[str], ModuleType]) -> Least:
    function: Least = script("least_force").least_mean_force
    return function


@pytest.mark.parametrize("mu", [0.4, 0.8, 1.1])
def test_on_upright_walls_it_is_the_closed_form(least: Least, mu: float) -> None:
    expected = 5.0 * math.hypot(1.0, mu) / (3.0 * mu)
    assert least(WALLS, INWARD, CENTRE, 5.0, ContactConfig(friction=mu)) == pytest.approx(
        expected, rel=1e-3
    )


def test_from_below_it_is_the_weight_alone(least: Least) -> None:
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    around = np.array([[0.02, 0.0, 0.0], [-0.01, 0.02, 0.0], [-0.01, -0.02, 0.0]])
    assert least(around, up, CENTRE, 6.0, ContactConfig()) == pytest.approx(2.0, rel=1e-6)


def test_what_cannot_oppose_holds_nothing(least: Least) -> None:
    same_side = np.tile([1.0, 0.0, 0.0], (3, 1))
    assert least(WALLS, same_side, CENTRE, 5.0, ContactConfig()) == float("inf")


def test_it_is_proportional_to_the_weight_and_the_same_wherever_one_looks_from(
    least: Least,
) -> None:
    rng = np.random.default_rng(3)
    contact = WALLS + rng.normal(0.0, 0.004, (3, 3))
    inward = INWARD + rng.normal(0.0, 0.1, (3, 3))
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    one = least(contact, inward, CENTRE, 2.0, ContactConfig())
    assert math.isfinite(one)
    assert least(contact, inward, CENTRE, 6.0, ContactConfig()) == pytest.approx(3 * one, rel=1e-6)
    turn, shift = Rotation.from_euler("z", 0.7), np.array([0.3, -0.2, 0.5])
    moved = least(turn.apply(contact) + shift, turn.apply(inward), shift, 2.0, ContactConfig())
    assert moved == pytest.approx(one, rel=0.01)  # the fan of forces turns with the frame
    slippery = least(contact, inward, CENTRE, 2.0, ContactConfig(friction=0.5))
    assert slippery > one


def test_a_weight_beside_the_contacts_takes_more(least: Least) -> None:
    beside = least(WALLS, INWARD, np.array([0.0, 0.03, 0.0]), 5.0, ContactConfig())
    assert beside > 1.05 * least(WALLS, INWARD, CENTRE, 5.0, ContactConfig())


def test_the_table_has_the_share_of_states_for_which_a_budget_can_do(
    script: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    rows = [
        {"object": "a", "friction": 0.8, "mass_kg": 0.1, "forces_n": [1.0, 2.0, 3.5, None]},
        {"object": "b", "friction": 0.8, "mass_kg": 0.2, "forces_n": [1.0, 1.0, 1.0, 1.0]},
    ]
    path = tmp_path / "least_force.json"
    path.write_text(json.dumps({"rows": rows}))
    table = script("closing_tables").least_by_contacts(path)
    assert "(1.0–inf) | 50 | 75 |" in table
    for line, within in (("mean", 87.5), ("mean, 10 % above", 87.5), ("mean, 20 % above", 75.0)):
        assert f"| **{line}** |  |  | **75.0** | **{within}** |" in table


def test_objects_without_states_are_left_out(
    script: Callable[[str], ModuleType], tmp_path: Path
) -> None:
    module, out = script("least_force"), tmp_path / "least.json"
    names = ("foam_brick", "mini_soccer_ball")
    module.main(module.LeastForceConfig(objects=names, handoffs=STATES, frictions=(0.8,), out=out))
    found = json.loads(out.read_text())
    assert [row["object"] for row in found["rows"]] == ["foam_brick"]
    assert found["not_eligible"] == ["mini_soccer_ball"]
    with pytest.raises(InputError, match="mini_soccer_ball"):
        module.main(module.LeastForceConfig(objects=names[1:], handoffs=STATES, out=out))


def test_what_was_looked_at_before_it_was_stopped_is_not_looked_at_again(
    script: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = script("least_force")
    asked: list[str] = []
    stopped_at = ["apple"]

    def least(states: object, state: int, obj: ObjectModel, friction: float) -> float:
        asked.append(obj.name)
        if obj.name in stopped_at:
            raise KeyboardInterrupt
        return math.inf if state % 2 else 1.0

    monkeypatch.setattr(module, "_least_of", least)
    monkeypatch.setattr(module, "provenance", lambda seed: provenance(seed) | {"git": "0" * 40})
    monkeypatch.setattr("mjx_grasp.records.journal.is_committed", lambda git: True)
    names, out = ("rubiks_cube", "apple"), tmp_path / "least.json"
    config = module.LeastForceConfig(objects=names, handoffs=STATES, frictions=(0.8,), out=out)
    with pytest.raises(KeyboardInterrupt):
        module.main(config)
    stopped_at.clear()
    module.main(config)
    rows = {row["object"]: row["forces_n"] for row in json.loads(out.read_text())["rows"]}
    assert list(rows) == list(names) and set(rows["apple"]) == {1.0, None}
    assert asked.count("rubiks_cube") == len(rows["rubiks_cube"])
    assert asked.count("apple") == len(rows["apple"]) + 1
