"""Tables for the READMEs: how fast things are, from heatmaps to trainings on several GPUs.

Each takes the paths of results files and gives Markdown; `make_readme.py` puts it in place.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markdown_tables import NOTHING, markdown, read, short_revision
from paper_parts import Part, fewer

from mjx_grasp.evaluation.conditions import read_groups
from mjx_grasp.evaluation.verdict import verdict
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

HEATMAP_SCHEMA = "mjx_grasp.heatmap_benchmark/1"


def heatmap_speed(paths: Sequence[Path]) -> str:
    """Times of the heatmap benchmark, device by device."""
    rows = []
    for path in paths:
        d = read_json(path, "a results file")
        if d.get("schema") != HEATMAP_SCHEMA:
            continue
        s = d["summary"]
        faster = s.get("times_faster_than_reference", {}).get("median")
        rows.append(
            (
                str(d["provenance"]["device"]),
                f"{1e3 * s['median_seconds_per_scan']:.1f}",
                f"{1e3 * s['all_scans_in_one_call_s']:.0f}",
                f"{1e3 * s['steer_s']:.2f}",
                f"{1e3 * s['steer_1000_anchors_s']:.2f}",
                "" if faster is None else f"{faster:.0f} ×",
            )
        )
    header = ("device", "one scan ms", "28 scans ms", "steering ms", "1,000 anchors ms")
    table = Table("Heatmap", (*header, "against trimesh + embree"), tuple(rows))
    return markdown(table) if rows else NOTHING


def paper_times(path: Path, parts: Sequence[Part]) -> str:
    """How long the parts of `experiments/paper.py` took.

    Args:
        path: What it keeps of its commands, `--state`.
        parts: All of them.
    """
    kept = read(path) or {}
    commands, rows = kept.get("commands", {}), []

    def row(name: str, counted: str, quick: bool, entries: Sequence[dict[str, Any]]) -> None:
        minutes = sum(entry["seconds"] for entry in entries) / 60
        machines = dict.fromkeys(entry["machine"] for entry in entries)
        code = dict.fromkeys(short_revision(entry) for entry in entries)
        words = "; ".join(machines), ", ".join(code)
        rows.append((name, counted, "yes" if quick else "", f"{minutes:.1f}", *words))

    for part in parts:
        forms = [form for one in part.commands for form in dict.fromkeys((one, fewer(one)))]
        ran = [form for form in forms if form in commands]
        if ran:
            counted = f"{len(ran)} of {len(part.commands)}"
            quick = any(form not in part.commands for form in ran)
            row(part.name, counted, quick, [commands[form] for form in ran])
    for run in kept.get("runs", []):
        row(f"{len(run['parts'])} parts together", "all", run["quick"], [run])
    header = ("part", "commands", "quick", "minutes", "machine", "code")
    return markdown(Table("Times", header, tuple(rows))) if rows else NOTHING


def grasper_speed(paths: Sequence[Path]) -> str:
    """How long a tick of the controller and a search for plans take, device by device."""
    rows = []
    for d in filter(None, map(read, paths)):
        device = d["provenance"]["device"]
        for phase, in_loop in d["tick_ms"].items():
            if in_loop["count"]:
                times = (in_loop, d["tick_alone_ms"][phase])
                cells = (f"{s[p]:.2f}" for s in times for p in ("p50", "p99"))
                rows.append((device, f"tick, {phase}", str(in_loop["count"]), *cells))
        s = d["plan_ms"]
        cells = f"{s['p50']:.0f}", f"{s['p99']:.0f}", "", ""
        rows.append((device, "search for plans", str(s["count"]), *cells))
    loop, alone = ("median ms", "99 % ms"), ("alone: median ms", "alone: 99 % ms")
    header = ("device", "what", "times", *loop, *alone)
    return markdown(Table("Controller", header, tuple(rows), names=2)) if rows else NOTHING


def grasper_worlds(paths: Sequence[Path]) -> str:
    """How fast many whole grasps run at once, against real time."""
    rows = []
    for path in paths:
        d = read_json(path, "a results file")
        times = d["times_real_time"]
        plan_ms = 1e3 * d["plan_s"] / d["worlds"]
        rows.append(
            (
                d["provenance"]["device"],
                f"{d['worlds']:,}",
                str(len(d["objects"])),
                f"{1e3 * d['physics_dt']:g}",
                str(d["solver_iterations"]),
                *(f"{times[what]:.2f}" for what in ("physics", "ticks", "with plans")),
                f"{plan_ms:.1f}",
                f"{d['lifted_percent']:.1f}",
                f"{sum(d['compile_s'].values()):.0f}",
            )
        )
    header = (
        "device", "worlds", "objects", "physics step ms", "Newton steps", "physics alone",
        "with controllers", "and plans", "a plan ms", "lifted %", "compiling s",
    )  # fmt: skip
    return markdown(Table("Many grasps", header, tuple(rows))) if rows else NOTHING


def first_run(path: Path) -> str:
    """What `make train` took from a fresh clone, and what it learned."""
    d = read(path)
    if d is None or "make_train" not in d:
        return NOTHING
    m = d["make_train"]
    return (
        f"`make setup` and `make train` in a fresh clone took {m['total_s'] / 60:.1f} min on "
        f"{d['provenance']['device']}: {m['setup_s'] / 60:.1f} for the environment, "
        f"{m['training_s'] / 60:.1f} of training, the rest start states, evaluation, "
        f"video and report. In {m['env_steps']:,} steps the return went from "
        f"{m['return_first_tenth']:.0f} to {m['return_last_tenth']:.0f} and the share of lifted "
        f"objects in training from {m['success_first_tenth_percent']:.0f} to "
        f"{m['success_last_tenth_percent']:.0f} % (first and last tenth of the iterations)."
        + _before_and_after(d)
        + "".join(f" {sentence}" for sentence in verdict(read_groups([path])))
    )


def _before_and_after(d: dict[str, Any]) -> str:
    """What the evaluation says that the training brought."""
    if "untrained_n" not in d:
        return ""
    own = [r for r in d["rows"] if r.get("label") is None]
    count = {
        name: f"{sum(r['successes'] for r in rows)} of {sum(r['episodes'] for r in rows)}"
        for name, rows in (
            ("before", [r for r in own if r["squeeze_force_n"] == d["untrained_n"]]),
            ("after", [r for r in own if r["controller"] == "policy"]),
        )
    }
    return (
        f" In the evaluation {count['after']} objects are lifted, and {count['before']} before "
        f"training (by the command alone that the policy adds to, {d['untrained_n']:g} N)."
    )


def tests(path: Path) -> str:
    """What `make test` said in a fresh clone, by Python and JAX."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = tuple(
        (
            r["provenance"]["versions"]["python"],
            r["provenance"]["versions"]["jax"],
            r["provenance"]["device"],
            f"{r['passed']:,}",
            str(len(r["failed"])),
            str(len(r["skipped"])),
            f"{r['test_s'] / 60:.1f}",
            f"{r['setup_s'] / 60:.1f}",
            short_revision(r["provenance"]),
        )
        for r in d["rows"]
    )
    header = ("Python", "JAX", "device", "passed", "failed", "skipped", "tests min", "setup min")
    return markdown(Table("Tests", (*header, "git"), rows, names=3))


