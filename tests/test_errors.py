"""What errors say, in this process and from another one."""

import copy
import pickle
from pathlib import Path

import pytest

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.language.grounding import GroundingError


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (InputError("--mass", -1.0, "a mass"), "--mass: found -1.0, expected a mass"),
        (InputError("--objects", "mugg", "mug"), "--objects: found 'mugg', expected mug"),
        (FileError("a/b.npz", "nothing", "a set"), "a/b.npz: found nothing, expected a set"),
        (InputError("--policy", Path("a.npz"), "one"), "--policy: found 'a.npz', expected one"),
        (
            GroundingError("by the cap", "no point", "one"),
            "instruction: found 'by the cap', no point; expected one",
        ),
    ],
)
def test_errors_say_what_was_found_and_survive_a_way_between_processes(error, said):
    error.add_note("and this")
    for same in (error, pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert str(same) == said
        assert type(same) is type(error) and vars(same) == vars(error)
