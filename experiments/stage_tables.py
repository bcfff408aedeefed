"""Tables for the READMEs: heatmap, the first run.

Each takes the path of one results file and gives Markdown; `make_readme.py` puts it in place.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjx_grasp.evaluation.front_tables import headline
from mjx_grasp.evaluation.grasps.scenario import NOMINAL
from mjx_grasp.evaluation.tables import read_groups
from mjx_grasp.records.atomic import read_json
from mjx_grasp.records.table import Table

HEATMAP_SCHEMA = "mjx_grasp.heatmap_benchmark/1"
NOTHING = "_No results file yet._"


def markdown(table: Table) -> str:
    """A table without its title, as Markdown."""
    first = len(table.rows) - table.summary
    rule = ["---"] * table.names + ["---:"] * (len(table.header) - table.names)
    lines = [table.header, tuple(rule)]
    for i, row in enumerate(table.rows):
        lines.append(row if i < first else tuple(f"**{c}**" if c else "" for c in row))
    return "\n".join(f"| {' | '.join(c.replace('|', '/') for c in cells)} |" for cells in lines)


def read(path: Path) -> dict[str, Any] | None:
    """A results file; None where there is none."""
    return read_json(path, "a results file") if path.exists() else None


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


def heatmap_oracle(path: Path) -> str:
    """Agreement with the independent implementation."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = tuple(
        (
            backend,
            f"{s['vertices']:,}",
            f"{s['agree']:,}",
            f"{s['least_agree_percent']:.2f}",
            ", ".join(f"{count} {why}" for why, count in s["exceptions"].items()),
        )
        for backend, s in d["summary"].items()
    )
    header = ("backend", "vertices", f"agree to {d['score_tolerance']:g}", "worst scan %", "others")
    return markdown(Table("Oracle", header, rows))


def heatmap_ranking(path: Path) -> str:
    """Where the objects that the publication calls hard stand among all."""
    d = read(path)
    if d is None:
        return NOTHING
    seen = d["watched"]
    rows = tuple(
        (name.replace("_", " "), f"{rank}", f"{seen['rank_by_good_share'][name]}")
        for name, rank in seen["rank_by_best_mean"].items()
    )
    header = (
        f"rank of {seen['of']} by",
        f"mean of the best {100 * d['best_share']:.0f} %",
        f"share above {d['good_score']:g}",
    )
    last = ", ".join(name.replace("_", " ") for name in seen["last_four"])
    return f"{markdown(Table('Ranking', header, rows))}\n\nThe last four: {last}."


def eligibility(path: Path) -> str:
    """Which settings make which objects eligible, and what limits those that are not."""
    d = read(path)
    if d is None:
        return NOTHING
    compared = []
    for row in d["compared"]:
        kept, ranks = row["overlap_of_the_eight"], sorted(row["ranks"].values())
        compared.append(
            (
                row["settings"],
                f"{row['eligible']} of {row['of']}",
                ", ".join(str(rank) for rank in ranks),
                f"{100 * kept['mean']:.0f} ({100 * kept['least']:.0f})",
            )
        )
    header = ("settings", "eligible", "ranks of the four", "kept on the eight, mean (least) %")
    first, last = (d["compared"][k]["settings"] for k in (0, -1))
    limited = tuple(
        (
            row["object"].replace("_", " "),
            row[first]["limit"],
            *(f"{row[first][key]:.3f}" for key in ("best", "best_without_it")),
            *(f"{row[first]['candidates']}", f"{row[last]['candidates']}"),
            *(f"{row[last]['best']:.3f}", f"{100 * row[last]['share']:.1f}"),
        )
        for row in sorted(d["rows"], key=lambda row: row[last]["share"])
    )
    names = ("object", "limited by", "best", "best without it", "candidates")
    titles = (*names, "with the default", "best", "share of the surface %")
    return "\n\n".join(
        (
            markdown(Table("Settings", header, tuple(compared))),
            markdown(Table("Objects", titles, limited, names=2)),
        )
    )