def devices(paths: Sequence[Path]) -> str:
    """Trainings on several GPUs of one host: how they ended, how fast, and what they learned.

    Each is compared with a single GPU at the same revision where there is one.
    """
    files = [read_json(path, "a results file") for path in paths]
    found = [
        (
            d["provenance"]["device"],
            r | {"seed": d["settings"]["seed"], "git": d["provenance"]["git"]},
        )
        for d in files
        for r in d["rows"]
    ]
    rows = []
    for device, r in sorted(found, key=lambda x: (x[1]["worlds"], x[1]["devices"])):
        speed = r["steps_per_s"]
        ones = [x for on, x in found if (on, x["devices"], x["worlds"]) == (device, 1, r["worlds"])]
        ones.sort(key=lambda x: x["git"] == r["git"])
        one = ones[-1]["steps_per_s"] if ones else None
        compared = speed and one and r["devices"] > 1
        rows.append(
            (
                device,
                str(r["devices"]),
                {"processes": "one each", "donate": "one, donating"}.get(r["way"], "one"),
                f"{r['worlds']:,}",
                r["outcome"].split(":")[0],
                f"{r['env_steps'] / 1e6:.1f}",
                f"{r['seconds']:.0f}",
                "" if r["first_iteration_s"] is None else f"{r['first_iteration_s']:.0f}",
                f"{speed:,.0f}" if speed else "",
                f"{speed / one:.2f}" if compared else "",
                "" if r["success_percent"] is None else f"{r['success_percent']:.1f}",
                "" if r["force_n"] is None else f"{r['force_n']:.1f}",
                str(r["seed"]),
            )
        )
    header = (
        "device", "GPUs", "processes", "worlds of each", "came to", "M steps", "s in all",
        "first iteration s", "control steps/s", "times one", "success %", "force N", "seed",
    )  # fmt: skip
    return markdown(Table("Several GPUs", header, tuple(rows), names=3)) if rows else NOTHING


