"""Laws of the controller of whole grasps: its phases, their transitions, its batches."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted import ScriptedPhysics, draw_of, still

from mjx_grasp.closing.closer import Closer
from mjx_grasp.closing.config import REACTING, ActionConfig, CloserConfig, LiftConfig, StageConfig
from mjx_grasp.closing.learned import KEEPING, LearnedPolicy, ObservationConfig
from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.geometry.signed_distance import Cylinder
from mjx_grasp.grasp.candidates import cylinder_candidates
from mjx_grasp.pipeline.assemble import grasper_of
from mjx_grasp.pipeline.config import GrasperConfig
from mjx_grasp.pipeline.flat import FlatTick
from mjx_grasp.pipeline.grasper import Grasper
from mjx_grasp.pipeline.phases import Failure, Phase
from mjx_grasp.pipeline.pressing import preloaded
from mjx_grasp.pipeline.state import Known, Seen, Tried, Ways
from mjx_grasp.reaching import admm
from mjx_grasp.reaching.config import HandoffGate
from mjx_grasp.reaching.controller import Reacher
from mjx_grasp.reaching.fields import midpoint
from mjx_grasp.reaching.guide import no_guide
from mjx_grasp.reaching.presets import reach_preset
from mjx_grasp.reaching.state import Plans
from mjx_grasp.robot.interface import measured_from_joints, measuring_kinematics
from mjx_grasp.tasks.closing import ClosingTask
from mjx_grasp.tasks.config import ClosingTaskConfig, StartNoise

HERE = jnp.array([0.5, -0.1, 0.06])
NEVER, ALWAYS = HandoffGate(midpoint=0.0, late=float("inf")), HandoffGate(midpoint=10.0)
QUICK = CloserConfig(
    grip=REACTING,
    stages=StageConfig(acquisition_s=0.1),
    lift=LiftConfig(delay_s=0.02, ramp_s=0.01, height=0.01),
)
"""All of closing within a few ticks."""


@pytest.fixture(scope="module")
def known(robot):
    shape = Cylinder(jnp.float32(0.03), jnp.float32(0.06))
    candidates = cylinder_candidates(*shape, robot.hand.span, around=8, along=3)
    return Known(shape, candidates, jnp.float32(2.0), jnp.zeros(3))


@pytest.fixture(scope="module")
def make(body, robot):
    """A grasper whose reaching hands off by a gate; the published controller, few via-points."""
    once = GrasperConfig(retries=0)

    def made(gate=ALWAYS, closing=QUICK, config=once, policy=None, **controller):
        settings = reach_preset("paper")
        fields = replace(settings.reach.fields, via_points=4)
        control = replace(settings.reach.controller, gate=gate, **controller)
        reach = replace(settings.reach, fields=fields, controller=control)
        reacher = Reacher(body, reach, settings.selection)
        return Grasper.of(reacher, Closer.of(robot, closing), config, policy=policy)

    return made


@pytest.fixture(scope="module")
def feel(robot):
    """What a robot that stands still measures."""
    kinematics = measuring_kinematics(robot)

    @jax.jit
    def measured(q):
        return measured_from_joints(kinematics, q, jnp.zeros_like(q), jnp.zeros((5, 12)))

    return measured


@pytest.fixture(scope="module")
def home(body, feel):
    return feel(jnp.asarray(body.home, jnp.float32))


def seen(touching=(False, False, False), p=HERE, R=None):
    R = jnp.eye(3) if R is None else R
    return Seen(jnp.asarray(p), R, jnp.asarray(touching), jnp.zeros((0, 4)))


def ticks(grasper, state, measured, known, what, count):
    """The state after some ticks of a robot that does not move, and the last tick."""

    @jax.jit
    def run(state, what):
        def tick(state, _):
            return grasper.tick(state, measured, known, what)

        return jax.lax.scan(tick, state, length=count)

    state, done = run(state, what)
    return state, jax.tree.map(lambda leaf: leaf[-1], done)


@pytest.fixture(scope="module")
def grasper(make):
    return make()


@pytest.fixture(scope="module")
def tick(grasper, known):
    return jax.jit(lambda state, measured, what: grasper.tick(state, measured, known, what))


@pytest.fixture(scope="module")
def begun(grasper, tick, home, known):
    """The state at the handoff, which the gate gives at the first tick."""
    state, _ = tick(grasper.start(home, known, seen()), home, seen())
    assert state.phase == Phase.CLOSING and np.isfinite(state.handoff.error).all()
    return state


@pytest.fixture(scope="module")
def there(begun, home):
    """Where the object has to be for the pads to be about its contacts."""
    return midpoint(home.pad_pos) - midpoint(begun.closing.contacts.position)


@pytest.fixture(scope="module")
def closing(begun, tick, home, there):
    """The state after the first tick of closing, with the object brought to the hand."""
    state, _ = tick(begun, home, seen(p=there))
    assert state.phase == Phase.CLOSING and not state.closing.fresh
    return state


def ways_for(home, p=HERE, failures=0, force=2.0):
    """One plan, whose configurations are those at home; from the pose and the tries it is for."""
    first, along = jnp.zeros(1, jnp.int32), jnp.array([[0.0, 0.0, 1.0]])
    guide = jax.tree.map(lambda leaf: leaf[None], no_guide(len(home.q)))
    plans = Plans(first, along, along, guide)
    return Ways(plans, jnp.array([force]), jnp.asarray(p), jnp.eye(3), jnp.int32(failures))


@pytest.fixture(scope="module")
def planned(make, home, known):
    """What adopts plans and ticks, of a grasper that reaches for long and plans anew by 20 mm."""
    grasper = make(gate=NEVER, replan_moved=0.02)
    ways = ways_for(home)
    tick = jax.jit(lambda state, p: grasper.tick(state, home, known, seen(p=p)))
    return SimpleNamespace(
        start=grasper.start(home, known, seen(), ways),
        tick=lambda state, p=HERE: tick(state, jnp.asarray(p)),
        adopt=jax.jit(grasper.adopt),
    )


def test_new_plans_stay_due_until_they_are_there(planned, home):
    away = HERE + jnp.array([0.05, 0.0, 0.0])
    state, done = planned.tick(planned.start)
    assert not done.plans_due
    due = []
    for p in (away, away, HERE, HERE):  # it is moved, and comes back
        state, done = planned.tick(state, p)
        due.append(bool(done.plans_due))
    assert all(due[1:])
    state = planned.adopt(state, ways_for(home))
    assert not planned.tick(state)[1].plans_due


def test_plans_for_where_the_object_was_are_followed_until_newer_ones_are_there(planned, home):
    away = HERE + jnp.array([0.05, 0.0, 0.0])
    state = planned.start
    for _ in range(2):
        state, _ = planned.tick(state, away)
    old = planned.adopt(state, ways_for(home, HERE, force=3.0))
    assert old.ways.force == 3.0
    assert planned.tick(old, away)[1].plans_due
    new = planned.adopt(old, ways_for(home, away))
    assert not planned.tick(new, away)[1].plans_due


def test_plans_that_do_not_know_of_the_last_failure_are_followed_until_newer_ones(planned, home):
    state = planned.start._replace(retries=jnp.int32(1))
    before = planned.adopt(state, ways_for(home, failures=0))
    assert planned.tick(before)[1].plans_due
    after = planned.adopt(before, ways_for(home, failures=1))
    assert not planned.tick(after)[1].plans_due


def test_plans_that_come_after_the_handoff_change_nothing(planned, home):
    state = planned.start._replace(phase=jnp.int32(Phase.CLOSING))
    late = planned.adopt(state, ways_for(home, force=14.0))
    jax.tree.map(np.testing.assert_array_equal, late, state)


@pytest.mark.long
def test_time_out_selects_another_candidate_and_then_fails(make, home, known):
    """The published rules: one re-selection without the first candidate."""
    grasper = make(gate=NEVER, fine_distance=100.0, fine_timeout=0.05)
    state = grasper.start(home, known, seen())
    state, _ = ticks(grasper, state, home, known, seen(), 4)
    first = int(state.reach.selection.candidate)
    state, _ = ticks(grasper, state, home, known, seen(), 4)
    assert state.phase == Phase.REACHING and state.reach.tries == 1
    assert int(state.reach.selection.candidate) != first
    assert np.isinf(state.reach.selection.bias[first])
    state, done = ticks(grasper, state, home, known, seen(), 5)
    assert (state.phase, state.failure) == (Phase.FAILED, Failure.NOT_REACHED)
    _, later = ticks(grasper, state, home, known, seen(), 3)
    np.testing.assert_array_equal(later.target, done.target)


@pytest.mark.long
def test_without_a_candidate_it_says_so(make, home, known):
    grasper = make(timeout=0.05)
    none = known._replace(
        candidates=known.candidates._replace(valid=jnp.zeros_like(known.candidates.valid))
    )
    state, _ = ticks(grasper, grasper.start(home, none, seen()), home, none, seen(), 8)
    assert (state.phase, state.failure) == (Phase.FAILED, Failure.NO_CANDIDATE)


def test_all_fingers_touching_begin_the_lift(tick, closing, home, there):
    state, _ = tick(closing, home, seen((True, True, True), there))
    assert state.phase == Phase.LIFTING
    assert tick(closing, home, seen((True, True, False), there))[0].phase == Phase.CLOSING
    np.testing.assert_allclose(state.entered[Phase.LIFTING], state.clock, atol=1e-6)


def test_two_fingers_do_later_and_the_lift_ends_at_the_top(grasper, closing, home, known, there):
    two = seen((True, False, True), there)
    state, _ = ticks(grasper, closing, home, known, two, 12)
    assert state.phase == Phase.LIFTING
    state, _ = ticks(grasper, state, home, known, two, 12)
    assert state.phase == Phase.HOLDING and state.failure == Failure.NONE


@pytest.mark.long
def test_without_contact_it_gives_up(make, home, known):
    grasper = make(config=GrasperConfig(contact_s=0.1, lost=float("inf"), retries=0))
    state, _ = ticks(grasper, grasper.start(home, known, seen()), home, known, seen(), 14)
    assert (state.phase, state.failure) == (Phase.FAILED, Failure.NO_CONTACT)


@pytest.mark.long
def test_everything_has_an_end(make, home, known):
    grasper = make(gate=NEVER, config=GrasperConfig(timeout_s=0.1))
    state, _ = ticks(grasper, grasper.start(home, known, seen()), home, known, seen(), 14)
    assert (state.phase, state.failure) == (Phase.FAILED, Failure.TIME_OUT)


def test_an_object_that_moves_away_is_reached_for_again(grasper, tick, closing, home, there):
    near, done = tick(closing, home, seen(p=there))
    assert near.phase == Phase.CLOSING
    moved, after = tick(near, home, seen(p=there + jnp.array([0.045, 0.0, 0.0])))
    assert moved.phase == Phase.CLOSING
    shift = after.contacts.position - done.contacts.position
    np.testing.assert_allclose(shift, np.broadcast_to([0.045, 0, 0], (3, 3)), atol=1e-6)
    away, _ = tick(moved, home, seen(p=there + jnp.array([0.055, 0.0, 0.0])))
    assert away.phase == Phase.REACHING and away.returns == 1
    np.testing.assert_array_equal(away.reference, home.q)
    again, _ = tick(away, home, seen(p=there))
    assert again.phase == Phase.CLOSING and again.closing.fresh
    np.testing.assert_allclose(again.reach.clock, grasper.dt, atol=1e-6)


def test_an_object_that_is_pushed_away_again_and_again_is_grasped_elsewhere(
    make, closing, home, known, there
):
    """As far as tries are left; without any it is followed for as long as there is time."""
    grasper = make(config=GrasperConfig(retries=3, follows=2))
    tick = jax.jit(lambda state, what: grasper.tick(state, home, known, what)[0])
    away, here = seen(p=there + jnp.array([0.055, 0.0, 0.0])), seen(p=there)
    state, found = closing._replace(retries=jnp.int32(1), vain=jnp.int32(1)), []
    for _ in range(5):
        state = tick(state, away)
        assert (state.phase, state.failure) == (Phase.REACHING, Failure.NONE)
        tried = np.isfinite(state.avoid).all()
        found.append((int(state.returns), int(state.retries), bool(tried)))
        contacts = state.closing.contacts.position
        assert not tried or (state.avoid == contacts[0]).all() or state.retries == 3
        state = tick(state, here)
        assert state.phase == Phase.CLOSING
        state = tick(state, here)
    assert found == [(1, 1, False), (2, 1, False), (3, 2, True), (4, 3, True), (5, 3, True)]


@pytest.mark.long
def test_an_object_at_rest_whose_pose_is_noisy_rests(make, home, known):
    grasper, draw = make(gate=NEVER), np.random.default_rng(0)
    noise = 0.005 * draw.normal(size=(120, 3))
    places = jnp.asarray(np.asarray(HERE) + noise, jnp.float32)

    @jax.jit
    def run(state):
        def tick(state, p):
            state, done = grasper.tick(state, home, known, seen(p=p))
            moves = jnp.any(state.pose.twist != 0.0)
            since = state.reach.since
            return state, (state.pose.p_wo, state.reach.p_wo, moves, since, done.plans_due)

        return jax.lax.scan(tick, state, places)

    _, (filtered, used, moves, since, due) = run(grasper.start(home, known, seen()))
    np.testing.assert_array_equal(used, filtered)
    assert np.asarray(filtered)[60:].std(axis=0).max() < 0.6 * 0.005
    assert np.mean(moves[60:]) < 0.05 and not np.any(due)
    assert np.max(since) > 0.3, "what moves is waited for"


@pytest.mark.long
def test_a_state_as_a_vector_goes_the_same_way(grasper, tick, begun, home, known, there):
    """Through every kind of number in it: flags, counts, what is infinite or not there yet."""
    flat, state = FlatTick(grasper, begun), begun
    vector = flat.flat(state)
    whats = [seen(p=there)] * 3 + [seen((True, True, True), there)] * 3 + [seen(p=there + 0.05)]
    phases = set()
    for what in whats:
        state, done = tick(state, home, what)
        vector, did = flat(vector, home, known, what)

        # Compiled apart, each rounds in its own way.
        def same(a, b):
            tolerance = 1e-6 if np.issubdtype(np.asarray(a).dtype, np.floating) else 0.0
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)

        jax.tree.map(same, did, done)
        found = flat.state(vector)
        jax.tree.map(same, found, state)
        assert all(
            a.dtype == b.dtype
            for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(state), strict=True)
        )
        phases.add(int(state.phase))
    assert phases == {Phase.CLOSING, Phase.LIFTING, Phase.FAILED}
    np.testing.assert_array_equal(flat.flat(found), vector)
    with pytest.raises(ValueError, match="numbers, expected"):
        flat.flat(state._replace(reference=state.reference[1:]))


def test_after_lift_onset_it_is_lost(tick, closing, home, there):
    state, _ = tick(closing, home, seen((True, True, True), there))
    assert state.phase == Phase.LIFTING
    assert tick(state, home, seen(p=there + 0.03))[0].phase == Phase.LIFTING
    state, _ = tick(state, home, seen(p=there + 0.05))
    assert (state.phase, state.failure) == (Phase.FAILED, Failure.DROPPED)


@pytest.mark.long
def test_a_lost_object_is_tried_again_once_and_elsewhere(make, closing, home, known, there):
    grasper = make(config=GrasperConfig(retries=1))
    tick = jax.jit(lambda state, what: grasper.tick(state, home, known, what))
    gone = seen(p=there + 0.05)
    state, _ = tick(closing, seen((True, True, True), there))
    state, _ = tick(state, gone)
    assert (state.phase, state.failure, state.retries) == (Phase.REACHING, Failure.NONE, 1)
    np.testing.assert_array_equal(state.avoid, closing.closing.contacts.position[0])
    assert state.vain == 0
    state, _ = tick(state, seen(p=there))
    assert state.phase == Phase.CLOSING
    state, _ = tick(state, seen(p=there))
    state, _ = tick(state, seen((True, True, True), there))
    state, _ = tick(state, gone)
    assert (state.phase, state.failure) == (Phase.FAILED, Failure.DROPPED)


@pytest.fixture(scope="module")
def everywhere(grasper, tick, home, known, closing, there):
    """States of every phase, each with what is measured and seen."""
    near = seen(p=there)
    lifting, _ = tick(closing, home, seen((True, True, True), there))
    holding, _ = ticks(grasper, lifting, home, known, near, 12)
    failed, _ = tick(lifting, home, seen(p=there + 0.05))
    rows = [
        (grasper.start(home, known, seen()), home, seen()),
        (closing, home, seen((True, False, False), there)),
        *((state, home, near) for state in (lifting, holding, failed)),
    ]
    assert [int(state.phase) for state, *_ in rows] == list(Phase)
    return rows


@pytest.fixture(scope="module")
def alone(tick, everywhere):
    """What one tick makes of each."""
    return [tick(*row) for row in everywhere]


def close(a, b, atol=2e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol, rtol=1e-4), a, b)


@pytest.mark.long
def test_a_batch_is_the_map_over_its_robots(grasper, tick, known, everywhere):
    """In all phases at once, of which each row has its own."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *everywhere)
    mapped = jax.jit(jax.vmap(lambda s, m, w: grasper.tick(s, m, known, w)))(*stacked)
    for k, row in enumerate(everywhere):
        alone = tick(*row)
        # The solver of reaching is an iteration that ends early.
        atol = 2e-3 if k == Phase.REACHING else 2e-5
        close(jax.tree.map(lambda leaf, k=k: leaf[k], mapped), alone, atol)


