"""`experiments/paper.py`: parts by name, what counts as done, and what its commands are."""

import json
import re
import shlex
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import tyro
from loaded import script
from rich.console import Console

from mjx_grasp.errors import FileError, InputError, MjxGraspError
from mjx_grasp.evaluation.grasps.blocks import blocks_of
from mjx_grasp.evaluation.grasps.config import ScenariosConfig
from mjx_grasp.evaluation.reach.poses import SweepConfig
from mjx_grasp.handoff.config import HandoffConfig
from mjx_grasp.records.spread import Spread
from mjx_grasp.training.command_line import parse
from mjx_grasp.training.plan import read_plan
from mjx_grasp.training.tuning import TuneConfig

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def plain(monkeypatch):
    """The runner as it is."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    return script("paper")


def test_every_command_is_of_this_repository_and_no_two_write_the_same_file(plain):
    commands = [shlex.split(c) for c in {c for part in plain.PARTS for c in part.commands}]
    made = [words[words.index("--out") + 1] for words in commands if "--out" in words]
    assert len(set(made)) == len(made) > 20
    for words in commands:
        module = words[0] == "-m"
        file = ROOT / (f"{words[1].replace('.', '/')}.py" if module else words[0])
        assert file.is_file(), file


def test_every_command_is_one_that_its_own_parser_takes(plain, monkeypatch):
    monkeypatch.setattr(plain, "has_gpu", lambda: True)
    monkeypatch.setattr("mjx_grasp.training.config.has_gpu", lambda: True)

    def planned(args):
        config = tyro.cli(TuneConfig, args=args)
        for run in read_plan(ROOT / config.plan, config.flags):
            parse(list(run.flags))

    parsers = {
        "mjx_grasp.tune": planned,
        "mjx_grasp.train": lambda args: parse(args),
        "mjx_grasp.handoffs": partial(tyro.cli, HandoffConfig),
        "mjx_grasp.scenarios": partial(tyro.cli, ScenariosConfig),
        "mjx_grasp.sweep_reach": partial(tyro.cli, SweepConfig),
    }
    for command in dict.fromkeys(c for part in plain.PARTS for c in part.commands):
        words = plain.worded(command, ROOT / "some scans")
        kind, *args = words[1:] if words[0] == "-m" else words
        if kind.startswith("experiments/"):
            ends = re.search(r"tyro\.cli\((?:script\.)?(\w+)", (ROOT / kind).read_text())
            tyro.cli(getattr(script(Path(kind).stem), ends[1]), args=args)
        else:
            parsers[kind](args=args)


def test_trainings_that_are_made_again_take_the_place_of_their_rows(plain):
    collects = [c for part in plain.PARTS for c in part.commands if "collect_runs" in c]
    assert len(collects) == 3 and all("--replace" in command for command in collects)


def test_done_is_what_this_revision_made_of_these_scans_and_is_still_there(
    plain, tmp_path, monkeypatch
):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "a.obj").write_text("v 0 0 0")
    monkeypatch.setattr(plain, "ROOT", tmp_path)
    monkeypatch.setattr(plain, "git_revision", lambda: "abc")
    monkeypatch.setattr(plain, "is_committed", lambda git: git == "abc")
    command, scans = "experiments/x.py --out results/x.json", tmp_path / "scans"
    entry = {"git": "abc", "scans": plain.digest_of(scans), "seconds": 1.0}
    assert not plain.done({command: entry}, command, scans), "nothing was made"
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "x.json").write_text("{}")
    assert plain.done({command: entry}, command, scans)
    assert not plain.done({}, command, scans)
    assert not plain.done({command: entry | {"git": "abd"}}, command, scans)
    (scans / "a.obj").write_text("v 0 0 0 # more")
    assert not plain.done({command: entry}, command, scans)
    figure = "experiments/figure.py"
    assert plain.done({figure: entry | {"scans": plain.digest_of(scans)}}, figure, scans)


@pytest.fixture
def paper(tmp_path, monkeypatch):
    """The runner with three quick commands, of which one fails until it is let through."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    module = script("paper")
    passes, ran = tmp_path / "passes", tmp_path / "ran"
    note = f"-c \"open('{ran}', 'a').write"
    parts = (
        module.Part("one", "the first", (f"{note}('1')\"", f"{note}('2')\"")),
        module.Part("two", "fails", (f"-c \"assert __import__('os').path.exists('{passes}')\"",)),
        module.Part("gpu", "long", (f"{note}('g')\"",), without_gpu="it takes days"),
    )
    monkeypatch.setattr(module, "PARTS", parts)
    monkeypatch.setattr(module, "LAST", f"{note}('L')\"")
    monkeypatch.setattr(module, "has_gpu", lambda: False)
    monkeypatch.setattr(module, "git_revision", lambda: "abc")
    return SimpleNamespace(module=module, passes=passes, ran=ran)


