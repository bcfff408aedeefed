"""Prints how much of an object is seen at the first pose of a film, from two azimuths.

Of the one that is chosen by all of its poses, and of that by the last one alone. In a process of
its own, as a renderer may take one with it: python camera_script.py
"""

import mujoco
import numpy as np

from mjx_grasp.viz import camera

XML = """
<mujoco><worldbody>
<body name="object" pos="0 0 0.05"><freejoint/><geom type="box" size="0.05 0.05 0.05"/></body>
<body name="arm" pos="0 0 0"><joint type="slide" axis="0 0 1"/>
<geom type="box" size="0.25 0.35 0.35" pos="0.6 0 0.2"/>
<geom type="box" size="0.01 0.3 0.3" pos="-0.2 0 0.2"/></body>
</worldbody></mujoco>
"""


def seen(model, qpos, target, azimuth):
    data, view = mujoco.MjData(model), mujoco.MjvCamera()
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    view.distance, view.elevation, view.azimuth = camera.DISTANCE_M, camera.ELEVATION_DEG, azimuth
    view.lookat[:] = target
    with mujoco.Renderer(model, 96, 96) as renderer:
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, view)
        return int((renderer.render()[..., 0] == 0).sum())


def main():
    model = mujoco.MjModel.from_xml_string(XML)
    begins = model.qpos0.copy()
    ends = begins.copy()
    ends[2], ends[7] = 0.25, -3.0  # lifted, and what stood in the way is gone
    poses, targets = np.stack([begins, ends]), np.array([[0, 0, 0.1], [0, 0, 0.3]])
    for judged in (slice(None), slice(1, None)):
        azimuth = camera.best_azimuth(model, poses[judged], "object", targets[judged])
        print(seen(model, begins, targets[0], azimuth))


if __name__ == "__main__":
    main()
