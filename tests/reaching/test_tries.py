"""What a search for plans tries, one after the other, until a posture is good enough."""

from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_grasp.grasp.targets import admissible, target_options
from mjx_grasp.heatmap.compute import heatmap_of
from mjx_grasp.heatmap.steering import steer_to
from mjx_grasp.objects.model import load_objects
from mjx_grasp.pipeline.assemble import grasper_of, whole_grasps
from mjx_grasp.pipeline.known import STEERED_AT_LEAST, STEERED_SCORE, known_object
from mjx_grasp.posture.surroundings import Surroundings
from mjx_grasp.reaching.plan_config import PlanConfig
from mjx_grasp.reaching.planning import Planner


def _steered_to_an_end(robot, name, end):
    """The planner of steered grasps, and what is known of a can whose one end is asked for."""
    (can,) = load_objects((name,))
    heatmap = heatmap_of(can, robot.hand)
    anchor = np.array([0.0, 0.0, float(end(can.mesh.vertices[:, 2]))])
    known = known_object(can, robot, heatmap, steer_to(heatmap, anchor))
    return grasper_of(robot, reaching=whole_grasps(steered=True)).planner, known, can.mesh.vertices


def test_near_an_anchor_on_the_table_those_are_looked_for_that_can_be_used(robot):
    """A can stands on the face that is asked for: none of the nearest candidates is high enough."""
    planner, known, vertices = _steered_to_an_end(robot, "tomato_soup_can", np.min)
    p_wo = jnp.array([0.5, 0.0, -float(vertices[:, 2].min())])
    around = Surroundings.still(known.shape, p_wo, jnp.eye(3))
    targets = planner.reacher.selection.targets
    options = target_options(known.candidates, targets)
    high = np.asarray(admissible(known.candidates, options, p_wo, jnp.eye(3), targets))
    usable = np.isin(np.arange(len(known.candidates.score)), options.candidate[high])
    score = np.asarray(known.candidates.score)
    assert not np.any(usable & (score >= STEERED_SCORE))
    near, held, easy, far = planner._wish(known.candidates, around)
    least, easy = [float(x) for x in near], np.asarray(easy)
    assert len(least) == len(STEERED_AT_LEAST) and least[0] >= least[-1] > 0
    for count, bound in zip(STEERED_AT_LEAST, least, strict=True):
        found = usable & (score >= bound)
        assert min(count, usable[score > 0].sum()) <= found.sum()
        assert (usable & (score > bound)).sum() < count
    higher = (usable[:, None] & (score[:, None] > score)).sum(axis=0)
    np.testing.assert_allclose(far, higher / usable.sum(), atol=1e-6)
    # Upright it is held as easily at every height.
    np.testing.assert_allclose(held, least[0], rtol=1e-6)
    assert easy.any() and not np.any(easy & ~usable)
    standing = Surroundings.still(known.shape, p_wo + jnp.array([0.0, 0.0, 0.3]), jnp.eye(3))
    assert planner._wish(known.candidates, standing).near[0] == STEERED_SCORE


def test_near_the_end_of_what_lies_those_that_hold_it_easily_are_nearer_to_its_middle(robot):
    planner, known, vertices = _steered_to_an_end(robot, "chips_can", np.max)
    lying = jnp.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    p_wo = jnp.array([0.5, 0.0, float(vertices[:, 0].max())])
    around = Surroundings.still(known.shape, p_wo, lying, known.com, known.weight)
    near, held, easy, _ = planner._wish(known.candidates, around)
    assert 0 < held < 0.1 * near[0]
    first = np.asarray(known.candidates.score) >= float(near[0])
    along = np.abs(np.asarray(known.candidates.thumb)[:, 2] - float(known.com[2]))
    assert along[np.asarray(easy)].max() < along[first].min()


class _Finds(Planner):
    """Finds a posture for every candidate of enough score that its `thumb` says is within reach."""

    def _search(self, library, candidates, light, far, around, q, key):
        least = self.reacher.selection.min_score
        possible = (candidates.score >= least) & (candidates.thumb[:, 0] > 0)
        cost = jnp.where(possible, 1.0 + 0.1 * jnp.arange(len(possible)), 1e4)
        cost = cost if far is None else cost + far
        best = jnp.argsort(cost)[:2]
        return _Found(cost[best], best)


class _Found(NamedTuple):
    cost: jax.Array
    plans: jax.Array


@pytest.mark.wrong_types
def test_lesser_candidates_are_looked_at_only_where_the_better_ones_are_out_of_reach():
    selection = SimpleNamespace(min_score=0.5)
    planner = _Finds(
        SimpleNamespace(selection=selection), replace(PlanConfig(), lesser_scores=(0.1, 0.0))
    )
    score = jnp.array([0.05, 0.2, 0.6, 0.9])
    valid = jnp.ones(4, bool)

    @jax.jit
    def search(reachable):
        candidates = SimpleNamespace(score=score, valid=valid, thumb=reachable[:, None])
        candidates._replace = lambda **new: SimpleNamespace(**(vars(candidates) | new))
        return planner.search(0, candidates, None, None, None)

    for reachable, expected in (
        ([1, 1, 0, 1], 3), ([1, 1, 1, 1], 2), ([1, 1, 0, 0], 1), ([1, 0, 0, 0], 0),
    ):  # fmt: skip
        assert search(jnp.array(reachable)).plans[0] == expected
    assert search(jnp.zeros(4, int)).cost[0] == 1e4, "nothing is within reach at all"