def test_the_paper_is_made_part_by_part_and_goes_on_where_it_stopped(paper, tmp_path, capsys):
    module, scans = paper.module, tmp_path / "scans"
    scans.mkdir()
    config = module.PaperConfig(objects_dir=scans, state=tmp_path / "state.json")
    with pytest.raises(MjxGraspError, match=r"ended with 1\n1 of 3 .* goes on there"):
        module.main(config)
    assert paper.ran.read_text() == "12"
    assert "gpu needs a GPU: it takes days" in capsys.readouterr().err
    paper.passes.touch()
    module.main(config)
    assert paper.ran.read_text() == "12L"
    module.main(replace(config, parts=("one",)))
    assert paper.ran.read_text() == "12LL"
    module.git_revision = lambda: "another"
    module.main(replace(config, parts=("one",)))
    assert paper.ran.read_text() == "12LL12L"
    assert "0 min left" in capsys.readouterr().err


_NOTED = {"git": "abc", "seconds": 1.0, "machine": "here"}


@pytest.mark.parametrize(
    "kept",
    [
        {"commands": [_NOTED]},
        {"commands": {"a.py": "done"}},
        {"commands": {"a.py": {"git": "abc"}}},
        {"runs": {"a": _NOTED}},
        {"runs": [7]},
    ],
)
def test_a_damaged_state_of_the_paper_is_refused(plain, tmp_path, kept):
    path = tmp_path / "state.json"
    path.write_text(json.dumps({"schema": plain.SCHEMA} | kept))
    with pytest.raises(FileError, match=r"state\.json: found commands or runs of another kind"):
        plain.Kept(path)
    whole = {"commands": {"a.py": _NOTED}, "runs": [_NOTED | {"parts": []}]}
    path.write_text(json.dumps({"schema": plain.SCHEMA} | whole))
    assert plain.Kept(path).commands == whole["commands"]


@pytest.mark.parametrize("what", ["scans", "uncommitted"])
def test_what_the_paper_has_done_is_of_these_scans_and_all_of_the_code(paper, tmp_path, what):
    module, scans = paper.module, tmp_path / "scans"
    scans.mkdir()
    config = module.PaperConfig(parts=("one",), objects_dir=scans, state=tmp_path / "state.json")
    if what == "uncommitted":
        module.git_revision = lambda: "abc-dirty"
    module.main(config)
    if what == "scans":
        (scans / "new.stl").touch()
    module.main(config)
    assert paper.ran.read_text() == "12L12L"


def test_a_command_that_two_parts_of_the_paper_share_runs_once(paper, tmp_path, monkeypatch):
    module = paper.module
    one, *others = module.PARTS
    monkeypatch.setattr(module, "PARTS", (one, replace(one, name="too"), *others))
    chosen = ("one", "too")
    module.main(module.PaperConfig(chosen, objects_dir=tmp_path, state=tmp_path / "s" / "n.json"))
    assert paper.ran.read_text() == "12L"