@pytest.fixture(params=["cpu", pytest.param("gpu", marks=pytest.mark.long)])
def backend(request, monkeypatch):
    """As it is computed on either; what is a kernel of a GPU is interpreted."""
    if request.param == "gpu":
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        kernel = partial(admm.in_one_kernel, interpret=True)
        monkeypatch.setattr(admm, "in_one_kernel", kernel)


@pytest.mark.long
def test_many_worlds_are_the_map_over_them(backend, grasper, known, everywhere, alone):
    """However many of sixteen reach: none, those of a part or more, or nearly all."""
    together = jax.jit(grasper.ticks)
    objects = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[known] * 16)
    for reaching in (0, 1, 4, 8):
        phases = np.resize([1, 2, 3, 4], 16)
        phases[::-1][: 2 * reaching : 2] = Phase.REACHING
        assert np.sum(phases == Phase.REACHING) == reaching
        rows = [everywhere[phase] for phase in phases]
        state, measured, what = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
        found = together(state, measured, objects, what)
        for k, phase in enumerate(phases):
            atol = 2e-3 if phase == Phase.REACHING else 2e-5
            close(jax.tree.map(lambda leaf, k=k: leaf[k], found), alone[phase], atol)


@pytest.mark.long
def test_many_worlds_begin_to_reach_again_as_one_does(grasper, tick, home, known, closing, there):
    """Where the object leaves before the lift, beside others that go on."""
    rows = [
        (closing, home, seen(p=there + jnp.array([0.2, 0.0, 0.0]))),
        (closing, home, seen((True, False, False), there)),
        (grasper.start(home, known, seen()), home, seen()),
    ]
    state, measured, what = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
    objects = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[known] * len(rows))
    found = jax.jit(grasper.ticks)(state, measured, objects, what)
    assert found[0].phase.tolist() == [Phase.REACHING, Phase.CLOSING, Phase.CLOSING]
    assert found[0].returns.tolist() == [1, 0, 0]
    for k, row in enumerate(rows):
        close(jax.tree.map(lambda leaf, k=k: leaf[k], found), tick(*row), atol=2e-3)


