"""The catalogue: its counts, its groups, and how wrong names and damaged files are refused."""

import math
import re

import numpy as np
import pytest

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.objects import catalogue
from mjx_grasp.objects.catalogue import groups, load_catalogue, resolve
from mjx_grasp.objects.model import load_object, load_objects
from mjx_grasp.objects.parametric import stand_in

THE_EIGHT = {
    "potted_meat_can",
    "master_chef_can",
    "rubiks_cube",
    "sugar_box",
    "apple",
    "tomato_soup_can",
    "foam_brick",
    "pitcher_base_scaled",
}


def test_counts_of_the_splits():
    splits = [info.split for info in load_catalogue().values()]
    assert len(splits) == 34
    counts = {split: splits.count(split) for split in set(splits)}
    assert counts == {"train": 28, "held_out": 4, "figure_only": 1, "scaled": 1}


def test_the_eight_hold_the_scaled_pitcher_and_not_the_whole_one():
    assert set(groups()["eight"]) == THE_EIGHT


def test_held_out_objects_are_in_no_group_used_for_training():
    known = groups()
    assert set(known["held_out"]) == {"chips_can", "lemon", "orange", "peach"}
    assert not set(known["held_out"]) & (set(known["train"]) | set(known["eight"]))
    assert "wine_glass" not in known["train"] + known["held_out"]
    assert set(known["all"]) == set(load_catalogue())


def test_every_entry_is_of_the_size_and_weight_of_something_held_in_a_hand():
    for info in load_catalogue().values():
        assert 0.02 < info.mass < 1.2, info.name
        assert all(0.02 < d < 0.3 for d in info.published_dims_m), info.name
        assert len(info.published_dims_m) <= 3


def test_parts_lie_in_or_near_the_stand_in():
    for info in load_catalogue().values():
        low, high = stand_in(info.scan_of, info.scale).bounds
        for name, part in info.parts_on(scan=False).items():
            ends = [np.add(part.at, sign * np.divide(part.size, 2)) for sign in (-1, 1)]
            outside = max((low - ends[0]).max(), (ends[1] - high).max())
            assert outside < 0.015, f"{info.name}: {name}"
            assert min(part.size) > 0.005, f"{info.name}: {name}"


def test_parts_of_the_stand_in_are_those_of_the_scan_unless_it_says_otherwise():
    known = load_catalogue()
    assert known["mug"].parts_on(scan=False) is known["mug"].parts
    drill = known["power_drill"]
    assert drill.parts_on(scan=True) is drill.parts
    assert drill.parts_on(scan=False) is drill.stand_in_parts
    for info in known.values():
        assert not info.stand_in_parts or set(info.stand_in_parts) == set(info.parts)


def test_the_scaled_pitcher_is_the_pitcher_in_small():
    known = load_catalogue()
    whole, small = known["pitcher_base"], known["pitcher_base_scaled"]
    assert small.scan_of == "pitcher_base" and small.scale == 0.6
    assert small.scan_names == whole.scan_names == ("019_pitcher_base",)
    assert small.mass == whole.mass
    for a, b in zip(whole.published_dims_m, small.published_dims_m, strict=True):
        assert math.isclose(0.6 * a, b)
    for name, part in whole.parts.items():
        for own, other in zip(small.parts[name], part, strict=True):
            assert own == pytest.approx([0.6 * x for x in other], abs=1e-4)


def test_resolve_keeps_the_order_and_names_everything_once():
    assert resolve(["mug", "bowl", "mug"]) == ("mug", "bowl")
    mixed = resolve(["bowl", "eight", "apple"])
    assert mixed[0] == "bowl" and len(mixed) == 9
    assert set(resolve(["train", "held_out"])) <= set(resolve(["all"]))
    assert resolve(["all"]) == tuple(load_catalogue())


@pytest.mark.parametrize(
    ("wrong", "near"), [("aple", "apple"), ("tomato_can", "tomato_soup_can"), ("eigth", "eight")]
)
def test_an_unknown_name_is_refused_with_near_matches(wrong, near):
    with pytest.raises(InputError) as error:
        resolve(["mug", wrong])
    assert error.value.found == wrong and near in error.value.expected


def test_a_name_near_nothing_is_answered_with_the_groups():
    with pytest.raises(InputError, match="eight, train, held_out, all"):
        resolve(["qqqqqqqq"])


def test_where_one_object_is_wanted_no_group_is_suggested():
    for wrong in ("qqqqqqqq", "eigth", "al"):
        with pytest.raises(InputError) as error:
            load_object(wrong)
        assert not set(groups()) & set(re.findall(r"\w+", error.value.expected)), wrong
    with pytest.raises(
        InputError, match=r"mug, apple, …; where several objects may be given, also"
    ):
        resolve(["qqqqqqqq"])


def test_a_name_alone_is_one_name():
    assert resolve("mug") == ("mug",)
    assert resolve("eight") == groups()["eight"]
    assert [obj.name for obj in load_objects("rubiks_cube")] == ["rubiks_cube"]


def test_no_name_is_refused():
    with pytest.raises(InputError):
        resolve([])


GOOD = {
    "name": "thing",
    "ycb_id": "'000'",
    "split": "train",
    "mass_g": 100,
    "published_dims_mm": [50],
    "shape": "sphere",
}


def _entry(**changes):
    entry = {k: v for k, v in (GOOD | changes).items() if v is not None}
    return "objects:\n- " + "\n  ".join(f"{k}: {v}" for k, v in entry.items()) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        "objects: [",
        "",
        "things: []",
        "objects: 3",
        _entry(mass_g=None),
        _entry(mass_g=0),
        _entry(mass_g=".nan"),
        _entry(mass_g="heavy"),
        _entry(split="test"),
        _entry(published_dims_mm="[a]"),
        _entry(parts="{rim: [0, 0]}"),
        _entry(parts="{rim: {at: [0, 0, 0], size: [0, 0, -0.01]}}"),
        _entry(parts="{rim: {size: [0, 0, 0.01]}}"),
        _entry(parts="{rim: {at: [0, 0, 0], radius: 0.01}}"),
        _entry(parts="{rim: [0, 0, .inf]}"),
        _entry(parts="[rim]"),
        _entry() + _entry().removeprefix("objects:\n"),
    ],
)
def test_a_damaged_catalogue_is_refused_by_name(tmp_path, monkeypatch, text):
    path = tmp_path / "catalogue.yaml"
    path.write_text(text)
    monkeypatch.setattr(catalogue, "asset_path", lambda name: path)
    with pytest.raises(FileError) as error:
        load_catalogue()
    assert str(path) in str(error.value)


def test_the_catalogue_of_the_damage_tests_is_read_when_it_is_whole(tmp_path, monkeypatch):
    path = tmp_path / "catalogue.yaml"
    path.write_text(_entry())
    monkeypatch.setattr(catalogue, "asset_path", lambda name: path)
    thing = load_catalogue()["thing"]
    assert (thing.mass, thing.published_dims_m, thing.scan_names) == (0.1, (0.05,), ("000_thing",))
