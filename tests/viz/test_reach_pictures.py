"""The gallery of a sweep's failures: its layout, and that something is on the pictures."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mjx_grasp.evaluation.reach.results import FAILURES

ROOT = Path(__file__).resolve().parents[2]
PATHS = {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'experiments'}"}
SIZE, CAPTION, PER_CLASS = 320, 18, 2
# A process of its own, for MUJOCO_GL is read when MuJoCo is imported.
SCRIPT = """
import json
import sys
from pathlib import Path

import numpy as np

from mjx_grasp.posture.body import robot_body
from mjx_grasp.evaluation.reach.poses import draw_poses
from mjx_grasp.evaluation.reach.record import empty_record
from mjx_grasp.robot.spec import load_robot
from mjx_grasp.viz.frames import BackendError
from renderer import check_backend
from reach_failures import failure_gallery

try:
    check_backend()
except BackendError as error:
    print(error, file=sys.stderr)
    sys.exit(77)
robot = load_robot()
body = robot_body(robot)
classes = np.array(json.loads(sys.argv[2]))
record = empty_record(len(body.lower))
record = type(record)(
    *(np.repeat(np.asarray(leaf)[None], len(classes), axis=0) for leaf in record)
)
record = record._replace(
    best_q=np.tile(np.asarray(body.home), (len(classes), 1)),
    best_error=np.linspace(0.01, 0.05, len(classes)),
)
failure_gallery(
    Path(sys.argv[1]), robot, draw_poses(len(classes), 0), record, classes, per_class=2
)
"""


def _drawn(path, classes):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(path), json.dumps(classes)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MUJOCO_GL": "egl", "JAX_PLATFORMS": "cpu"} | PATHS,
    )
    if done.returncode == 77 and not os.environ.get("MJX_GRASP_REQUIRE_RENDERER"):
        pytest.skip(done.stderr)
    assert done.returncode == 0, done.stderr
    return np.asarray(Image.open(path).convert("RGB"))


def _cell(sheet, row, column):
    top = row * (SIZE + CAPTION)
    cell = sheet[top : top + SIZE + CAPTION, column * SIZE : (column + 1) * SIZE]
    return cell[:CAPTION], cell[CAPTION:].astype(int)


@pytest.mark.long
def test_a_row_per_class_and_its_reaches_side_by_side(tmp_path):
    # Three that converged, of which two are shown; one and two of two classes; none of others.
    present = [0, len(FAILURES) - 1]
    classes = [-1, present[1], -1, present[0], -1, present[1]]
    sheet = _drawn(tmp_path / "gallery.png", classes)
    assert sheet.shape == (3 * (SIZE + CAPTION), PER_CLASS * SIZE, 3)
    for row, count in enumerate((2, 1, 2)):
        for column in range(PER_CLASS):
            caption, picture = _cell(sheet, row, column)
            if column >= count:
                assert np.all(caption == 255) and np.all(picture == 255)
                continue
            assert caption.min() < 100
            # The cylinder's orange, and the table's and robot's greys, not a plain background.
            red, green, blue = np.moveaxis(picture, 2, 0)
            orange = np.mean((red > green + 40) & (green > blue))
            assert 0.002 < orange < 0.5
            assert picture.std(axis=(0, 1)).min() > 10
    # Other poses look different.
    first, second = (_cell(sheet, 0, column)[1] for column in range(2))
    assert np.abs(first - second).mean() > 1