@pytest.mark.parametrize("phase", list(Phase)[1:], ids=lambda phase: phase.name.lower())
@pytest.mark.long
def test_compiled_is_as_written(grasper, tick, known, everywhere, phase):
    state, measured, what = everywhere[phase]
    with jax.disable_jit():
        written = grasper.tick(state, measured, known, what)
    close(written, tick(state, measured, what), atol=1e-4)


def test_turning_the_world_about_the_first_joint_changes_nothing(grasper, tick, feel, home, known):
    """Of what follows a handoff; reaching also knows that joint's limits and the table's place."""
    angle = 0.3
    R = so3.exp(jnp.array([0.0, 0.0, angle]))
    commands = []
    for q, what in ((home.q, seen()), (home.q.at[0].add(angle), seen(p=R @ HERE, R=R))):
        measured = feel(q)
        state, _ = tick(grasper.start(measured, known, what), measured, what)
        moved = midpoint(measured.pad_pos) - what.R_wo @ midpoint(state.closing.contacts.position)
        what = what._replace(p_wo=moved)
        for _ in range(3):
            state, done = tick(state, measured, what)
        commands.append((done.target - q, done.tip_error))
    close(*commands, atol=1e-4)


@pytest.mark.long
def test_closing_is_that_of_the_task_in_which_policies_are_trained(
    make, known, starts, scene, robot
):
    """The same observations, so the same actions and commands, tick by tick."""
    seen_of_it = ObservationConfig(forces=True, budget=True, keeping=KEEPING)
    config = ClosingTaskConfig(grip=REACTING, observation=seen_of_it)
    rows, length = jnp.array([0, 4, 8]), 12
    script = still(starts, rows, length)
    rng = np.random.default_rng(0)
    script.measured.q[:] += rng.normal(size=script.measured.q.shape) * 0.003
    script.measured.external_torque[:] += (
        rng.normal(size=script.measured.external_torque.shape) * 0.05
    )
    script.truth.tip_found[4:, :, 0] = script.truth.tip_found[7:] = True
    task = ClosingTask(ScriptedPhysics(scene, script), starts, config, StartNoise(offset_m=0.0))
    state, obs = task.start(draw_of(rows))
    size = obs["state"].shape[-1]
    weights = jnp.asarray(rng.normal(size=(size, task.action_size)) * 0.1, jnp.float32)

    def answer(obs):
        return jnp.tanh(obs @ weights)

    grasper = make(closing=config, policy=LearnedPolicy(answer, config.observation, budget=3.0))

    @jax.jit
    @jax.vmap
    def begun(measured, targets):
        state = grasper.start(measured, known, seen(p=jnp.zeros(3)))
        closing = state.closing._replace(contacts=targets)
        return state._replace(phase=jnp.int32(Phase.CLOSING), closing=closing)

    @jax.jit
    @jax.vmap
    def tick(state, measured, touching):
        return grasper.tick(state, measured, known, seen(touching, p=jnp.zeros(3)))

    of = jax.tree.map(lambda leaf: leaf[rows], (starts.measured, starts.targets, starts.truth))
    mine, advance = begun(*of[:2]), jax.jit(task.tick)
    measured, touching = of[0], of[2].tip_found
    order = np.argsort(scene.addresses.robot_ctrl)
    for _ in range(length):
        state, out = advance(state, answer(obs["state"]))
        obs = out.obs
        mine, done = tick(mine, measured, touching)
        np.testing.assert_allclose(done.target[:, order], state.physics.ctrl, atol=1e-5)
        measured, touching = state.measured, state.truth.tip_found
    assert state.closer.lifting.all() and mine.closing.closer.lifting.all()


