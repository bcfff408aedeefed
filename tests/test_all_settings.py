"""Every settings class of the package: what no field may be is refused by the field's name."""

import copy
import inspect
import sys

import pytest
import walk

from mjx_grasp.errors import InputError
from mjx_grasp.records.settings import Settings, _hints, from_record, to_record

CLASSES = walk.settings_classes()


def names(kinds):
    return [kind.__qualname__ for kind in kinds]


def changed(settings, name, value):
    """The settings with another value, past the types that the tests check when they are made."""
    new = copy.copy(settings)
    object.__setattr__(new, name, value)
    new.__post_init__()


@pytest.mark.parametrize("kind", CLASSES, ids=names(CLASSES))
def test_what_no_field_may_be_is_refused_by_its_name(kind):
    good = walk.example(kind)
    for name, hint in _hints(kind).items():
        for bad in walk.impossible(hint, getattr(good, name)):
            with pytest.raises(InputError) as refusal:
                changed(good, name, bad)
                pytest.fail(f"{name} = {bad!r} was taken")
            assert refusal.value.field == good.name_of(name), f"{name} = {bad!r}"
            assert refusal.value.expected


@pytest.mark.parametrize("kind", CLASSES, ids=names(CLASSES))
def test_every_number_has_a_range(kind):
    without = [name for name, hint in _hints(kind).items() if not all(walk.numbers(hint))]
    assert not without


@pytest.mark.parametrize("kind", CLASSES, ids=names(CLASSES))
def test_the_defaults_come_back_from_a_file(kind):
    good = walk.example(kind)
    assert from_record(kind, to_record(good)) == good


def test_every_class_that_is_called_a_config_is_checked():
    loaded = [m for name, m in sys.modules.items() if name.startswith("mjx_grasp.")]
    classes = {
        kind
        for module in loaded
        for name, kind in inspect.getmembers(module, inspect.isclass)
        if name.endswith("Config") and kind.__module__.startswith("mjx_grasp.")
    }
    assert len(classes) > 15
    assert not [kind for kind in classes if not issubclass(kind, Settings)]
