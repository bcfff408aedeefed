import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest
from PIL import Image

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.evaluation.trajectory import Trajectory, record, save_trajectory
from mjx_grasp.viz import frames, rendering
from mjx_grasp.viz.rendering import RenderError, VideoConfig, render_in_subprocess

XML = """
<mujoco><worldbody>
<geom type="box" size="0.4 0.4 0.01" pos="0 0 -0.01" rgba="0.5 0.5 0.5 1"/>
<body name="object" pos="0 0 0.05"><freejoint/>
<geom type="box" size="0.05 0.05 0.05" rgba="0.9 0.1 0.1 1"/></body>
<geom type="box" size="0.002 0.2 0.2" pos="0.15 0 0.2" rgba="0.1 0.2 0.9 1"/>
</worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def trajectory():
    model = mujoco.MjModel.from_xml_string(XML)
    qpos = np.tile(model.qpos0, (16, 1))
    qpos[:, 2] += np.linspace(0.0, 0.12, 16)
    return record(model, qpos, 0.05)


@pytest.fixture(scope="module")
def stored(trajectory, tmp_path_factory):
    path = tmp_path_factory.mktemp("trajectory") / "t.npz"
    save_trajectory(path, trajectory)
    return path


def rendered(config):
    try:
        render_in_subprocess(config)
    except RenderError as error:
        if os.environ.get("MJX_GRASP_REQUIRE_RENDERER"):
            raise
        pytest.skip(str(error))
    return config.out


def share(picture, channel):
    """Share of the pixels that are clearly of one primary colour."""
    others = np.delete(picture.astype(int), channel, axis=2).max(2)
    return np.mean(picture[..., channel].astype(int) > others + 40)


def test_a_gif_shows_the_object_moving(stored, tmp_path):
    path = rendered(VideoConfig(stored, tmp_path / "g.gif", width=128, height=96, fps=10))
    image = Image.open(path)
    assert image.info["loop"] == 0 and image.size == (128, 96)
    assert image.n_frames == 8  # 0.75 s at ten pictures a second
    pictures = []
    for i in range(image.n_frames):
        image.seek(i)
        pictures.append(np.asarray(image.convert("RGB")))
    for picture in pictures:
        assert share(picture, 0) > 0.02  # the object, from the side without the wall
    assert np.abs(pictures[0].astype(int) - pictures[-1]).mean() > 2
    assert path.stat().st_size < 2e6


def test_the_background_is_plain_and_above_the_table(stored, tmp_path):
    picture = np.asarray(Image.open(rendered(VideoConfig(stored, tmp_path / "b.png", 64, 48, 2))))
    plain = (picture == frames._BACKGROUND).all(axis=2)
    assert plain[0, 0] and plain[0, -1] and not plain[-1, 16:-16].any()
    assert 0.05 < plain.mean() < 0.7


def test_an_mp4_plays_back_with_its_rate_and_size(stored, tmp_path):
    path = rendered(VideoConfig(stored, tmp_path / "v.mp4", width=97, height=64, fps=20, speed=0.5))
    pictures = iio.imread(path)
    assert pictures.shape[1:] == (64, 96, 3)
    assert len(pictures) == 31  # 0.75 s, half as fast, at twenty pictures a second
    assert share(pictures[0], 0) > 0.02
    assert iio.immeta(path)["fps"] == 20


def test_the_command_renders_without_a_display(stored, tmp_path):
    environment = {
        k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    }
    rendered(VideoConfig(stored, tmp_path / "first.png", width=64, height=48, fps=2))
    out = tmp_path / "p.png"
    command = [sys.executable, "-m", "mjx_grasp.viz.video", str(stored), "--out", str(out)]
    done = subprocess.run(
        [*command, "--width", "64", "--height", "48", "--fps", "2"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert str(out) in done.stdout
    assert share(np.asarray(Image.open(out)), 0) > 0.02


def test_without_a_renderer_the_error_says_how_to_get_one(stored, tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "BACKENDS", ("egl",))
    # EGL finds its drivers by these files: with an empty list there is none.
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", str(tmp_path / "none.json"))
    with pytest.raises(RenderError, match=r"no renderer.*egl: .+apt-get install libegl1"):
        render_in_subprocess(VideoConfig(stored, tmp_path / "v.mp4"))
    assert not list(tmp_path.iterdir())
    (tmp_path / "g.gif").write_text("earlier")
    with pytest.raises(InputError, match="max_mb"):
        frames.write_gif(tmp_path / "g.gif", noisy(8), 10, max_bytes=500)
    assert [p.read_text() for p in tmp_path.iterdir()] == ["earlier"]


def test_a_backend_that_fails_is_followed_by_the_next(stored, tmp_path, monkeypatch):
    rendered(VideoConfig(stored, tmp_path / "egl.png", width=32, height=32, fps=2))
    tried = []
    real = rendering._try_backend

    def first_fails(config, backend):
        tried.append(backend)
        return "broken" if len(tried) == 1 else real(config, "egl")

    monkeypatch.setattr(rendering, "_try_backend", first_fails)
    render_in_subprocess(VideoConfig(stored, tmp_path / "next.png", width=32, height=32, fps=2))
    assert tried == ["egl", "osmesa"] and (tmp_path / "next.png").is_file()


def test_what_is_no_trajectory_is_a_file_error_and_no_render_error(stored, trajectory, tmp_path):
    with pytest.raises(FileError, match=r"none\.npz"):
        render_in_subprocess(VideoConfig(tmp_path / "none.npz", tmp_path / "v.mp4"))
    old = Trajectory(trajectory.model, "2.0.0", trajectory.qpos, 0.05, "object")
    save_trajectory(tmp_path / "old.npz", old)
    with pytest.raises(RenderError, match=r"MuJoCo 2\.0\.0.*record it again"):
        render_in_subprocess(VideoConfig(tmp_path / "old.npz", tmp_path / "v.mp4"))


@pytest.mark.parametrize(
    "changes", [{"out": "v.avi"}, {"width": 8}, {"fps": 0}, {"speed": 0.0}, {"max_mb": -1.0}]
)
def test_impossible_settings_are_refused(tmp_path, changes):
    from pathlib import Path

    values = {"out": "v.mp4"} | changes
    with pytest.raises(InputError):
        VideoConfig(tmp_path / "t.npz", **(values | {"out": Path(values["out"])}))


def noisy(n, size=(120, 160)):
    rng = np.random.default_rng(0)
    return [rng.integers(0, 255, (*size, 3), dtype=np.uint8) for _ in range(n)]


def test_a_gif_is_made_smaller_until_it_fits(tmp_path):
    path = tmp_path / "g.gif"
    pictures = noisy(20)
    frames.write_gif(path, pictures, 20)
    full = path.stat().st_size
    assert Image.open(path).n_frames == 20
    frames.write_gif(path, pictures, 20, max_bytes=full // 3)
    image = Image.open(path)
    assert path.stat().st_size <= full // 3
    length = sum(_duration(image, i) for i in range(image.n_frames))
    assert length == pytest.approx(1000, abs=120)  # fewer pictures, the same time [ms]


def _duration(image, i):
    image.seek(i)
    return image.info["duration"]


def test_a_gif_that_cannot_fit_is_refused_and_not_left(tmp_path):
    with pytest.raises(InputError, match="max_mb"):
        frames.write_gif(tmp_path / "g.gif", noisy(8), 10, max_bytes=500)
    assert not list(tmp_path.iterdir())


def test_a_camera_stands_where_the_object_is_seen_before_it_is_held_too():
    for backend in ("egl", "osmesa"):
        ran = subprocess.run(
            [sys.executable, Path(__file__).with_name("camera_script.py")],
            env=os.environ | {"MUJOCO_GL": backend},
            capture_output=True,
            text=True,
        )
        if ran.returncode == 0:
            break
    else:
        if os.environ.get("MJX_GRASP_REQUIRE_RENDERER"):
            pytest.fail(ran.stderr)
        pytest.skip("no renderer")
    by_all, by_the_last = map(int, ran.stdout.split())
    assert by_all > 200 > 10 > by_the_last