def test_periods_have_to_be_the_same(make):
    with pytest.raises(InputError, match="control_dt"):
        make(closing=replace(QUICK, control_dt=0.02))


@pytest.mark.long
def test_what_is_not_reached_is_planned_anew_once(make, home, known):
    config = GrasperConfig(retries=1)
    grasper = make(gate=NEVER, fine_distance=100.0, fine_timeout=0.05, config=config)
    state = grasper.start(home, known, seen())
    state, _ = ticks(grasper, state, home, known, seen(), 14)
    assert (state.phase, state.failure, state.retries) == (Phase.REACHING, Failure.NONE, 1)
    assert state.vain == 1
    assert state.reach.clock < 0.1 and state.reach.tries == 0
    state, _ = ticks(grasper, state, home, known, seen(), 14)
    assert (state.phase, state.failure, state.retries) == (Phase.FAILED, Failure.NOT_REACHED, 1)


class _Chooses:
    """Always the first candidate, with its wraps one above the other."""

    def search(self, library, candidates, around, q, key, failures=0):
        along, first = jnp.array([[0.0, 0.0, 1.0]]), jnp.zeros(1, jnp.int32)
        return SimpleNamespace(plans=Plans(first, along, along, None))


@pytest.mark.wrong_types
def test_new_plans_know_how_many_tries_have_failed_and_keep_away_from_the_last(make, known):
    """A reach in vain leaves no contact to keep away from."""
    heard = []

    class Hears(_Chooses):
        def search(self, library, candidates, around, q, key, failures=0):
            heard.append((np.asarray(candidates.valid), int(failures)))
            return super().search(library, candidates, around, q, key, failures)

    grasper = replace(make(), planner=Hears())
    thumb = known.candidates.thumb[0]
    for tried, away, failures in (
        (None, False, 0),
        (Tried.nothing(), False, 0),
        (Tried.nothing()._replace(failures=jnp.int32(2)), False, 2),
        (Tried(jnp.int32(1), thumb), True, 1),
    ):
        grasper.plan(None, known, seen(), None, None, tried)
        valid, said = heard.pop()
        assert said == failures and valid[0] == (known.candidates.valid[0] & (not away))
        far = np.linalg.norm(known.candidates.thumb - thumb, axis=1) > 0.021
        assert np.array_equal(valid[far], known.candidates.valid[far])


