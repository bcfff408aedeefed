"""What the robot keeps clear of, by kind, against MuJoCo's distances."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.geometry.signed_distance import Sphere
from mjx_grasp.posture.clearances import proximities, row_count
from mjx_grasp.posture.config import ClearanceConfig, IkConfig, StartConfig
from mjx_grasp.posture.surroundings import Surroundings

CENTRE, RADIUS = (0.55, 0.05, 0.25), 0.04
BALLS = ((0.4, 0.3, 0.3, 0.05), (0.6, -0.3, 0.2, 0.02))
ASKED = ClearanceConfig(
    object=0.01, obstacles=0.02, hand_table=0.03, arm_table=0.04, fingers=0.05, arm=0.06
)


def around(balls=BALLS):
    still = Surroundings.still(Sphere(jnp.float32(RADIUS)), jnp.asarray(CENTRE), jnp.eye(3))
    rows = jnp.asarray(np.reshape(balls, (-1, 4)), jnp.float32)
    return still._replace(obstacles=rows, obstacle_velocity=jnp.zeros((len(balls), 3)))


@pytest.fixture(scope="module")
def exact(body):
    """Least distances by MuJoCo of the hand and the arm's outer links to the world."""
    spec = mujoco.MjSpec.from_file(str(body.robot.mjcf))
    for name, place in (("object", (*CENTRE, RADIUS)), *zip("ab", BALLS, strict=True)):
        size, pos = [place[3], 0, 0], place[:3]
        spec.worldbody.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=pos, size=size)
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], contype=1
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    frames = body.kinematics.frames

    def shapes(solids, members=None):
        chosen = solids.frame if members is None else solids.frame[members]
        bodies = {model.body(frames[f]).id for f in chosen}
        return [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies]

    outer = body.arm_capsules.groups.ravel()
    hand = shapes(body.hand_capsules) + shapes(body.palm_points)
    arm = shapes(body.arm_capsules, outer)

    def distance(first, second):
        return min(
            mujoco.mj_geomDistance(model, data, a, b, 2.0, None) for a in first for b in second
        )

    def at(q):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        ids = {name: [model.geom(name).id] for name in ("object", "a", "b", "table")}
        return {
            "object": distance(hand + arm, ids["object"]),
            "obstacles": distance(hand + arm, ids["a"] + ids["b"]),
            "hand_table": distance(hand, ids["table"]),
            "arm_table": distance(arm, ids["table"]),
        }

    return at


def test_distances_by_kind_are_those_of_mujoco(body, exact):
    hand_rows = len(body.fingers) + 1

    @jax.jit
    def ours(q):
        near, _ = proximities(body, body.kinematics.motion(q), around(), ASKED)
        least = {kind: jnp.min(near[kind].distance) for kind in ("object", "obstacles")}
        table = near["table"].distance
        return least | {
            "hand_table": jnp.min(table[:hand_rows]),
            "arm_table": jnp.min(table[hand_rows:]),
        }

    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(8):
        q = np.float32(body.home + rng.uniform(-0.3, 0.3, len(body.home)))
        found = ours(q)
        for kind, expected in exact(q).items():
            if expected > 1e-3:  # MuJoCo's depth of penetration is another notion
                # Spheres cut the palm's corners; a cylinder is enclosed by its capsule.
                assert float(found[kind]) == pytest.approx(expected, abs=7e-3)
                seen += 1
    assert seen > 20


def test_every_row_asks_for_its_own_kind(body):
    for balls in ((), BALLS):
        names = []

        def asked_at(q, balls=balls, names=names):
            near, safe = proximities(body, body.kinematics.motion(q), around(balls), ASKED)
            names[:] = near  # in their order, which compiled dictionaries lose
            return [rows.distance for rows in near.values()], safe

        distances, safe = jax.jit(asked_at)(jnp.asarray(body.home))
        assert len(safe) == row_count(body, len(balls))
        assert names == [
            "object",
            *(["obstacles"] if balls else []),
            "table",
            "fingers",
            "arm",
        ]
        ends = np.cumsum([len(distance) for distance in distances])
        asked = dict(zip(names, np.split(np.asarray(safe), ends[:-1]), strict=True))
        wanted = {"object": {0.01}, "obstacles": {0.02}, "table": {0.03, 0.04}, "fingers": {0.05}}
        for kind, values in (wanted | {"arm": {0.06}}).items():
            if kind in asked:
                assert {round(float(a), 6) for a in asked[kind]} == values


def test_wider_clearances_leave_the_joint_limits(body):
    wider = ASKED.wider(0.01)
    assert wider.object == pytest.approx(0.02) and wider.arm == pytest.approx(0.07)
    assert wider.joint_limits == ASKED.joint_limits
    lower, upper = body.within(0.05)
    np.testing.assert_allclose(lower - body.lower, 0.05, atol=1e-6)
    # A margin is never more than a quarter of a joint's range.
    lower, upper = body.within(100.0)
    assert np.all(upper - lower > 0.49 * (body.upper - body.lower))


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (ClearanceConfig, "object", -0.01),
        (ClearanceConfig, "joint_limits", float("nan")),
        (IkConfig, "iterations", 0),
        (IkConfig, "idle_weight", -1.0),
        (StartConfig, "near", 0),
        (StartConfig, "overlap_weight", float("inf")),
    ],
)
def test_impossible_numbers_are_refused_by_name(kind, field, value):
    with pytest.raises(InputError) as error:
        kind(**{field: value})
    assert error.value.field == f"{kind.__name__}.{field}"
