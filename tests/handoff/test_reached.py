"""Reached handoffs, made with few worlds: what the file says is where the arm came to."""

import dataclasses
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.geometry import so3
from mjx_grasp.handoff.config import HandoffConfig, PostureConfig, SamplingConfig
from mjx_grasp.handoff.dataset import load_handoffs
from mjx_grasp.handoff.reached import ReachedGenerator, _Task, reach_settings
from mjx_grasp.handoff.report import OUTCOMES, TIPS
from mjx_grasp.handoff.sampling import rotation_matrix, sample_object_poses
from mjx_grasp.objects.model import load_object
from mjx_grasp.pipeline.known import known_object
from mjx_grasp.reaching.presets import GATES
from mjx_grasp.reaching.state import ReachOutcome
from mjx_grasp.reaching.still import Placed, StillObject, plans_still, reach_still
from mjx_grasp.robot.mjcf import joint_columns
from mjx_grasp.sim.collision import REASONS, CollisionChecker
from mjx_grasp.sim.scene import SceneConfig, build_scene
from mjx_grasp.tasks.starts import build_starts

WANTED, WORLDS = 6, 4


def settings(folder, must_hold=0.8, **changes):
    return HandoffConfig(
        out=folder / "set.npz",
        kind="reached",
        per_object=WANTED,
        max_rounds=4,
        sampling=SamplingConfig(poses_per_round=WORLDS),
        posture=PostureConfig(library=4000, must_hold=must_hold),
        **changes,
    )


@pytest.fixture(scope="module")
def brick():
    return load_object("foam_brick")


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return settings(tmp_path_factory.mktemp("reached"))


@pytest.fixture(scope="module")
def generator(config, robot):
    return ReachedGenerator(robot, config)


def test_a_preset_that_does_not_plan_is_refused(config, robot):
    with pytest.raises(InputError, match="a preset without plans"):
        ReachedGenerator(robot, config, replace(reach_settings(config), plan=None))


@pytest.fixture(scope="module")
def generated(generator, brick):
    return generator.generate(brick)


@pytest.mark.long
def test_the_state_kept_is_the_state_reached(generated, brick, robot):
    """Tip errors again from the joints alone, by native MuJoCo, and nothing penetrates."""
    handoffs, report = generated
    assert len(handoffs) == report.kept == WANTED and handoffs.kind == "reached"
    scene = build_scene([brick], robot)
    data, at = mujoco.MjData(scene.model), scene.addresses
    distance, share = np.array([0.025, 0.040, 0.040])[:, None], np.array([0.5, 0.25, 0.25])
    table = scene.model.geom("table").id
    for k in range(len(handoffs)):
        data.qpos[at.robot_qpos] = handoffs.q[k]
        data.qpos[at.object_qpos[:3]] = handoffs.object_pos[k]
        data.qpos[at.object_qpos[3:]] = handoffs.object_quat[k]
        mujoco.mj_forward(scene.model, data)
        goal = handoffs.target_pos[k] + distance * handoffs.target_normal[k]
        tips = [data.site(finger.tip_site).xpos for finger in robot.hand.fingers]
        off = np.array(tips) - goal
        assert np.allclose(np.linalg.norm(off, axis=1), handoffs.residual[k], atol=1e-5)
        assert np.linalg.norm(share @ off) == pytest.approx(handoffs.midpoint[k], abs=1e-5)
        for pair in data.contact.geom[data.contact.dist < 0]:
            assert table in pair and set(pair) - {table} <= set(at.object_geoms)


@pytest.mark.long
def test_every_state_is_one_for_which_the_gate_opens(generated, config):
    handoffs, report = generated
    gate = reach_settings(config).reach.controller.gate
    assert gate == GATES["default"]
    worst = handoffs.residual.max(axis=1)
    arrived = (handoffs.midpoint < gate.midpoint) & (worst <= gate.tips)
    waited = np.array(report.reach_seconds[: len(handoffs)]) >= gate.late
    assert np.all(arrived | (waited & (worst <= gate.late_tips)))