def test_what_plans_are_told_of_the_tries_before_is_in_the_state(begun):
    """A reach in vain counts twice: near an anchor there is no way."""
    assert begun.tried.failures == 0 and np.all(np.isinf(begun.tried.avoid))
    later = begun._replace(retries=jnp.int32(2), vain=jnp.int32(1), avoid=jnp.ones(3))
    assert later.tried.failures == 3 and np.array_equal(later.tried.avoid, np.ones(3))


@pytest.mark.wrong_types
def test_a_grip_begins_in_proportion_to_the_weight_and_not_harder_where_no_force_holds(make, known):
    def force(weight, com=(0.0, 0.0, 0.0), most=20.0, **config):
        closing = replace(QUICK, grip=replace(REACTING, most=most))
        grasper = make(closing=closing, config=GrasperConfig(**config))
        what = known._replace(weight=jnp.float32(weight), com=jnp.array(com))
        return float(
            replace(grasper, planner=_Chooses()).plan(None, what, seen(), None, None).force[0]
        )

    per_newton = force(10.0) / 10.0
    for weight in (5.0, 20.0):
        assert force(weight) == pytest.approx(per_newton * weight, rel=1e-4)
    assert force(0.1) == pytest.approx(REACTING.force)
    assert force(100.0) == pytest.approx(20.0) and force(100.0, most=9.0) == pytest.approx(9.0)
    beside, thumb = (0.5, 0.5, 0.0), 1.5  # no force holds there; the thumb bears 3/2 F
    assert force(1.0, beside, hardest=6.0) == pytest.approx(6.0 / thumb)
    assert force(1.0, beside, hardest=1.0) == pytest.approx(REACTING.force)
    assert force(100.0, beside) == pytest.approx(20.0)


