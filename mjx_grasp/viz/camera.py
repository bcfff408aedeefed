"""Where to look from: the side from which the fingers and the object are seen best."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

DISTANCE_M = 0.62
ELEVATION_DEG = -16.0
TURN_DEG = 24.0  # how far the camera turns about the focus from the first picture to the last
_LOOK_ABOVE_FOCUS_M = 0.05
_LOOK_ABOVE_PAIR_M = 0.02
_STEP_BACK = 0.8  # of the camera per distance between two bodies
_TOGETHER_M = 0.16  # between them where it need not step back
_FOLLOW_S = 0.6  # time over which the camera smooths what it follows
_AZIMUTHS = 16
JUDGED_PIXELS = 96  # side of the pictures on which visibility is judged


def look_at(
    model: Any, poses: Float[np.ndarray, "t nq"], focus: str, fps: float
) -> Float[np.ndarray, "t 3"]:
    """Points to look at [m]: the focus body's path, smoothed, so that the camera never jerks."""
    return _smoothed(_path(model, poses, focus), fps) + np.array([0.0, 0.0, _LOOK_ABOVE_FOCUS_M])


def follow_both(
    model: Any, poses: Float[np.ndarray, "t nq"], focus: str, other: str, fps: float
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"]]:
    """Points between two bodies, and distances from which both are seen [m]; smoothed.

    Args:
        model: The MuJoCo model.
        poses: One per picture.
        focus: Name of the body to follow.
        other: Of the one that is to be seen too.
        fps: Pictures per second.
    """
    one, two = (_path(model, poses, name) for name in (focus, other))
    gap = np.linalg.norm(one - two, axis=1, keepdims=True)
    middle = _smoothed(0.5 * (one + two), fps)
    away = DISTANCE_M + _STEP_BACK * np.maximum(gap - _TOGETHER_M, 0.0)
    return middle + np.array([0.0, 0.0, _LOOK_ABOVE_PAIR_M]), _smoothed(away, fps)[:, 0]


def _path(model: Any, poses: Float[np.ndarray, "t nq"], body: str) -> Float[np.ndarray, "t 3"]:
    """Where a body is at each pose, world [m]."""
    import mujoco

    data, number = mujoco.MjData(model), model.body(body).id
    path = np.empty((len(poses), 3))
    for i, qpos in enumerate(poses):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        path[i] = data.xpos[number]
    return path


def _smoothed(path: Float[np.ndarray, "t k"], fps: float) -> Float[np.ndarray, "t k"]:
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(path, _FOLLOW_S * fps, axis=0, mode="nearest")


def best_azimuth(
    model: Any,
    poses: Float[np.ndarray, "t nq"],
    focus: str,
    targets: Float[np.ndarray, "t 3"],
    distances: Float[np.ndarray, " t"] | None = None,
    turns: Float[np.ndarray, " t"] | None = None,
) -> float:
    """The azimuth [deg] that shows most of the focus body and of every body that touches it.

    That is judged at the last pose; of the others that counts, half as much, at which least is seen
    of the focus body: a camera may not stand in the robot there.

    Args:
        model: The MuJoCo model.
        poses: To judge; best the last one is one in which the object is held.
        focus: Name of the body to see.
        targets: The point to look at, at each of them [m].
        distances: Of the camera [m]; `DISTANCE_M` by default.
        turns: By how much it has turned from the azimuth [deg]; 0 by default.
    """
    import mujoco

    away = np.full(len(poses), DISTANCE_M) if distances is None else distances
    turned = np.zeros(len(poses)) if turns is None else turns
    data, number = mujoco.MjData(model), model.body(focus).id
    azimuths = np.arange(_AZIMUTHS) * 360.0 / _AZIMUTHS
    scores = np.zeros((len(poses), _AZIMUTHS))
    camera = mujoco.MjvCamera()
    camera.elevation = ELEVATION_DEG
    with mujoco.Renderer(model, JUDGED_PIXELS, JUDGED_PIXELS) as renderer:
        renderer.enable_segmentation_rendering()
        for k, qpos in enumerate(poses):
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
            last = k == len(poses) - 1
            shown = _bodies_of_interest(model, data, number) if last else [number]
            camera.distance, camera.lookat[:] = away[k], targets[k]
            for i, azimuth in enumerate(azimuths):
                camera.azimuth = azimuth + turned[k]
                renderer.update_scene(data, camera)
                seen = _visible_pixels(model, renderer.render())
                # Square roots, so that seeing another finger beats seeing more of the same one.
                scores[k, i] = sum(np.sqrt(seen[body]) for body in shown)
    scores /= np.maximum(scores.max(axis=1, keepdims=True), 1e-9)
    held = np.roll(scores[-1], 1) + 2.0 * scores[-1] + np.roll(scores[-1], -1)  # and around
    before = scores[:-1].min(axis=0) if len(scores) > 1 else 0.0
    return float(azimuths[np.argmax(held / max(held.max(), 1e-9) + 0.5 * before)])


def _bodies_of_interest(model: Any, data: Any, focus: int) -> list[int]:
    """The focus body and the moving bodies in contact with it."""
    pairs = model.geom_bodyid[data.contact.geom]
    touching = {int(b) for pair in pairs if focus in pair for b in pair if b != 0}
    return sorted(touching | {focus})


def _visible_pixels(
    model: Any, segmentation: Int[np.ndarray, "h w 2"]
) -> Int[np.ndarray, " nbody"]:
    import mujoco

    ids, kinds = segmentation[..., 0], segmentation[..., 1]
    geoms = ids[kinds == int(mujoco.mjtObj.mjOBJ_GEOM)]
    return np.bincount(model.geom_bodyid[geoms], minlength=model.nbody)