def test_the_folder_that_commands_of_the_paper_write_to_is_there(paper, tmp_path, monkeypatch):
    module = paper.module
    monkeypatch.setattr(module, "ROOT", tmp_path)
    write = f"-c \"open('{module.FOLDER}/handoffs.npz', 'w')\""
    monkeypatch.setattr(module, "PARTS", (module.Part("one", "writes", (write,)),))
    module.main(module.PaperConfig(objects_dir=tmp_path, state=tmp_path / "state.json"))
    assert (tmp_path / "runs" / "paper" / "handoffs.npz").exists()


@pytest.mark.parametrize(
    ("gpu", "word", "processes", "platforms"),
    [
        (False, "CORES", 10, "cpu"),
        (True, "CORES", 8, "cpu"),
        (False, "SHARERS", 10, None),
        (True, "SHARERS", 5, None),
        (False, "GRASPS", 10, None),
        (True, "GRASPS", 2, None),
        (True, "SCANS", ".", None),
    ],
)
def test_processes_of_the_paper_share_cores_or_a_gpu(
    paper, tmp_path, monkeypatch, gpu, word, processes, platforms
):
    module, began = paper.module, []
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "has_gpu", lambda: gpu)
    monkeypatch.setattr(module, "usable_cores", lambda: 10)
    for name in ("JAX_PLATFORMS", "XLA_PYTHON_CLIENT_PREALLOCATE"):
        monkeypatch.delenv(name, raising=False)

    def run(words, cwd, env, check, stdout, stderr):
        began.append((words[-1], env))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(module.subprocess, "run", run)
    asked = word if word == "GRASPS" else f"--processes {word}"
    module._run(f"x.py {asked}", tmp_path, Console(quiet=True))
    ((last, env),) = began
    assert last == str(processes)
    assert env.get("JAX_PLATFORMS") == platforms
    assert env["XLA_PYTHON_CLIENT_PREALLOCATE"] == "false"


def test_xla_tries_kernels_out_for_trainings_alone_or_if_asked(paper, monkeypatch):
    """Without a GPU nothing is added: what JAX has compiled it knows by these flags."""
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_autotune_level=4")
    added = paper.module._more_environment
    monkeypatch.setattr(paper.module, "has_gpu", lambda: False)
    assert added("experiments/pose_error.py TRIALS:5") == {}
    monkeypatch.setattr(paper.module, "has_gpu", lambda: True)
    flags = "--xla_gpu_autotune_level=0 --xla_gpu_autotune_level=4"
    assert added("experiments/pose_error.py TRIALS:5") == {"XLA_FLAGS": flags}
    for trains in ("-m mjx_grasp.train --preset paper", "-m mjx_grasp.tune plan.yaml"):
        assert added(trains) == {}


def test_a_gpu_makes_as_many_trials_as_published_and_cores_as_many_as_they_can(
    paper, tmp_path, monkeypatch
):
    module = paper.module
    monkeypatch.setattr(module, "usable_cores", lambda: 10)
    for gpu, words in (
        (True, "--engine mjx --episodes 448"),
        (False, "--episodes 56 --processes 10"),
    ):
        monkeypatch.setattr(module, "has_gpu", lambda gpu=gpu: gpu)
        found = module.worded("x.py TRIALS:56 --out y", tmp_path)
        assert found == ["x.py", *words.split(), "--out", "y"]


def test_words_within_a_word_are_told_too(paper, tmp_path, monkeypatch):
    monkeypatch.setattr(paper.module, "has_gpu", lambda: False)
    scans = paper.module.ROOT / "scans"
    *_, last = paper.module.worded("-m x --flags '--objects-dir SCANS --seed 1'", scans)
    assert last == "--objects-dir scans --seed 1"
    spaced = paper.module.ROOT / "my scans"
    *_, last = paper.module.worded("-m x --flags '--objects-dir SCANS --seed 1'", spaced)
    assert shlex.split(last) == ["--objects-dir", "my scans", "--seed", "1"]