def test_a_thin_wall_is_gripped_harder_once_the_lift_is_due_whatever_a_policy_says(robot, begun):
    grip, config = replace(REACTING, most=20.0), GrasperConfig(across_walls=1.5)
    closer = Closer.of(robot, replace(QUICK, grip=grip, action=ActionConfig(grip_range=3.0)))

    def commanded(width, lifting, force=4.0):
        contacts = jnp.array([[0.0, 0.0, 0.0], [width, 0.01, 0.0], [width, -0.01, 0.0]])
        eased = begun.closing.closer._replace(trim=jnp.float32(-1.0), lifting=jnp.asarray(lifting))
        return float(
            closer.grip_force(preloaded(eased, contacts, jnp.float32(force), grip, config))
        )

    assert commanded(0.010, True) == pytest.approx(1.5 * 4.0)
    assert commanded(0.010, False) == commanded(0.030, True) == pytest.approx(4.0 / 3.0)
    assert commanded(0.010, True, force=18.0) == pytest.approx(20.0), "no more than fingers can"


def test_weight_and_load_may_raise_the_grip_of_a_whole_grasp_as_far_as_fingers_can(robot):
    """Beyond the bound that a policy was trained with; all else of closing stays as it is."""
    trained = ClosingTaskConfig(grip=replace(REACTING, most=8.0))
    closer = grasper_of(robot, trained).closer
    grip = replace(trained.grip, most=GrasperConfig().most)
    assert grip.most > 8.0 and closer.config == replace(trained, grip=grip)
    for own, asked, expected in ((8.0, 11.0, 11.0), (20.0, 11.0, 20.0)):
        closing = replace(trained, grip=replace(REACTING, most=own))
        made = grasper_of(robot, closing, config=GrasperConfig(most=asked))
        assert made.closer.config.grip.most == expected


def test_a_start_is_of_the_type_of_what_follows_so_that_a_loop_compiles_once(make, known, home):
    grasper = make()
    state = grasper.start(home, known, seen())
    weak = [leaf.weak_type for leaf in jax.tree.leaves(state)]
    assert not any(weak)
    after, _ = jax.eval_shape(grasper.tick, state, home, known, seen())
    for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype) and not b.weak_type
