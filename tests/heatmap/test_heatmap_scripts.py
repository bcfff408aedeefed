"""The scripts around the heatmap, as a user types them, on stand-ins."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent


def run_script(script, *arguments):
    command = [sys.executable, str(ROOT / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_ranking_orders_the_objects(tmp_path):
    out = tmp_path / "ranking.json"
    objects = ("mini_soccer_ball", "foam_brick", "apple")
    done = run_script("experiments/heatmap_ranking.py", "--objects", *objects, "--out", str(out))
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert [r["rank_by_best_mean"] for r in found["rows"]] == [1, 2, 3]
    assert [r["object"] for r in found["rows"]] == ["foam_brick", "apple", "mini_soccer_ball"]
    assert found["watched"]["rank_by_best_mean"] == {"mini_soccer_ball": 3}
    assert found["provenance"]["command"].startswith("python experiments/heatmap_ranking.py")


def test_an_unknown_object_is_one_line(tmp_path):
    done = run_script(
        "experiments/heatmap_oracle.py", "--objects", "spoon", "--out", str(tmp_path / "o.json")
    )
    assert done.returncode == 2
    assert "spoon" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.long
def test_benchmark_writes_its_file_and_plot(tmp_path):
    out = tmp_path / "benchmark.json"
    done = run_script(
        *("benchmarks/heatmap.py", "--objects", "golf_ball", "pear", "--repeats", "1"),
        *("--growth", "300", "1000", "--out", str(out)),
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert out.with_suffix(".png").is_file()
    assert found["summary"]["all_scans_in_one_call_s"] > 0
    assert all(r["times_faster"] > 0 for r in found["scans"])
    assert 0 < found["peak_memory_bytes"]["1000"] < 8e9


@pytest.mark.long
def test_oracle_script_reports_both_backends(tmp_path):
    out = tmp_path / "oracle.json"
    done = run_script("experiments/heatmap_oracle.py", "--objects", "pear", "--out", str(out))
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert set(found["summary"]) == {"bvh", "brute"}
    assert all(r["agree_percent"] > 99.9 for r in found["rows"])