def test_trainings_of_a_plan_wait_for_the_states_that_it_names_and_have_the_gpu(paper, monkeypatch):
    module = paper.module
    (part,) = [one for one in script("paper_parts").PARTS if one.name == "paper-ablation"]
    monkeypatch.setattr(module, "has_gpu", lambda: True)
    steps = module.steps_of([part], lambda command: True, module.lane_of)
    states, near, judges, tune, judged = steps
    assert tune.after == {states.command, near.command} and tune.lane == states.lane == "the GPU"
    assert judged.after == {judges.command, tune.command}
    assert part.not_quick and part.if_named


FULL = "b.py TRIALS:8 --in 64|16 --out README.md"
FEWER = "b.py FEWER:8 --in 16 --out README.md"
"""A command that needs none before it; its file is there."""


@pytest.fixture
def quick(paper, tmp_path, monkeypatch):
    """The runner on a GPU with commands that only note that they ran, or fail."""
    module, ran, failing = paper.module, [], set()

    def run(command, *_):
        ran.append(command)
        if command in failing:
            raise MjxGraspError("broken")

    monkeypatch.setattr(module, "_run", run)
    monkeypatch.setattr(module, "is_committed", lambda git: True)
    monkeypatch.setattr(module, "has_gpu", lambda: True)
    parts = (
        module.Part("one", "-", ("a.py", FULL, "figure.py")),
        module.Part("two", "-", ("c.py",), not_quick="it trains"),
        module.Part("three", "-", ("d.py",), if_named="days"),
    )
    monkeypatch.setattr(module, "PARTS", parts)
    scans = tmp_path / "scans"
    scans.mkdir()
    config = module.PaperConfig(quick=True, objects_dir=scans, state=tmp_path / "state.json")

    def made(**changes):
        ran.clear()
        module.main(replace(config, **changes))
        return sorted(command for command in ran if command != module.LAST)

    return SimpleNamespace(module=module, config=config, made=made, failing=failing, ran=ran)


def test_a_quick_paper_makes_fewer_trials_and_leaves_out_what_takes_long(quick, tmp_path, capsys):
    assert quick.made() == ["a.py", FEWER, "figure.py"]
    assert "two is not made quickly: it trains" in capsys.readouterr().err
    assert quick.made() == []
    for command, words in (
        (FEWER, "--engine mjx --episodes 64 --in 16 --out README.md"),
        (FULL, "--engine mjx --episodes 448 --in 64 --out README.md"),
    ):
        assert quick.module.worded(command, tmp_path) == ["b.py", *words.split()]
    with pytest.raises(InputError, match=r"parts: found .*two.*, expected some that can be made"):
        quick.made(parts=("two",))


def test_a_paper_is_made_in_full_after_a_quick_look_and_stays_so(quick):
    quick.made()
    assert quick.made(quick=False) == [FULL, "c.py", "figure.py"], "of other trials: drawn again"
    assert quick.made() == [], "a quick look takes nothing away"
    assert quick.made(quick=False) == []
    assert quick.made(quick=False, parts=("three",)) == ["d.py"]


@pytest.mark.parametrize("fails", [FEWER, "figure.py"])
def test_what_a_broken_quick_look_may_have_written_is_made_again_in_full(quick, fails):
    module = quick.module
    quick.made(quick=False)
    module.git_revision = lambda: "another"
    quick.failing.add(fails)
    with pytest.raises(MjxGraspError):
        quick.made()
    module.git_revision = lambda: "abc"
    quick.failing.clear()
    assert quick.made(quick=False) == ["a.py", FULL, "figure.py"]


def test_what_all_parts_took_together_is_kept_once_and_only_of_whole_runs(quick):
    def runs():
        kept = json.loads(quick.config.state.read_text())["runs"]
        return [(run["parts"], run["quick"]) for run in kept]

    quick.made(quick=False, parts=("one",))
    assert runs() == [], "of one part its commands tell"
    quick.made(quick=False)
    assert runs() == [], "some was done before"
    for git in ("another", "a third"):
        quick.module.git_revision = lambda git=git: git
        quick.made(quick=False)
        assert runs() == [(["one", "two"], False)]
    assert quick.module.Kept(quick.config.state).runs[0]["git"] == "a third"


