"""What a browser is given of a model's geoms, beside MuJoCo's own masses and places."""

import mujoco
import numpy as np
import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.sim.scene import build_scene
from mjx_grasp.viz.links import geom_mesh, links

SOLIDS = """<mujoco><asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .2 0 0 0 .3"/></asset>
<worldbody><body pos="1 0 0"><freejoint/>
<geom density="1" {}  pos=".1 .2 .3" quat=".5 .5 .1 -.7" rgba="1 .5 0 1"/>
</body></worldbody></mujoco>"""
KINDS = (
    'type="sphere" size=".1"',
    'type="box" size=".1 .2 .3"',
    'type="capsule" size=".1 .2"',
    'type="cylinder" size=".1 .2"',
    'type="ellipsoid" size=".1 .2 .3"',
    'type="mesh" mesh="m"',
)


@pytest.mark.parametrize("kind", KINDS)
def test_volume_centre_and_moments_are_those_of_the_geom(kind):
    model = mujoco.MjModel.from_xml_string(SOLIDS.format(kind))
    mesh = geom_mesh(model, 0)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(model.body_mass[1], rel=0.03)
    np.testing.assert_allclose(mesh.center_mass, model.body_ipos[1], atol=1e-6)
    moments = np.linalg.eigvalsh(mesh.moment_inertia)
    np.testing.assert_allclose(np.sort(moments), np.sort(model.body_inertia[1]), rtol=0.06)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[1])
    turned = R.reshape(3, 3) @ np.diag(model.body_inertia[1]) @ R.reshape(3, 3).T
    np.testing.assert_allclose(mesh.moment_inertia, turned, atol=0.06 * moments.max())


def test_what_has_no_end_is_refused_by_name():
    text = '<mujoco><worldbody><geom name="ground" type="plane" size="1 1 1"/></worldbody></mujoco>'
    with pytest.raises(InputError, match=r"geom ground.*PLANE"):
        geom_mesh(mujoco.MjModel.from_xml_string(text), 0)


def test_a_body_is_one_link_per_colour_and_what_is_not_seen_is_none(robot, handmade_objects):
    model = build_scene(handmade_objects, robot).model
    tip = model.geom("thumb_tip")
    (link,) = links(model, [int(tip.bodyid[0])])
    assert tuple(link.colour) == tuple(np.round(255 * tip.rgba[:3]).astype(int))
    base = model.body(robot.hand.palm_body).id
    assert len(links(model, [base])) == len(
        {tuple(model.geom_rgba[g]) for g in np.flatnonzero(model.geom_bodyid == base)}
    )
    model.geom_group[tip.id] = 3
    assert links(model, [int(tip.bodyid[0])]) == []