def together(paths: Sequence[Path]) -> str:
    """Seeds that are trained in step, against one alone on the same device."""
    rows = []
    for d in (read_json(path, "a results file") for path in paths):
        one = next(r for r in d["rows"] if r["seeds"] == 1)
        for r in d["rows"]:
            apart = r["seeds"] * one["iteration_s"] / r["iteration_s"]
            rows.append(
                (
                    d["provenance"]["device"],
                    str(r["seeds"]),
                    f"{r['worlds']:,} × {r['unroll']}",
                    f"{1e3 * d['physics_dt']:g}",
                    f"{r['compile_s']:.0f}",
                    f"{r['iteration_s']:.2f}",
                    f"{r['steps_per_s']:,.0f}",
                    f"{apart:.1f}",
                )
            )
    header = (
        "device", "seeds", "worlds of each × unroll", "physics step ms", "compiling s",
        "iteration s", "control steps/s", "times as fast as apart",
    )  # fmt: skip
    return markdown(Table("Seeds together", header, tuple(rows))) if rows else NOTHING


def tuned(paths: Sequence[Path], alone_files: Sequence[Path] = ()) -> str:
    """Trainings that shared machines: how long each of them took, and all together.

    Args:
        paths: Tables of `tune`.
        alone_files: Trainings alone on one GPU. Where one of them is of the same worlds and
            iterations, that many of it one after the other are the comparison.
    """
    rows, alone = [], {}
    for d in (read_json(path, "a results file") for path in alone_files):
        for r in d["rows"]:
            if r["devices"] == 1 and r["outcome"] == "finished":
                alone[d["provenance"]["device"], r["worlds"], r["iterations"]] = r["seconds"]
    for path in paths:
        d = read_json(path, "a results file")
        success = [r["trained_percent"] for r in d["rows"]]
        took, gpus = d.get("took_s"), d["settings"]["gpus"]
        names = list(dict.fromkeys(r["setting"] for r in d["rows"]))
        plan = d.get("plan", {})
        flags = plan.get("flags", {}) | (plan.get("settings", {}).get(names[0]) or {})
        size = flags.get("ppo.worlds"), flags.get("ppo.iterations")
        device = d["provenance"]["device"]
        one = alone.get((device, *size)) if len(names) == 1 else None
        rows.append(
            (
                device,
                ", ".join(names) + (", {:,} worlds × {:,}".format(*size) if all(size) else ""),
                str(len(success)),
                f"{d['settings']['cpus']:g}",
                f"{gpus:g}" if gpus else "",
                f"{statistics.median(r['seconds'] for r in d['rows']):.0f}",
                f"{took:.0f}" if took else "",
                f"{one * len(success):.0f}" if one else "",
                f"{statistics.mean(success):.1f} ({min(success):.1f}–{max(success):.1f})",
            )
        )
    header = (
        "device", "setting", "seeds", "cores of each", "GPUs of each", "each s, median", "all s",
        "one by one s", "success %, least to most",
    )  # fmt: skip
    return markdown(Table("Many trainings", header, tuple(rows), names=2)) if rows else NOTHING