def test_a_quick_look_leaves_in_full_what_reads_what_it_makes(quick, monkeypatch):
    """Its states are gone, say, and made anew; a figure without a quick form is drawn again."""
    results = "e.py --in runs/r.npz TRIALS:16 --out README.md"
    part = quick.module.Part(
        "one", "-", ("s.py 64|16 --out runs/r.npz", results, "figure.py", "x_figure.py")
    )
    monkeypatch.setattr(quick.module, "PARTS", (part,))
    monkeypatch.setattr(quick.module, "made_by", lambda command: quick.config.objects_dir)
    quick.made(quick=False)
    gone = quick.config.objects_dir / "none"
    made_by = {"s.py": gone}
    monkeypatch.setattr(
        quick.module, "made_by", lambda c: made_by.get(c.split()[0], quick.config.objects_dir)
    )
    assert quick.made() == ["figure.py", "s.py 16 --out runs/r.npz", "x_figure.py"]


def test_a_quick_look_needs_a_gpu(quick, monkeypatch):
    monkeypatch.setattr(quick.module, "has_gpu", lambda: False)
    with pytest.raises(InputError, match="--quick: found 'no GPU', expected a GPU"):
        quick.made()


def test_a_quick_look_trains_nothing_and_reads_no_training(plain):
    parts = [part for part in plain.PARTS if not part.not_quick]
    commands = [command for part in parts for command in part.commands]
    assert len(parts) > 8 and not any("mjx_grasp.train" in command for command in commands)
    assert not any("policy.npz" in command for command in commands)
    fewer = [plain.fewer(command) for command in commands]
    assert any("TRIALS:" in command or "|" in command for command in commands)
    assert not any(word in c for c in fewer for word in ("TRIALS:", "|", "GRASPS", "SHARERS"))
    assert [plain.fewer(command) for command in fewer] == fewer


def test_a_quick_look_makes_the_trials_that_others_are_compared_with(plain):
    """Or the first of them: tables of both engines refuse others, and would stop the last step."""
    words = [shlex.split(plain.fewer(c)) for part in plain.PARTS for c in part.commands]
    episodes = {
        made[made.index("--out") + 1]: made[made.index("--episodes") + 1]
        for made in words
        if "--out" in made and "--episodes" in made
    }
    results = "experiments/results"
    eight, in_mjx = (f"{results}/{name}.json" for name in ("eight_native", "engines/eight"))
    assert episodes[eight] == episodes[in_mjx]
    few, many = (f"{results}/{name}.json" for name in ("scenarios", "engines/scenarios"))
    runs = [blocks_of(int(episodes[name]), objects=8, seed=9) for name in (few, many)]
    assert 0 < len(runs[0]) < len(runs[1]) and runs[1][: len(runs[0])] == runs[0]


def test_whole_grasps_are_made_in_mjx_on_a_gpu(paper, tmp_path, monkeypatch):
    module = paper.module
    monkeypatch.setattr(module, "usable_cores", lambda: 16)
    for gpu, words in ((True, "--engine mjx --processes 4"), (False, "--processes 16")):
        monkeypatch.setattr(module, "has_gpu", lambda gpu=gpu: gpu)
        found = module.worded("x.py GRASPS --out y", tmp_path)
        assert found == ["x.py", *words.split(), "--out", "y"]