@pytest.mark.wrong_types
@pytest.mark.parametrize(("costs", "expected"), [((5, 30), 5), ((5, 14), 14), ((40, 30), 30)])
def test_a_poor_posture_for_what_was_asked_gives_way_to_a_better_one_alone(costs, expected):
    """Of a candidate with a low score and of one with a high score."""

    class Costly(_Finds):
        def _search(self, library, candidates, light, far, around, q, key):
            cost = jnp.where(candidates.score >= 0.5, jnp.array(costs, float), 1e4)
            return _Found(jnp.sort(cost)[:2], jnp.argsort(cost)[:2])

    planner = Costly(
        SimpleNamespace(selection=SimpleNamespace(min_score=0.5)),
        replace(PlanConfig(), lesser_scores=(0.0,), lesser_cost=15.0),
    )
    candidates = SimpleNamespace(score=jnp.array([0.1, 0.9]), valid=jnp.ones(2, bool))
    candidates._replace = lambda **new: SimpleNamespace(**(vars(candidates) | new))
    assert planner.search(0, candidates, None, None, None).cost[0] == expected


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("reachable", "failures", "expected"),
    [
        *[((1, 1, 1, 1), 0, 3), ((1, 1, 1, 0), 0, 2), ((1, 1, 0, 0), 0, 0)],
        *[((1, 1, 1, 1), 1, 2), ((1, 1, 0, 1), 1, 3), ((1, 1, 1, 1), 2, 0), ((1, 1, 1, 1), 3, 0)],
    ],
)
def test_a_wish_is_given_up_step_by_step_and_further_after_each_grasp_that_failed(
    reachable, failures, expected
):
    """Where all count, the first one costs least; the third holds the object easily."""

    class Wishes(_Finds):
        def _wish(self, candidates, around):
            scores = [jnp.float32(0.5), jnp.float32(0.2)]
            return scores, jnp.float32(0.1), jnp.arange(4) == 2, jnp.zeros(4)

    config = PlanConfig(at_least=(1, 2), lesser_scores=(0.0,), heavier=1.25, easily=1.45)
    planner = Wishes(SimpleNamespace(selection=SimpleNamespace(min_score=0.5)), config)
    candidates = SimpleNamespace(
        score=jnp.array([0.0, 0.1, 0.3, 0.9]),
        valid=jnp.ones(4, bool),
        thumb=jnp.array(reachable)[:, None],
    )
    candidates._replace = lambda **new: SimpleNamespace(**(vars(candidates) | new))
    found = planner.search(0, candidates, None, None, None, failures)
    assert found.plans[0] == expected


@pytest.mark.wrong_types
@pytest.mark.parametrize(("weight", "expected"), [(0.0, 0), (1.0, 0), (2.0, 3)])
def test_once_a_wish_is_given_up_what_is_nearer_to_it_may_still_be_preferred(weight, expected):
    """Two grasps have failed, so that a quarter of the weight is left.

    All candidates count, the first one's posture is best and the last one is nearest.
    """

    class Wishes(_Finds):
        def _wish(self, candidates, around):
            nothing = [jnp.float32(0.5)]
            return nothing, jnp.float32(0.5), jnp.ones(4, bool), jnp.array([0.75, 0.5, 0.25, 0.0])

    config = PlanConfig(at_least=(1,), lesser_scores=(0.0,), far_weight=weight)
    planner = Wishes(SimpleNamespace(selection=SimpleNamespace(min_score=0.5)), config)
    score = jnp.array([0.0, 0.1, 0.3, 0.9])
    candidates = SimpleNamespace(score=score, valid=jnp.ones(4, bool), thumb=jnp.ones((4, 1)))
    candidates._replace = lambda **new: SimpleNamespace(**(vars(candidates) | new))
    assert planner.search(0, candidates, None, None, None, 2).plans[0] == expected


@pytest.mark.wrong_types
@pytest.mark.parametrize("failures", [0, 1, 2])
def test_where_there_is_but_one_thing_to_try_it_is_tried_after_failures_too(failures):
    class Wishes(_Finds):
        def _wish(self, candidates, around):
            return [jnp.float32(0.5)], jnp.float32(0.5), jnp.ones(1, bool), jnp.zeros(1)

    selection = SimpleNamespace(min_score=0.5)
    planner = Wishes(SimpleNamespace(selection=selection), PlanConfig(at_least=(1,)))
    candidates = SimpleNamespace(score=jnp.ones(1), valid=jnp.ones(1, bool), thumb=jnp.ones((1, 1)))
    candidates._replace = lambda **new: SimpleNamespace(**(vars(candidates) | new))
    assert planner.search(0, candidates, None, None, None, failures).cost[0] == 1.0


@pytest.mark.wrong_types
@pytest.mark.parametrize(("costs", "expected"), [((5, 3), 5), ((20, 3), 3), ((20, 30), 20)])
def test_contacts_that_ask_for_little_force_are_looked_for_first(costs, expected):
    """What is found among them, and among all."""

    class Costly(_Finds):
        def _search(self, library, candidates, light, far, around, q, key):
            cost = jnp.where(light, *jnp.array(costs, float))
            return _Found(cost[None], jnp.zeros(1, int))

    planner = Costly(
        SimpleNamespace(selection=SimpleNamespace(min_score=0.5)),
        replace(PlanConfig(), heavier=1.25, lesser_cost=15.0),
    )
    candidates = SimpleNamespace(score=jnp.array([0.9]), valid=jnp.ones(1, bool))
    candidates._replace = lambda **new: SimpleNamespace(**(vars(candidates) | new))
    assert planner.search(0, candidates, None, None, None).cost[0] == expected