def failing_starts(path: Path) -> str:
    """What tells the start states that always fail from the others, and the reasons."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = []
    for part in d["parts"]:
        left = part["left_by"]
        rows.append(
            (
                part["part"],
                f"{part['failing']} of {part['states']}",
                *(f"{part['auc'][name]:.2f}" for name in part["auc"]),
                *(f"{left[k]['failing']} of {left[k]['states']}" for k in left),
            )
        )
    told = [{"score": "low score"}.get(name, name) for name in d["parts"][0]["auc"]]
    header = ("states", "always fail", *told, "left without lift", "and without reach")
    reasons: dict[str, int] = {}
    for row in d["rows"]:
        reasons[row["reason"]] = reasons.get(row["reason"], 0) + 1
    counted = ", ".join(f"{name} {n}" for name, n in sorted(reasons.items(), key=lambda r: -r[1]))
    return (
        f"{markdown(Table('Failing starts', header, tuple(rows)))}\n\n"
        f"Of the training states that always fail: {counted}. An arm cannot lift if the palm ends "
        f"more than {1e3 * d['lift_error_m']:.0f} mm from where it should, a finger cannot reach "
        f"if its pad stays more than {1e3 * d['reach_m']:.0f} mm from the contact; the least force "
        f"is that at friction {d['friction']:g}."
    )


def route(path: Path) -> str:
    """What came of the poses that were tried for the picture of the route."""
    d = read(path)
    if d is None:
        return NOTHING
    name, tried = d["object"].replace("_", " "), len(d["outcomes"])
    return (
        f"{name} ({d['mesh']}), {d['asked']}, scenario {d['scenario']['name']}: the first success "
        f"in {tried} random pose{'s' * (tried > 1)} (seed {d['seed']})."
    )


def whole_grasps(path: Path) -> str:
    """Grasps from home while nothing happens, object by object."""
    d = read(path)
    if d is None or NOMINAL not in d["scenarios"]:
        return NOTHING
    nominal = d["scenarios"][NOMINAL]
    lines = []
    for name, s in {**nominal["objects"], "all": nominal["all"]}.items():
        tips = " / ".join(_number(x) for x in s["tip_error_mm"])
        lines.append((name.replace("_", " "), *_grasp_cells(s), *_failure_cells(s), tips))
    header = (
        *("object", *_GRASP_COLUMNS),
        *("not reached", "lost", "tips mm"),
    )
    return _closed_by(d) + markdown(Table("Whole grasps", header, tuple(lines), summary=1))


def _closed_by(record: dict[str, Any]) -> str:
    """What closed the grasps of a file."""
    config = record["config"]
    if config["controller"] == "grip":
        return "Closed by the untrained grip alone:\n\n"
    return f"Closed by the policy, with a force budget of {config['force_budget']:g} N:\n\n"


def scenarios(path: Path) -> str:
    """Grasps from home while this or that happens, over all objects."""
    d = read(path)
    if d is None:
        return NOTHING
    lines = []
    for name, result in d["scenarios"].items():
        s = result["all"]
        what = f"{name.replace('_', ' ')}: {result['settings']['description']}"
        lines.append((what, *_grasp_cells(s), *_failure_cells(s), str(s["hit"])))
    header = ("scenario", *_GRASP_COLUMNS, "not reached", "lost", "hit")
    return markdown(Table("Scenarios", header, tuple(lines)))


def foreign_meshes(path: Path) -> str:
    """What came of meshes that no catalogue has."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = tuple(
        (name, row["refused"] or f"{row['outcome'].replace('_', ' ')}, "
         + (f"lifted after {row['lifted_s']:.1f} s" if row["lifted_s"] else "not lifted"))
        for name, row in d["meshes"].items()
    )  # fmt: skip
    return markdown(Table("Foreign meshes", ("mesh", "what came of it"), rows, names=2))


def grasper_speed(path: Path) -> str:
    """How long a tick of the controller and a search for plans take."""
    d = read(path)
    if d is None:
        return NOTHING
    rows = [
        (f"tick, {phase}", str(s["count"]), f"{s['p50']:.2f}", f"{s['p99']:.2f}")
        for phase, s in d["tick_ms"].items()
        if s["count"]
    ]
    s = d["plan_ms"]
    rows.append(("search for plans", str(s["count"]), f"{s['p50']:.0f}", f"{s['p99']:.0f}"))
    header = ("what", "times", "median ms", "99 % ms")
    device = d["provenance"]["device"]
    return f"One world on {device}, physics apart:\n\n" + markdown(
        Table("Controller", header, tuple(rows))
    )


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
                *(f"{times[what]:.2f}" for what in ("physics", "ticks", "with plans")),
                f"{plan_ms:.1f}",
                f"{d['lifted_percent']:.1f}",
                f"{sum(d['compile_s'].values()):.0f}",
            )
        )
    header = (
        "device", "worlds", "objects", "physics step ms", "physics alone", "with controllers",
        "and plans", "a plan ms", "lifted %", "compiling s",
    )  # fmt: skip
    return markdown(Table("Many grasps", header, tuple(rows))) if rows else NOTHING