@pytest.mark.parametrize("broken", [False, True])
def test_with_a_gpu_lanes_run_beside_each_other_and_nothing_runs_before_what_it_needs(
    paper, tmp_path, monkeypatch, capsys, broken
):
    """Two commands of different lanes, each of which ends once the other has begun."""
    module, folder = paper.module, tmp_path / "met"
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "has_gpu", lambda: True)
    monkeypatch.setattr(module, "LAST", "-c pass")
    folder.mkdir()
    meet = (
        "import pathlib, sys, time\n"
        f"a, b = (pathlib.Path({str(folder)!r}) / x for x in sys.argv[1:3])\n"
        "a.touch(); print('hello', b)\n"
        "end = time.monotonic() + 30\n"
        "while not b.exists() and time.monotonic() < end: time.sleep(0.01)\n"
        "sys.exit(not b.exists())"
    )
    (tmp_path / "meet.py").write_text(meet)
    (tmp_path / "see.py").write_text(
        f"import pathlib, sys\nsys.exit({broken} or not pathlib.Path(sys.argv[1]).exists())"
    )
    parts = (
        module.Part("one", "-", ("meet.py gpu cores GRASPS --out gpu.json",)),
        module.Part("two", "-", ("meet.py cores gpu CORES --out cores.json",
                                 f"see.py {folder / 'cores'} TRIALS:1 --in cores.json --out y",
                                 f"see.py {folder / 'gpu'}")),
    )  # fmt: skip
    monkeypatch.setattr(module, "PARTS", parts)
    config = module.PaperConfig(objects_dir=tmp_path, state=tmp_path / "state.json")
    if broken:
        with pytest.raises(MjxGraspError, match=r"see\.py.* ended with 1; \S+-two\.log has what"):
            module.main(config)
        kept = json.loads(config.state.read_text())["commands"]
        assert {command.split()[1] for command in kept} == {"gpu", "cores"}
        return
    module.main(config)
    assert len(json.loads(config.state.read_text())["commands"]) == 4
    assert "hello" not in capsys.readouterr().err
    first, *others = sorted((tmp_path / module.FOLDER / "logs").iterdir())
    assert first.name == "001-one.log" and len(others) == 3
    assert first.read_text() == f"hello {folder / 'cores'}\n"


