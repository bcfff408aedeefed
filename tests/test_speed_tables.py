"""Tables of speed, from results files."""

import json

from generated import CODE, PROVENANCE, make_readme, values

from mjx_grasp.evaluation.results import Results, ThroughputRow, write_results
from mjx_grasp.robot.identity import FIRST_ROBOT


def test_throughput_is_sorted_by_worlds():
    rows = tuple(ThroughputRow("ppo", "mjx", w, 24, 30.0 * w, 1.5) for w in (8192, 1024))
    table = make_readme.closing_tables.throughput_table([Results(rows, PROVENANCE, {})])
    assert [r[4:] for r in table.rows] == [("1,024", "30,720", "1.5"), ("8,192", "245,760", "1.5")]
    assert {r[:2] for r in table.rows} == {("a card", CODE)}


def test_a_mesh_of_one_device_stands_beside_the_training_and_loops_have_their_times(tmp_path):
    rows = [ThroughputRow(loop, "mjx", 8, 1, 50.0, None) for loop in ("ppo", "ppo_sharded")]
    names = ("warp", "mjx", "task", "rollout", "ppo")
    ticks = dict(zip(names, (1.0, 2.0, 3.0, 4.0, 5.0), strict=True))
    detail = {"worlds": 8, "unroll": 4, "ratio_ppo_to_warp": 0.2, "ms_per_control_tick": ticks}
    detail |= {"warp_step_trace_ms": {"step": 6.0}}
    path = tmp_path / "loops.json"
    write_results(path, rows, PROVENANCE, FIRST_ROBOT, details=[detail])
    said = make_readme.closing_tables.throughput([path])
    assert f"| a card | {CODE} | ppo, MJX | 1 | 8 × 4 | 50 |" in said
    assert f"| a card | {CODE} | ppo over a mesh of one device, MJX | 1 | 8 × 4 | 50 |" in said
    assert "| 8 | 1.00 | 2.00 | 3.00 | 4.00 | 5.00 | 6.00 |" in said and "| 0.20 |" in said


def test_the_controllers_time_has_its_table(tmp_path):
    path, table = tmp_path / "grasper.json", make_readme.speed_tables.grasper_speed
    assert table([]) == make_readme.speed_tables.NOTHING
    tick = {"count": 500, "p50": 1.234, "p99": 2.5}
    of_phase = {"reaching": tick, "failed": tick | {"count": 0}}
    alone = dict.fromkeys(of_phase, tick | {"p50": 0.5, "p99": 0.75})
    record = {"tick_ms": of_phase, "tick_alone_ms": alone, "plan_ms": tick}
    path.write_text(json.dumps(record | {"provenance": PROVENANCE}))
    _, _, reaching, plans, *other = table([path, path]).splitlines()
    device = PROVENANCE["device"]
    assert values(reaching) == [device, "tick, reaching", "500", "1.23", "2.50", "0.50", "0.75"]
    assert values(plans) == [device, "search for plans", "500", "1", "2", "", ""]
    assert other == [reaching, plans]


def test_what_the_papers_parts_took_has_its_table(tmp_path):
    path, table = tmp_path / "times.json", make_readme.speed_tables.paper_times
    parts = [
        make_readme.speed_tables.Part("one", "the first", ("a", "b 64|8", "c TRIALS:8")),
        make_readme.speed_tables.Part("two", "not timed", ("d",)),
    ]
    assert table(path, parts) == make_readme.speed_tables.NOTHING
    commands = {
        "a": {"git": "f" * 40, "seconds": 90.0, "machine": "a GPU, 16 cores"},
        "c FEWER:8": {"git": "0" * 40, "seconds": 33.0, "machine": "a GPU, 16 cores"},
        "gone": {"git": "0" * 40, "seconds": 1.0, "machine": "another"},
    }
    both = f"{'f' * 12}, {'0' * 12}"
    path.write_text(json.dumps({"commands": commands}))
    _, _, row = table(path, parts).splitlines()
    assert values(row) == ["one", "2 of 3", "yes", "2.0", "a GPU, 16 cores", both]
    commands["b 8"] = commands.pop("c FEWER:8")
    path.write_text(json.dumps({"commands": commands}))
    assert values(table(path, parts).splitlines()[2])[2] == "yes"
    commands["c TRIALS:8"] = commands.pop("b 8")
    run = commands["a"] | {"parts": ["one", "two"], "quick": True}
    path.write_text(json.dumps({"commands": commands, "runs": [run]}))
    _, _, row, together = table(path, parts).splitlines()
    assert values(row)[2] == "" and values(row)[3] == "2.0"
    cells = ["2 parts together", "all", "yes", "1.5", "a GPU, 16 cores", "f" * 12]
    assert values(together) == cells


def test_many_grasps_at_once_have_their_table(tmp_path):
    path, table = tmp_path / "worlds.json", make_readme.speed_tables.grasper_worlds
    assert table([]) == make_readme.speed_tables.NOTHING
    times = {"physics": 1.234, "ticks": 0.9, "with plans": 0.8}
    record = {
        "worlds": 4096, "objects": ["a", "b"], "physics_dt": 0.005, "plan_s": 40.96,
        "times_real_time": times, "lifted_percent": 99.0, "compile_s": {"a": 20.0, "b": 1.0},
        "solver_iterations": 6,
    }  # fmt: skip
    path.write_text(json.dumps(record | {"provenance": PROVENANCE}))
    _, _, row = table([path]).splitlines()
    assert values(row)[1:] == ["4,096", "2", "5", "6", "1.23", "0.90", "0.80", "10.0", "99.0", "21"]


