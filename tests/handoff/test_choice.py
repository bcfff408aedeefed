"""Which candidates become states, which of those are kept, and which part of a set is whose."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_handoff_dataset import equal, some

from mjx_grasp.handoff.config import HandoffConfig, IkConfig
from mjx_grasp.handoff.generate import HandoffGenerator, _Accepted
from mjx_grasp.handoff.states import eligible, states_of

BAD, GOOD = 1.0, 0.0  # residuals on either side of the tolerance [m]


def first_clear(residual, *, variant=(2, 2), axis=1, usable=(True,) * 6, limit=False, hit=None):
    """Two starts, the second one cheaper; the choice and the reason against it."""
    starts = len(variant)
    solution = SimpleNamespace(
        cost=np.arange(starts)[::-1],
        residual=np.array(residual)[:, None] * np.ones(3),
        at_limit=np.full(starts, limit),
        q=np.arange(starts),
    )
    config = SimpleNamespace(_config=HandoffConfig(out=Path("x.npz"), ik=IkConfig()))
    return HandoffGenerator._first_clear(
        config,
        solution,
        np.full(starts, axis),
        np.array(variant),
        np.array(usable),
        lambda q: (hit or {}).get(int(q)),
    )


def test_the_cheapest_start_that_nothing_speaks_against_is_taken():
    assert first_clear([GOOD, GOOD]) == (1, None)
    assert first_clear([GOOD, BAD]) == (0, None)
    assert first_clear([GOOD, GOOD], hit={1: "hand-table"}) == (0, None)
    assert first_clear([GOOD, GOOD], variant=(2, 4)) == (0, None)  # the other has another axis
    assert first_clear([GOOD, GOOD], variant=(2, 3), usable=(True,) * 3 + (False,) * 3) == (0, None)


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("unreachable", {"residual": [BAD, BAD]}),
        ("limits", {"residual": [BAD, BAD], "limit": True}),
        ("reach-axis", {"residual": [BAD, GOOD], "axis": 0}),
        ("hand-object", {"residual": [BAD, GOOD], "hit": {1: "hand-object"}}),
        ("self", {"residual": [GOOD, GOOD], "hit": {0: "self"}, "variant": (2, 4)}),
    ],
)
def test_a_refused_candidate_says_what_met_the_start_that_got_farthest(reason, change):
    assert first_clear(**change) == (None, reason)


def test_few_states_of_each_candidate_and_one_of_every_pose_first():
    config = HandoffConfig(out=Path("x.npz"), per_object=6, max_per_candidate=2)
    pairs = [(pose, candidate) for pose in range(4) for candidate in (7, 8, 9)]
    accepted = [_Accepted(pose, 0, candidate, {}) for pose, candidate in pairs]
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
