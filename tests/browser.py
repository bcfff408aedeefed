"""A real, headless browser for tests of pages."""

import importlib.util
import io
import os
import shutil
import socket
import time
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image

from mjx_grasp.language.camera import PinholeCamera

SIZE = {"width": 1000, "height": 700}
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage"),
]


def missing(what):
    if os.environ.get("MJX_GRASP_REQUIRE_BROWSER"):
        pytest.fail(f"{what} is missing")
    pytest.skip(f"{what} is missing")


def need_viser():
    if importlib.util.find_spec("viser") is None:
        missing("viser")


@contextmanager
def browsing(url, size=None):
    """A page of the browser, with the address open."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("playwright")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        missing("chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        opened = browser.new_page(viewport=size or SIZE)
        opened.goto(url)
        yield opened
        browser.close()


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def wait(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.2)


def shot(page):
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def on_screen(server, point, size=None):
    """Where the page shows a point of the world [pixels]."""
    (client,) = server.get_clients().values()
    eye, at = np.asarray(client.camera.position), np.asarray(client.camera.look_at)
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, np.asarray(client.camera.up_direction))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    width, height = (size or SIZE).values()
    focal = 0.5 * height / np.tan(0.5 * client.camera.fov)
    camera = PinholeCamera(width, height, focal, focal, 0.5 * width, 0.5 * height, axes, eye)
    return camera.project(np.asarray(point))[0]


def drag(page, start, end, steps=12):
    page.mouse.move(*start)
    time.sleep(0.5)  # the gizmo notices the mouse in its next frame
    page.mouse.down()
    for k in range(1, steps + 1):
        page.mouse.move(*(start + (end - start) * k / steps))
        time.sleep(0.05)
    page.mouse.up()


def control(page, label):
    """The panel's input behind a label."""
    return page.locator(f"//label[.='{label}']/following::input[1]")


def number(page, label):
    """The panel's field beside a slider."""
    return page.locator(f"//label[.='{label}']/following::input[@type='text'][1]")


def slide(page, label, share):
    """Drags a slider's thumb to a share of its track, from the left."""
    behind = f"//label[.='{label}']/following::*[contains(@class, 'mantine-Slider-{{}}')][1]"
    thumb, track = (page.locator(behind.format(part)).bounding_box() for part in ("thumb", "track"))
    y = thumb["y"] + 0.5 * thumb["height"]
    start = np.array([thumb["x"] + 0.5 * thumb["width"], y])
    drag(page, start, np.array([track["x"] + share * track["width"], y]))