@pytest.mark.long
def test_idle_fingers_stay_where_a_training_fixes_them(generated, brick, robot):
    handoffs, _ = generated
    used = joint_columns(robot.without_idle_fingers())
    assert np.all(np.delete(handoffs.q, used, axis=1) == 0.0)
    assert np.ptp(handoffs.q[:, used], axis=0).min() > 0
    scene = build_scene([brick], robot, SceneConfig(fix_idle_fingers=True))
    assert len(build_starts(scene, handoffs, 5).qpos) == len(handoffs)


@pytest.mark.long
def test_targets_are_those_of_the_object_where_it_lies(generated, brick):
    handoffs, _ = generated
    assert handoffs.target_pos[:, :, 2].min() >= 0.015
    assert np.all((handoffs.score >= 0) & (handoffs.score <= 1))
    assert np.mean(handoffs.score >= 0.05) > 0.5, "lesser ones only where no other is in reach"
    for k in range(len(handoffs)):
        turn = rotation_matrix(handoffs.object_quat[k])
        thumb, first, second = (handoffs.target_pos[k] - handoffs.object_pos[k]) @ turn
        assert np.linalg.norm(brick.mesh.vertices - thumb, axis=1).min() < 1e-5
        assert np.linalg.norm(first - second) == pytest.approx(0.04, abs=1e-5)


@pytest.mark.long
def test_every_reach_is_accounted_for(generated):
    handoffs, report = generated
    assert report.sampled == report.poses == report.feasible + sum(report.rejected.values())
    assert set(report.rejected) <= set(OUTCOMES)
    row = json.loads(json.dumps(report.as_row()))
    assert (row["kind"], row["kept"]) == ("reached", WANTED)
    assert 0 < row["reach_seconds"]["50"] <= row["reach_seconds"]["95"] <= 10.0
    assert set(row["tip_error_mm"]) == {*TIPS, "tips"}
    mean = [1e3 * handoffs.residual[:, f].mean() for f in range(3)]
    assert [row["tip_error_mm"][tip]["mean"] for tip in TIPS[:3]] == pytest.approx(mean, abs=1e-3)
    assert row["tip_error_mm"]["tips"]["mean"] == pytest.approx(np.mean(mean), abs=2e-3)


@pytest.mark.long
def test_an_object_whose_contacts_score_little_has_states_as_it_has_whole_grasps(generator):
    handoffs, report = generator.generate(load_object("mini_soccer_ball"))
    assert report.eligible_candidates == 0 and len(handoffs) == report.kept == WANTED


@pytest.mark.long
def test_the_seed_decides_everything(generator, generated, brick):
    first, _ = generated
    again, _ = generator.generate(brick)
    for field in dataclasses.fields(first):
        assert np.array_equal(getattr(first, field.name), getattr(again, field.name))


@pytest.mark.long
def test_a_set_is_the_same_from_its_file(generated, tmp_path, robot):
    handoffs, _ = generated
    path = tmp_path / "set.npz"
    handoffs.save(path)
    found = load_handoffs(path, robot=robot)
    assert found.kind == "reached" and np.array_equal(found.midpoint, handoffs.midpoint)


def test_plans_know_what_the_object_weighs(generator, brick, monkeypatch):
    """As those of a whole grasp do."""

    class Known(Exception):
        pass

    def told(planner, library, what, *rest):
        raise Known(what.weight)

    monkeypatch.setattr("mjx_grasp.handoff.reached.plans_still", told)
    with pytest.raises(Known) as caught:
        generator.generate(brick)
    assert float(caught.value.args[0]) == pytest.approx(9.81 * brick.mass, rel=1e-5)


@pytest.fixture(scope="module")
def queue(generator, brick, robot):
    """More reaches than worlds: what they are of, where, and how they ended."""
    known = known_object(brick, robot)
    what = StillObject(known.shape, known.candidates)
    rng = np.random.default_rng(3)
    pos, quat = sample_object_poses(brick.resting, WORLDS + 2, SamplingConfig(), rng)
    pos, turns = np.float32(pos), np.float32([rotation_matrix(q) for q in quat])
    keys = jax.random.split(jax.random.key(1), len(pos))
    plans = plans_still(generator._planner, generator._library, what, pos, turns, keys, WORLDS)
    placed = Placed(jnp.asarray(pos), jnp.asarray(turns), plans)
    return what, placed, reach_still(generator._reacher, what, placed, WORLDS)