def test_several_gpus_are_compared_with_one_that_has_as_many_worlds(tmp_path):
    table = make_readme.speed_tables.devices
    assert table([]) == make_readme.speed_tables.NOTHING
    row = {
        "worlds": 4096,
        "outcome": "finished",
        "env_steps": 2_500_000,
        "success_percent": 84.56,
        "force_n": 2.04,
        "seconds": 70.4,
        "first_iteration_s": 20.6,
    }
    rows = [
        row | {"devices": 2, "way": "donate", "steps_per_s": 190_000.0},
        row | {"devices": 1, "way": "sharded", "steps_per_s": 100_000.0},
        row
        | dict.fromkeys(("first_iteration_s", "steps_per_s", "success_percent", "force_n"))
        | {"devices": 2, "way": "processes", "outcome": "failed (-11): and why", "env_steps": 0},
        row | {"devices": 2, "worlds": 8192, "way": "sharded", "steps_per_s": 1e6},
    ]  # fmt: skip
    path = tmp_path / "devices.json"
    made = {"settings": {"seed": 3}, "rows": rows, "provenance": PROVENANCE}
    path.write_text(json.dumps(made))
    one, donating, processes, more = map(values, table([path]).splitlines()[2:])
    assert one[1:7] == ["1", "one", "4,096", "finished", "2.5", "70"]
    assert one[7:] == ["21", "100,000", "", "84.6", "2.0", "3"]
    assert donating[1:3] == ["2", "one, donating"] and donating[8:10] == ["190,000", "1.90"]
    failed = ["one each", "4,096", "failed (-11)", "0.0", "70", "", "", "", "", "", "3"]
    assert processes[2:] == failed
    assert more[8:10] == ["1,000,000", ""]


def test_several_gpus_are_compared_with_one_of_their_own_revision(tmp_path):
    row = {
        "worlds": 64, "outcome": "finished", "env_steps": 0, "way": "sharded",
        "success_percent": None, "force_n": None, "seconds": 9.0, "first_iteration_s": None,
    }  # fmt: skip

    def written(name, git, **speeds):
        rows = [row | {"devices": int(n[1:]), "steps_per_s": s} for n, s in speeds.items()]
        record = {"settings": {"seed": 0}, "rows": rows, "provenance": PROVENANCE | {"git": git}}
        path = tmp_path / f"{name}.json"
        path.write_text(json.dumps(record))
        return path

    paths = [
        written("a", "old", x1=100.0, x2=150.0),
        written("b", "new", x1=200.0, x2=380.0),
        written("c", "other", x4=400.0),
    ]
    lines = make_readme.speed_tables.devices(paths).splitlines()[2:]
    times = {values(line)[8]: values(line)[9] for line in lines}
    assert times == {"100": "", "200": "", "150": "1.50", "380": "1.90", "400": "2.00"}


def test_seeds_in_step_are_compared_with_one_alone(tmp_path):
    rows = [
        {"seeds": n, "worlds": 1024, "unroll": 64, "compile_s": 14.2, "iteration_s": s,
         "steps_per_s": n * 65_536 / s}
        for n, s in ((1, 0.8), (8, 2.0))
    ]  # fmt: skip
    path = tmp_path / "seeds_x.json"
    path.write_text(json.dumps({"rows": rows, "physics_dt": 0.002, "provenance": PROVENANCE}))
    one, eight = map(values, make_readme.speed_tables.together([path]).splitlines()[2:])
    assert one[1:] == ["1", "1,024 × 64", "2", "14", "0.80", "81,920", "1.0"]
    assert eight[1:] == ["8", "1,024 × 64", "2", "14", "2.00", "262,144", "3.2"]
    assert make_readme.speed_tables.together([]) == make_readme.speed_tables.NOTHING


def test_trainings_side_by_side_say_what_each_took_and_all(tmp_path):
    rows = [
        {"setting": "cpu", "trained_percent": p, "seconds": s}
        for p, s in ((80.0, 10.0), (90.0, 30.0), (85.0, 20.0))
    ]
    record = {
        "settings": {"gpus": None, "cpus": 1.0}, "rows": rows,
        "took_s": 41.6, "provenance": PROVENANCE,
    }  # fmt: skip
    path = tmp_path / "tune.json"
    path.write_text(json.dumps(record))
    _, _, row = make_readme.speed_tables.tuned([path]).splitlines()
    assert values(row)[1:] == ["cpu", "3", "1", "", "20", "42", "", "85.0 (80.0–90.0)"]
    alone = {
        "worlds": 512, "iterations": 9, "devices": 1, "outcome": "finished", "seconds": 25.0
    }  # fmt: skip
    others = ({"worlds": 256}, {"outcome": "hung"}, {"devices": 2}, {"iterations": 8})
    rows = [alone, *(alone | other | {"seconds": 1.0} for other in others)]
    devices = tmp_path / "devices.json"
    devices.write_text(json.dumps({"rows": rows, "provenance": PROVENANCE}))
    plan = {"flags": {"ppo.worlds": 512, "ppo.iterations": 9}}
    path.write_text(json.dumps(record | {"plan": plan}))
    _, _, row = make_readme.speed_tables.tuned([path], [devices]).splitlines()
    assert values(row)[1] == "cpu, 512 worlds × 9" and values(row)[6:8] == ["42", "75"]
