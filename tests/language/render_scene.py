"""Renders an object on a table as a camera at about 1 m sees it: image, depth, and where all is.

Run as a script with MUJOCO_GL set, so that the tests' own process never starts OpenGL:
``python render_scene.py OBJECT OUT.npz``.
"""

import sys

import mujoco
import numpy as np

from mjx_grasp.language.camera import PinholeCamera
from mjx_grasp.objects.parametric import stand_in

WIDTH, HEIGHT = 640, 480

XML = """
<mujoco>
  <visual><global offwidth="640" offheight="480"/><map znear="0.05" zfar="20"/></visual>
  <statistic extent="1"/>
  <asset><mesh name="object" file="object.obj" inertia="shell"/></asset>
  <worldbody>
    <light pos="0.5 -0.5 1.5" dir="-0.3 0.3 -1"/>
    <geom name="table" type="box" size="0.4 0.4 0.01" pos="0 0 -0.2"/>
    <body name="object" pos="0.03 -0.02 0.05" quat="0.8 0.3 -0.2 0.48">
      <geom name="object" type="mesh" mesh="object" rgba="0.2 0.5 0.9 1"/>
    </body>
    <camera name="eye" pos="0.55 -0.65 0.52" fovy="42"
            xyaxes="0.763 0.646 0 -0.335 0.396 0.855"/>
  </worldbody>
</mujoco>
"""


def camera_of(model, data, name, width, height):
    """A camera of a model: MuJoCo's looks along its −z with y up, ours along z with y down.

    The depth that MuJoCo renders is metric and along the optical axis, as a view's is.
    """
    camera, fovy = data.cam(name), float(np.radians(model.cam(name).fovy[0]))
    axes = camera.xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
    focal, middle = 0.5 * height / np.tan(0.5 * fovy), (0.5 * width, 0.5 * height)
    return PinholeCamera(width, height, focal, focal, *middle, axes, np.array(camera.xpos))


def main(name, out):
    mesh = stand_in(name)
    data = mesh.export(file_type="obj", include_normals=False).encode()
    model = mujoco.MjModel.from_xml_string(XML, {"object.obj": data})
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    camera = camera_of(model, state, "eye", WIDTH, HEIGHT)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(state, "eye")
        image = renderer.render().copy()
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        renderer.enable_segmentation_rendering()
        geom = renderer.render()[..., 0].copy()
    np.savez(
        out,
        image=image,
        depth=depth,
        geom=geom,
        object_geom=model.geom("object").id,
        intrinsics=[camera.fx, camera.fy, camera.cx, camera.cy],
        R_wc=camera.R_wc,
        p_wc=camera.p_wc,
        R_wo=state.body("object").xmat.reshape(3, 3),
        p_wo=state.body("object").xpos,
        vertices=mesh.vertices,
        faces=mesh.faces,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
