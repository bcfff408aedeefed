import base64
import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from browser import browsing
from PIL import Image

from mjx_grasp.errors import FileError
from mjx_grasp.evaluation.conditions import BEGAN_WITH
from mjx_grasp.evaluation.results import ResultRow, write_results
from mjx_grasp.evaluation.statistics import wilson_interval
from mjx_grasp.robot.identity import FIRST_ROBOT
from mjx_grasp.viz.report import write_report

PROVENANCE = {
    "command": "python -m mjx_grasp.train",
    "git": "0123abc",
    "versions": {"jax": "0.10.2"},
    "device": "a <small> card",
    "seed": 7,
}
VOID = {"meta", "img"}


class Page(HTMLParser):
    """Text, tags and links of a page; fails on tags that do not nest."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.text, self.tags = [], [], "", []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [v for k, v in attrs if k in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def result(successes, force=None):
    return ResultRow(
        object="apple", controller="policy" if force is None else "squeeze", engine="mujoco",
        episodes=64, successes=successes, never_lifted=64 - successes, not_held=0, slipped=0,
        ci95=wilson_interval(successes, 64), force_mean_n=2.0 + (force or 0), force_peak_n=9.0,
        squeeze_force_n=force, offset_mm=5.0, angle_deg=0.0, friction=0.8, handoffs="ik",
    )  # fmt: skip


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "cpu & more"
    folder.mkdir()
    (folder / "metrics.csv").write_text(
        "iteration,env_steps,steps_per_s,return,success,force_n\n"
        "1,100,50,nan,nan,nan\n2,200,60,1.0,0.2,3.0\n3,300,60,2.0,0.5,3.0\n"
    )
    (folder / "config.json").write_text(json.dumps({"preset": "cpu", "ppo": {"worlds": 128}}))
    (folder / "provenance.json").write_text(json.dumps(PROVENANCE))
    write_results(folder / "results.json", [result(60), result(40, 3.0)], PROVENANCE, FIRST_ROBOT)
    return folder


def written(run, video=None, problem=None, results=("results.json",)):
    out = run / "report.html"
    write_report(run, [run / name for name in results], video, problem, out)
    return Page(out.read_text(encoding="utf-8"))


def test_the_report_holds_everything_and_needs_nothing_beside_it(run):
    (run / "grasp.mp4").write_bytes(b"video bytes")
    page = written(run, video=run / "grasp.mp4")
    assert all(link.startswith("data:") for link in page.links)
    video = next(link for link in page.links if link.startswith("data:video/mp4;base64,"))
    assert base64.b64decode(video.partition(",")[2]) == b"video bytes"
    pictures = [link for link in page.links if link.startswith("data:image/png")]
    assert len(pictures) == 2  # curves, and success against force
    for picture in pictures:
        image = Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2])))
        assert min(image.size) > 300
    for text in ("93.8 (", "62.5 (", "squeeze 3 N", '"worlds": 128', "a <small> card", "0123abc"):
        assert text in page.text
    assert "cpu & more" in page.text


def test_a_gif_is_shown_as_a_picture(run):
    (run / "grasp.gif").write_bytes(b"GIF89a")
    page = written(run, video=run / "grasp.gif")
    assert any(link.startswith("data:image/gif") for link in page.links)
    assert "video" not in page.tags


def kept(successes, force=None):
    """A row whose outcomes, forces and starts were kept."""
    return replace(
        result(successes, force),
        outcomes="S" * successes + "L" * (64 - successes),
        forces_n=(2.0 + (force or 0),) * 64,
        force_peak_p50_n=4.0,
        force_peak_p99_n=8.0,
        starts=tuple(range(64)),
    )


def test_the_report_begins_with_what_came_of_it(run):
    """Where forces and starts were kept: the policy against a squeeze of its own force."""
    for rows, said in (([result(60), result(40, 3.0)], False), ([kept(60), kept(40, 3.0)], True)):
        write_results(run / "results.json", rows, PROVENANCE, FIRST_ROBOT)
        page = written(run)
        begin, _, rest = page.text.replace("\N{NO-BREAK SPACE}", " ").partition("Success against")
        # On the line from nothing to 62.5 % at 5 N.
        lifts = "the policy lifts 93.8 %, more than a squeeze (25.0 %)."
        assert (f"At an equal force of 2.0 N per finger {lifts}" in begin) == said
        assert ("vs. squeeze25.0+68.8 (" in begin) == said
        assert ("At equal force, points" in rest) == said
        assert begin.count("native MuJoCo") == said, "once, above the table"


def test_the_page_fits_screens(run):
    """Wide ones and phones, where what is too wide scrolls by itself; nothing does on wide ones."""
    began = [replace(kept(n), label=BEGAN_WITH, force_budget_n=b) for n, b in ((50, 1.5), (60, 3))]
    own = [replace(row, label=None) for row in began]
    grips = [
        replace(kept(61), controller="grip", grip_force_n=1.5, grip_friction=friction)
        for friction in (0.4, 0.7)
    ]
    squeezes = [kept(n, force) for n, force in ((40, 3.0), (50, 5.0), (64, 8.0))]
    rows = [*own, *began, *grips, *squeezes]
    write_results(run / "results.json", rows, PROVENANCE, FIRST_ROBOT, label="policy, preset cpu")
    written(run)
    for width in (1100, 390):
        with browsing((run / "report.html").as_uri(), {"width": width, "height": 800}) as page:
            page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
            widest = page.evaluate("document.documentElement.scrollWidth")
            scrolls = page.evaluate(
                "[...document.querySelectorAll('.table div')]"
                ".map(d => d.scrollWidth > d.clientWidth)"
            )
        assert widest <= width and len(scrolls) == 6
        assert any(scrolls) == (width == 390)


def test_the_report_says_which_squeeze_is_the_untrained_policy(run):
    results = [run / "results.json"]
    rows = [result(60), result(40, 3.0)]
    for extra, said in (({}, False), ({"untrained_n": 3.0}, True)):
        write_results(results[0], rows, PROVENANCE, FIRST_ROBOT, **extra)
        write_report(run, results, None, None, run / "report.html")
        text = Page((run / "report.html").read_text()).text
        assert ("squeeze 3 N is the policy before its training" in text) == said


@pytest.mark.long
def test_without_a_video_the_report_says_how_to_get_one(run):
    page = written(run, problem="no renderer <here>: apt-get install libegl1")
    assert "No video. no renderer <here>: apt-get install libegl1" in page.text
    assert "video" not in page.tags and "93.8 (" in page.text
    assert "No video" in written(run, video=run / "lost.mp4").text


def test_what_a_run_lacks_is_named_and_the_rest_comes_out(run):
    for name in ("metrics.csv", "config.json", "provenance.json"):
        (run / name).unlink()
    page = written(run)
    assert re.search(r"No curves: .*metrics\.csv", page.text)
    assert "no readable config.json" in page.text
    assert "93.8 (" in page.text and "0123abc" in page.text  # the results' own provenance
    assert "No evaluation" in written(run, results=()).text


def test_damaged_results_are_an_error_and_leave_the_old_report(run):
    written(run)
    before = (run / "report.html").read_bytes()
    (run / "results.json").write_text("{")
    with pytest.raises(FileError, match=r"results\.json"):
        written(run)
    assert (run / "report.html").read_bytes() == before