@pytest.mark.long
def test_reaches_to_contacts_that_cannot_hold_are_refused(generator, queue, brick, robot):
    """As if all three were on one side of the object."""
    what, placed, found = queue
    task = _Task(brick, what, CollisionChecker(build_scene([brick], robot)))
    q = np.zeros((len(found.q), len(robot.joints)), np.float32)
    q[:, generator._columns] = found.q
    at = np.asarray(placed.p_wo), np.asarray(so3.mat_to_quat(placed.R_wo))
    usual = list(generator._outcomes(task, placed, found, q, *at))
    beside = found._replace(normal=np.broadcast_to(np.float32([1, 0, 0]), found.normal.shape))
    refused = list(generator._outcomes(task, placed, beside, q, *at))
    assert usual.count(None) > 0 and "hold" not in usual
    for before, now in zip(usual, refused, strict=True):
        assert now == ("hold" if before is None or before in REASONS else before)


@pytest.mark.long
def test_what_comes_of_a_reach_does_not_depend_on_the_others(generator, queue):
    what, placed, together = queue
    for k in (0, len(placed.p_wo) - 1):
        one = jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], placed)
        alone = reach_still(generator._reacher, what, one, WORLDS)
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_allclose(a[0], b[k], atol=1e-4)


@pytest.mark.long
def test_a_batch_is_a_loop_over_its_reaches(generator, queue):
    what, placed, together = queue
    reacher = generator._reacher
    tick = jax.jit(reacher.tick)
    for k in (0, len(placed.p_wo) - 1):
        at = jax.tree.map(lambda leaf, k=k: jnp.asarray(leaf[k]), placed)
        q = jnp.asarray(reacher.body.home)
        state = reacher.start(q, what.candidates, at.p_wo, at.R_wo, at.plans)
        while True:
            state, done = tick(
                state, q, what.shape, what.candidates, at.p_wo, at.R_wo,
                jnp.zeros((0, 4)), at.plans,
            )  # fmt: skip
            if state.outcome != ReachOutcome.RUNNING:
                break
            q = q + reacher.config.controller.dt * done.velocity
        assert state.outcome == together.outcome[k]
        np.testing.assert_allclose(q, together.q[k], atol=2e-3)
        np.testing.assert_allclose(done.report.error, together.error[k], atol=1e-3)


def test_plans_keep_to_contacts_that_are_accepted_afterwards(tmp_path):
    for friction in (0.5, float("inf")):
        asked = settings(tmp_path, must_hold=friction)
        assert reach_settings(asked).plan.must_hold == friction


def test_gates_are_those_that_are_asked_for(tmp_path):
    for name, gate in GATES.items():
        asked = reach_settings(settings(tmp_path, gate=name)).reach.controller.gate
        assert asked == gate
    asked = reach_settings(settings(tmp_path, gate="paper", gate_midpoint=0.02))
    assert asked.reach.controller.gate == replace(GATES["paper"], midpoint=0.02)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"kind": "ik", "gate": "paper"}, "--gate"),
        ({"kind": "ik", "gate_midpoint": 0.02}, "--gate-midpoint"),
        ({"kind": "ik", "reached_share": 0.9}, "--reached-share"),
        ({"kind": "reached", "reached_share": 0.9}, "--reached-share"),
        ({"gate_midpoint": 0.0}, "--gate-midpoint"),
        ({"kind": "mixed", "reached_share": 1.5}, "--reached-share"),
        ({"kind": "mixed", "reached_share": 0.0}, "--reached-share"),
        ({"kind": "mixed", "reached_share": 1.0}, "--reached-share"),
        ({"kind": "mixed", "per_object": 1}, "--reached-share"),
    ],
)
def test_bad_settings_are_refused_by_name(config, change, field):
    with pytest.raises(InputError, match=f"{field}: "):
        replace(config, **change)


@pytest.mark.wrong_types
def test_a_kind_or_gate_that_nobody_knows_is_refused(config):
    for change in ({"kind": "guessed"}, {"gate": "wide"}):
        with pytest.raises(InputError, match=f"--{next(iter(change))}: "):
            replace(config, **change)
