"""Which candidates become states, which of those are kept, and which part of a set is whose."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_handoff_dataset import equal, some

from mjx_grasp.handoff.attempts import Attempts
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.handoff.generate import HandoffGenerator, _Accepted
from mjx_grasp.handoff.states import eligible, states_of, with_states

BAD, GOOD = 1.0, 0.0  # errors on either side of the tolerance [m]


def first_clear(
    error,
    *,
    agrees=(True, True),
    usable=(True, True),
    limit=False,
    lift=(GOOD, GOOD),
    touch=(GOOD, GOOD),
    holds=(True, True),
    hit=None,
):
    """Two starts, the second one cheaper; the choice and the reason against it."""
    cost = np.where(usable, [1.0, 0.0], np.inf)
    found = Attempts(
        cost=cost,
        error=np.array(error)[:, None] * np.ones(3),
        at_limit=np.full(2, limit),
        agrees=np.array(agrees),
        lift_error=np.array(lift),
        touch_error=np.array(touch),
        holds=np.array(holds),
        q=np.arange(2),
        position=np.zeros((2, 3, 3)),
        normal=np.zeros((2, 3, 3)),
    )
    generator = SimpleNamespace(_config=HandoffConfig(out=Path("x.npz")))
    return HandoffGenerator._first_clear(generator, found, lambda q: (hit or {}).get(int(q)))


def test_the_cheapest_start_that_nothing_speaks_against_is_taken():
    assert first_clear([GOOD, GOOD]) == (1, None)
    assert first_clear([GOOD, BAD]) == (0, None)
    assert first_clear([GOOD, GOOD], hit={1: "hand-table"}) == (0, None)
    assert first_clear([GOOD, GOOD], agrees=(True, False)) == (0, None)
    assert first_clear([GOOD, GOOD], usable=(True, False)) == (0, None)
    assert first_clear([GOOD, GOOD], lift=(GOOD, BAD)) == (0, None)
    assert first_clear([GOOD, GOOD], touch=(GOOD, BAD)) == (0, None)
    assert first_clear([GOOD, GOOD], holds=(True, False)) == (0, None)


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("unreachable", {"error": [BAD, BAD]}),
        ("limits", {"error": [BAD, BAD], "limit": True}),
        ("reach-axis", {"error": [BAD, GOOD], "agrees": (False, False)}),
        ("lift", {"error": [GOOD, GOOD], "agrees": (True, False), "lift": (BAD, BAD)}),
        ("touch", {"error": [GOOD, GOOD], "lift": (GOOD, BAD), "touch": (BAD, BAD)}),
        ("hold", {"error": [GOOD, GOOD], "touch": (GOOD, BAD), "holds": (False, False)}),
        ("hand-object", {"error": [BAD, GOOD], "hit": {1: "hand-object"}}),
        ("self", {"error": [GOOD, GOOD], "hit": {0: "self"}, "agrees": (True, False)}),
    ],
)
def test_a_refused_candidate_says_what_met_the_start_that_got_farthest(reason, change):
    assert first_clear(**change)[1] == reason


def test_few_states_of_each_candidate_and_one_of_every_pose_first():
    config = HandoffConfig(out=Path("x.npz"), per_object=6, max_per_candidate=2)
    pairs = [(pose, candidate) for pose in range(4) for candidate in (7, 8, 9)]
    accepted = [_Accepted(pose, candidate, {}) for pose, candidate in pairs]
    chosen = HandoffGenerator._choose(SimpleNamespace(_config=config), accepted)
    # The first candidate of every pose is the same one: it is used twice.
    assert [(s.pose, s.candidate) for s in chosen[:2]] == [(0, 7), (1, 7)]
    assert len(chosen) == 6
    assert sorted(s.candidate for s in chosen) == [7, 7, 8, 8, 9, 9]


def test_no_state_of_the_evaluation_is_one_of_the_training():
    handoffs = some(n=60)
    names = ["can", "box"]
    training, evaluation, whole = (
        states_of(handoffs, names, part) for part in ("training", "evaluation", "all")
    )
    for part in (training, evaluation, whole):
        assert part.object_names == ("can", "box")
    assert equal(whole, handoffs.select(names))
    poses = [{tuple(p) for p in part.object_pos} for part in (training, evaluation, whole)]
    assert not poses[0] & poses[1]
    assert poses[0] | poses[1] == poses[2]
    assert 0.2 < len(evaluation) / len(whole) < 0.3
    assert eligible(["ball", "box"], handoffs) == (["box"], ["ball"])


def test_the_only_state_of_an_object_is_the_trainings():
    handoffs = some(n=60)
    can = handoffs.object_index == handoffs.object_names.index("can")
    few = handoffs.take(np.flatnonzero(~can | (np.cumsum(can) == 1)))
    names = ["can", "box", "ball"]
    for part, expected in (("training", ["can", "box"]), ("evaluation", ["box"])):
        have, without, states = with_states(names, few, part)
        assert (have, set(without)) == (expected, set(names) - set(expected))
        assert states.object_names == tuple(expected)
        assert equal(states, states_of(few, expected, part))
