"""Felt forces and contacts: measures of series with known answers, and the script on one object."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from mjx_grasp.errors import InputError

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def experiments(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    yield
    for name in ("sensed_forces", "sensing", "sensing_figure", "sensing_tables", "markdown_tables"):
        sys.modules.pop(name, None)


def series(text):
    return np.array([c == "x" for c in text])[:, None]


def test_precision_and_recall_count_ticks(experiments):
    from sensing import flag_score

    flag, contact = series("..xxxx..x."), series("...xxxxx..")
    score = flag_score(flag, contact, np.ones_like(flag))
    assert score == {"precision": 3 / 5, "recall": 3 / 5, "f1": 3 / 5}
    until = series("xxxxxxxx..")  # the false flag near the end does not count
    assert flag_score(flag, contact, until)["precision"] == 3 / 4
    nothing = np.zeros_like(flag)
    assert flag_score(nothing, contact, until) == {"precision": None, "recall": 0.0, "f1": 0.0}
    assert flag_score(nothing, nothing, until) == {"precision": None, "recall": None, "f1": None}


@pytest.mark.parametrize(
    "flag, contact, expected",
    [
        ("....xx....", "..xxxxx...", (1, 0, 0, [2])),
        ("..xxx.....", "..xxxxx...", (1, 0, 0, [0])),
        (".xxxx.....", "..xxxxx...", (1, 1, 0, [])),  # the signal was there before
        (".......xx.", "..xxxxx...", (1, 0, 1, [])),  # too late: the contact is over
        ("..x...x...", "..x..xxx..", (1, 0, 0, [1])),  # the first did not last
        ("xx........", "xxx.......", (1, 0, 0, [0])),
        ("x.........", "..xx......", (0, 0, 0, [])),  # no contact lasts
        (".........x", ".......xxx", (1, 0, 0, [2])),
    ],
)
def test_onsets_are_early_late_or_missed(experiments, flag, contact, expected):
    from sensing import first_onsets

    found = first_onsets(series(flag), series(contact), 3)
    assert (*found[:3], found.delay.tolist()) == expected


def test_onsets_of_several_series_add_up(experiments):
    from sensing import first_onsets, onset_record

    flag = np.concatenate([series("...xx"), series("....."), series("..xxx")], axis=1)
    contact = np.repeat(series(".xxxx"), 3, axis=1)
    record = onset_record(first_onsets(flag, contact, 2), 0.01)
    assert (record["contacts"], record["early"], record["missed"]) == (3, 0, 1)
    assert record["delay_ms"] == pytest.approx([15.0, 19.5])


def test_onsets_refuse_what_has_none(experiments):
    from sensing import first_onsets

    with pytest.raises(InputError, match="one tick or more"):
        first_onsets(series("x"), series("x"), 0)
    with pytest.raises(InputError, match="shape of contact"):
        first_onsets(series("xx"), series("x"), 1)


def test_errors_of_forces_are_of_their_norms_and_of_the_vectors(experiments):
    from sensing import force_errors

    true = np.array([[[3.0, 4.0, 0.0]], [[0.0, 0.0, 2.0]], [[9.0, 9.0, 9.0]]])
    turned = np.array([[[-3.0, 4.0, 0.0]], [[0.0, 0.0, 3.0]], [[0.0, 0.0, 0.0]]])
    found = force_errors(turned, true, np.array([[True], [True], [False]]))
    assert found["ticks"] == 2 and found["true_n"][0] == pytest.approx(3.5)
    assert found["norm_error_n"] == pytest.approx([0.5, 0.95])
    assert found["vector_error_n"] == pytest.approx([3.5, 5.75])
    empty = force_errors(turned, true, np.zeros((3, 1), bool))
    assert empty["ticks"] == 0 and empty["vector_error_n"] == [None, None]


def test_every_tick_has_one_phase(experiments):
    from sensing import PHASES, phase_masks

    masks = phase_masks(series("..xxxxxx"), series("....xx.."))
    assert [masks[p].ravel().tolist().index(True) for p in PHASES] == [0, 2, 4, 6]
    assert (sum(m.astype(int) for m in masks.values()) == 1).all()


def test_thresholds_are_chosen_by_recall_among_the_precise(experiments):
    from sensed_forces import chosen

    rows = [
        {"precision": p, "recall": r}
        for p, r in ((0.98, 0.99), (0.995, 0.7), (0.99, 0.8), (None, None))
    ]
    assert chosen(rows, 0.99) == rows[2]
    assert chosen(rows, 0.999) is None


def test_bad_settings_are_refused(experiments, tmp_path):
    from sensed_forces import SensingConfig, main

    out = tmp_path / "out.json"
    for settings, message in (
        ({"calibration_objects": ("apple", "lemon")}, r"lemon.*no object that is held out"),
        ({"drawn_object": "mug"}, r"mug.*one of apple"),
        ({"parts": ()}, "report, calibration"),
        ({"figure": tmp_path / "none" / "a.png"}, "does not exist"),
    ):
        with pytest.raises(InputError, match=message):
            main(SensingConfig(**{"out": out, "figure": None, "objects": ("apple",)} | settings))
    assert not out.exists()


@pytest.mark.long
def test_one_object_is_felt_drawn_and_told_of(experiments, tmp_path, monkeypatch):
    import sensed_forces
    import sensing_tables

    out, figure = tmp_path / "felt.json", tmp_path / "felt.png"
    one = sensed_forces.conditions_of(sensed_forces.SensingConfig())[:1]
    monkeypatch.setattr(sensed_forces, "conditions_of", lambda config: one)
    monkeypatch.setattr(sensed_forces, "CONTROLLERS", {"grip": sensed_forces.REACTING})
    for module in (sensed_forces, sensing_tables):
        monkeypatch.setattr(module, "SHORT", (0,))
    sensed_forces.main(
        sensed_forces.SensingConfig(
            out=out,
            figure=figure,
            objects=("foam_brick",),
            episodes=2,
            calibration_objects=("foam_brick",),
            calibration_episodes=2,
            contact_torques=(0.02,),
            stall_speeds=(0.4,),
        )
    )
    content = json.loads(out.read_text())
    assert content["schema"] == "mjx_grasp.sensed_forces/1" and content["provenance"]["git"]
    (row,) = content["rows"]
    for finger in row["fingers"].values():
        assert finger["contact"]["ticks"] > 100 and finger["free_motion_n"][0] < 0.2
        phases = finger["phases"].values()
        assert sum(p["ticks"] for p in phases) == finger["contact"]["ticks"]
        # A wrong sign of the solver's force would make it about twice the force.
        assert finger["contact"]["vector_error_n"][0] < finger["contact"]["true_n"][0]
    sweep = content["calibration"]["rows"]
    assert [(r["contact_torque"], r["stall_speed"]) for r in sweep] == [
        *((0.02, 0.1), (0.02, 0.4), (0.03, 0.1), (0.03, 0.4))
    ]
    assert sweep[1]["recall"] >= sweep[3]["recall"] >= sweep[2]["recall"]
    text = sensing_tables.sensed_forces(out)
    assert "2 grasps of 1 objects" in text and "| grip | exact torques | thumb |" in text
    assert figure.stat().st_size > 10_000
