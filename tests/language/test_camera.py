import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from render_scene import camera_of
from scipy.spatial.transform import Rotation

from mjx_grasp.errors import InputError
from mjx_grasp.language.camera import PinholeCamera


def camera(seed=0):
    rotation = Rotation.random(random_state=seed).as_matrix()
    return PinholeCamera(640, 480, 610.0, 605.0, 322.0, 238.0, rotation, np.array([0.3, -1.0, 2.0]))


@given(st.integers(0, 50), st.floats(0, 640), st.floats(0, 480), st.floats(0.05, 5))
def test_projecting_what_was_back_projected_gives_the_pixel_and_depth_again(seed, x, y, depth):
    eye = camera(seed)
    point = eye.back_project(np.array([x, y]), depth)
    pixel, again = eye.project(point)
    assert np.allclose(pixel, [x, y], atol=1e-6)
    assert again == pytest.approx(depth)


@given(st.integers(0, 50), st.floats(0, 640), st.floats(0, 480))
def test_depth_is_along_the_axis_and_not_along_the_ray(seed, x, y):
    eye = camera(seed)
    origin, direction = eye.ray(np.array([x, y]))
    point = eye.back_project(np.array([x, y]), 2.0)
    assert np.allclose(np.cross(point - origin, direction), 0, atol=1e-9)
    assert (point - origin) @ eye.R_wc[:, 2] == pytest.approx(2.0)
    assert np.linalg.norm(point - origin) >= 2.0


def test_axes_are_right_down_forward():
    focal = 240 / np.tan(np.radians(30))
    eye = PinholeCamera(640, 480, focal, focal, 320.0, 240.0, np.eye(3), np.zeros(3))
    half_height = 2.0 * np.tan(np.radians(30))
    pixel, depth = eye.project(np.array([[0, half_height, 2.0], [0.1, 0, 2.0], [0, 0, 1.0]]))
    assert np.allclose(pixel[0], [320, 480])
    assert pixel[1, 0] > 320
    assert depth.tolist() == [2, 2, 1]


def test_a_mujoco_camera_looks_where_mujoco_says():
    xml = """<mujoco><worldbody>
      <camera name="down" pos="0.2 0.1 1.5" fovy="50"/>
      <camera name="side" pos="1 0 0.5" xyaxes="0 1 0 0 0 1"/>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    down = camera_of(model, data, "down", 320, 200)
    pixel, depth = down.project(np.array([[0.2, 0.1, 0.5], [0.3, 0.2, 0.5]]))
    assert np.allclose(pixel[0], [160, 100]) and depth[0] == pytest.approx(1.0)
    assert pixel[1, 0] > 160 and pixel[1, 1] < 100, "x to the right, y up in the picture"
    side = camera_of(model, data, "side", 320, 200)
    pixel, depth = side.project(np.array([0.0, 0.0, 0.5]))
    assert np.allclose(pixel, [160, 100]) and depth == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "field"),
    [({"width": 0}, "camera size"), ({"fx": 0.0}, "focal"), ({"R_wc": 2 * np.eye(3)}, "R_wc")],
)
def test_impossible_cameras_are_refused(change, field):
    good = {"width": 4, "height": 4, "fx": 5.0, "fy": 5.0, "cx": 2.0, "cy": 2.0}
    pose = {"R_wc": np.eye(3), "p_wc": np.zeros(3)}
    with pytest.raises(InputError, match=field):
        PinholeCamera(**(good | pose | change))