def test_a_command_waits_for_those_whose_files_it_names_and_a_figure_for_all(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    lanes = script("paper_lanes")
    part = lanes.Part("p", "-", ("a.py --out r/a.json", "b.py --out r/b.json",
                                 "c.py --known r/a.json --out r/c.json", "figure.py"))  # fmt: skip
    left = {"b.py --out r/b.json", *part.commands[2:]}
    steps = lanes.steps_of([part, part], left.__contains__, lambda command: command[0])
    assert [(step.command[0], step.lane, len(step.after)) for step in steps] == [
        ("b", "b", 0),
        ("c", "c", 0),  # what it names is done
        ("f", "f", 2),
    ]
    steps = lanes.steps_of([part], lambda command: True, lambda command: "one")
    assert [len(step.after) for step in steps] == [0, 0, 1, 3]
    ran = []
    assert lanes.in_lanes(steps, lambda step: ran.append(step) or True) == []
    assert ran == steps


def test_nothing_waits_for_a_figure(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    lanes = script("paper_lanes")
    part = lanes.Part("p", "-", ("a_figure.py", "numbers.py", "b_figure.py"))
    steps = lanes.steps_of([part], lambda command: True, lambda command: "one")
    assert [sorted(step.after) for step in steps] == [[], [], ["numbers.py"]]


@pytest.mark.parametrize("lane", [lambda command: "one", lambda command: command[0]])
def test_what_fails_takes_with_it_what_needs_it_and_nothing_else(monkeypatch, lane):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    lanes, ran = script("paper_lanes"), []
    made = ("a.py --out r/a", "b.py r/a --out r/b", "c.py r/b --out r/c", "d.py --out r/d")
    others = ("e.py r/d --out r/e",)
    parts = [lanes.Part("p", "-", (*made, *others)), lanes.Part("q", "-", ("figure.py",))]
    steps = lanes.steps_of(parts, lambda command: True, lane)
    lost = lanes.in_lanes(steps, lambda step: ran.append(step.command[0]) or step.command[0] != "a")
    assert sorted(step.command[0] for step in lost) == ["a", "b", "c"]
    assert sorted(ran) == ["a", "d", "e", "f"]


@pytest.mark.parametrize("interrupted", [False, True])
def test_lanes_take_what_is_ready_first_and_begin_nothing_after_an_error(monkeypatch, interrupted):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    lanes, slow, ran = script("paper_lanes"), threading.Event(), []
    steps = [
        lanes.Step("slow", "p", "GPU", frozenset()),
        lanes.Step("figure", "p", "cores", frozenset({"slow"})),
        lanes.Step("quick", "q", "cores", frozenset()),
        lanes.Step("last", "q", "GPU", frozenset()),
    ]

    def run(step):
        ran.append(step.command)
        if step.command == "slow":
            assert slow.wait(10)
            if interrupted:
                raise KeyboardInterrupt
        if step.command == "quick":
            slow.set()
        return True

    if interrupted:
        with pytest.raises(KeyboardInterrupt):
            lanes.in_lanes(steps, run)
        assert sorted(ran) == ["quick", "slow"]
    else:
        lanes.in_lanes(steps, run)
        assert sorted(ran[:2]) == ["quick", "slow"] and sorted(ran[2:]) == ["figure", "last"]


def test_every_command_of_the_paper_has_a_lane_and_needs_none_after_it(plain, monkeypatch):
    monkeypatch.setattr(plain, "has_gpu", lambda: True)
    steps = plain.steps_of(plain.PARTS, lambda command: True, plain.lane_of)
    assert {step.lane for step in steps} == {"the GPU", "CORES", "one process"}
    seen = set()
    for step in steps:
        assert step.after <= seen, step
        seen.add(step.command)
    monkeypatch.setattr(plain, "has_gpu", lambda: False)
    assert {plain.lane_of(step.command) for step in steps} == {"CORES"}


def test_a_training_that_was_stopped_goes_on_and_one_of_other_code_is_put_aside(
    paper, tmp_path, monkeypatch
):
    module = paper.module
    monkeypatch.setattr(module, "ROOT", tmp_path)
    words = ["-m", "mjx_grasp.train", "--preset", "paper", "--out", "runs/paper/seed0"]
    folder = tmp_path / "runs" / "paper" / "seed0"
    assert module.going_on(words) == words
    folder.mkdir(parents=True)
    assert module.going_on(words) == words, "nothing was begun in it"
    (folder / "config.json").write_text("{}")
    begun = folder / "provenance.json"
    made = {"git": "abc", "command": f"python {' '.join(words)}"}
    begun.write_text(json.dumps(made))
    assert module.going_on(words) == ["-m", "mjx_grasp.train", "--resume", "runs/paper/seed0"]
    other = ["experiments/x.py", "--out", "runs/paper/seed0"]
    assert module.going_on(other) == other

    others = (
        json.dumps(made | {"git": "abd"}),
        json.dumps(made | {"git": "abc-dirty"}),
        json.dumps(made | {"command": "python -m mjx_grasp.train"}),
        None,  # killed before it said anything
    )
    for k, other in enumerate(others, start=1):
        folder.mkdir(exist_ok=True)
        (folder / "config.json").write_text(f"{k}")
        begun.unlink(missing_ok=True)
        if other is not None:
            begun.write_text(other)
        assert module.going_on(words) == words and not folder.exists()
        kept = folder.with_name(f"seed0.before-{k}") / "config.json"
        assert kept.read_text() == f"{k}", "nothing is lost"


def test_the_papers_parts_are_listed_and_unknown_ones_refused(paper, tmp_path, capsys):
    module = paper.module
    config = module.PaperConfig(list=True, state=tmp_path / "state.json")
    module.main(config)
    assert "0 of 2" in capsys.readouterr().out
    with pytest.raises(InputError, match="parts: found 'three', expected some of one, two, gpu"):
        module.main(replace(config, parts=("three",)))
    with pytest.raises(InputError, match="--objects-dir: found 'nothing'"):
        module.main(replace(config, list=False))


def test_commands_of_the_paper_that_use_all_cores_can_share_their_work(plain, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "experiments")
    for command in (command for part in plain.PARTS for command in part.commands):
        first, *_ = command.split()
        if "--processes" in command and first.endswith(".py"):
            found = vars(script(Path(first).stem)).values()
            own = [c for c in found if isinstance(c, type) and c.__module__ == Path(first).stem]
            assert any(issubclass(c, Spread) for c in own), command