_GRASP_COLUMNS = ("trials", "lifted and held %", "up after 9 s %", "lifted s", "force N")


def _grasp_cells(s: dict[str, Any]) -> tuple[str, ...]:
    return (
        str(s["trials"]),
        f"{s['success_percent']:.1f} ({s['ci95'][0]:.0f}–{s['ci95'][1]:.0f})",
        f"{100 * s['up_at_9s'] / s['trials']:.1f}",
        _number(s["lifted_s"]),
        _number(s["force_mean_n"]),
    )


def _failure_cells(s: dict[str, Any]) -> tuple[str, str]:
    return str(s["not_reached"]), str(s["never_lifted"] + s["slipped"] + s["not_held"])


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


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
        f"video and report. In {m['env_steps']:,} steps the return rose from "
        f"{m['return_first_tenth']:.0f} to {m['return_last_tenth']:.0f} and the share of lifted "
        f"objects in training from {m['success_first_tenth_percent']:.0f} to "
        f"{m['success_last_tenth_percent']:.0f} % (first and last tenth of the iterations)."
        + _before_and_after(d)
        + "".join(f" {sentence}" for sentence in headline(read_groups([path])))
    )


def _before_and_after(d: dict[str, Any]) -> str:
    """What the evaluation says that the training brought."""
    if "untrained_n" not in d:
        return ""
    count = {
        name: f"{sum(r['successes'] for r in rows)} of {sum(r['episodes'] for r in rows)}"
        for name, rows in (
            ("before", [r for r in d["rows"] if r["squeeze_force_n"] == d["untrained_n"]]),
            ("after", [r for r in d["rows"] if r["controller"] == "policy"]),
        )
    }
    return (
        f" In the evaluation {count['after']} objects are lifted, and {count['before']} before "
        f"training (by the command alone that the policy adds to, {d['untrained_n']:g} N)."
    )


def short_revision(made: dict[str, Any]) -> str:
    """A provenance's revision, short; that it had uncommitted changes is not left out."""
    revision = str(made.get("git", ""))
    return revision[:12] + "-dirty" * revision.endswith("-dirty")


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
    alone = {(device, r["worlds"]): r["steps_per_s"] for device, r in found if r["devices"] == 1}
    alone |= {
        (device, r["worlds"], r["git"]): r["steps_per_s"]
        for device, r in found
        if r["devices"] == 1
    }
    rows = []
    for device, r in sorted(found, key=lambda x: (x[1]["worlds"], x[1]["devices"])):
        speed, same = r["steps_per_s"], (device, r["worlds"])
        one = alone.get((*same, r["git"]), alone.get(same))
        compared = speed and one and r["devices"] > 1
        rows.append(
            (
                device,
                str(r["devices"]),
                {"processes": "one each", "donate": "one, donating"}.get(r["way"], "one"),
                f"{r['worlds']:,}",
                r["outcome"].split(":")[0],
                f"{r['env_steps'] / 1e6:.1f}",
                f"{speed:,.0f}" if speed else "",
                f"{speed / one:.2f}" if compared else "",
                "" if r["success_percent"] is None else f"{r['success_percent']:.1f}",
                "" if r["force_n"] is None else f"{r['force_n']:.1f}",
                str(r["seed"]),
            )
        )
    header = (
        "device", "GPUs", "processes", "worlds of each", "came to", "M steps", "control steps/s",
        "times one", "success %", "force N", "seed",
    )  # fmt: skip
    return markdown(Table("Several GPUs", header, tuple(rows), names=3)) if rows else NOTHING


def tuned(paths: Sequence[Path]) -> str:
    """Trainings that shared machines: how long each of them took, and all together."""
    rows = []
    for path in paths:
        d = read_json(path, "a results file")
        success = [r["trained_percent"] for r in d["rows"]]
        took, gpus = d.get("took_s"), d["settings"]["gpus"]
        rows.append(
            (
                d["provenance"]["device"],
                ", ".join(dict.fromkeys(r["setting"] for r in d["rows"])),
                str(len(success)),
                f"{d['settings']['cpus']:g}",
                f"{gpus:g}" if gpus else "",
                f"{statistics.median(r['seconds'] for r in d['rows']):.0f}",
                f"{took:.0f}" if took else "",
                f"{statistics.mean(success):.1f} ({min(success):.1f}–{max(success):.1f})",
            )
        )
    header = (
        "device", "setting", "seeds", "cores of each", "GPUs of each", "each s, median", "all s",
        "success %, least to most",
    )  # fmt: skip
    return markdown(Table("Many trainings", header, tuple(rows), names=2)) if rows else NOTHING
