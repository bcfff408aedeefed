import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from mjx_grasp.cli import run_command
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records import provenance as module


def git(folder, *args):
    subprocess.run(
        ["git", "-C", str(folder), "-c", "user.name=t", "-c", "user.email=t@example.org", *args],
        check=True,
        capture_output=True,
    )


def test_block_has_all_that_a_result_needs_and_is_json():
    block = json.loads(json.dumps(module.provenance(7, command="python -m x")))
    assert set(block) == {"command", "git", "versions", "device", "seed"}
    assert block["seed"] == 7 and block["command"] == "python -m x"
    assert {"python", "jax", "mujoco", "brax", "numpy"} <= set(block["versions"])
    import jax

    assert block["versions"]["jax"] == jax.__version__


def test_revision_tells_a_clean_checkout_from_a_changed_one(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_root", lambda: tmp_path)
    git(tmp_path, "init", "-q")
    (tmp_path / "a").write_text("1")
    (tmp_path / "README.md").write_text("no tables yet")
    git(tmp_path, "add", "a", "README.md")
    git(tmp_path, "commit", "-qm", "first")
    clean = module.git_revision()
    assert len(clean) == 40 and module.is_committed(clean)
    (tmp_path / "experiments" / "results").mkdir(parents=True)
    (tmp_path / "experiments" / "results" / "five.json").write_text("{}")
    (tmp_path / "handoffs.npz").write_text("what a command wrote into the repository")
    (tmp_path / "README.md").write_text("tables of results")
    assert module.git_revision() == clean
    for new in ("own.py", "mjx_grasp/own.yaml", "assets/own.npz", "experiments/own.py"):
        path = tmp_path / new
        path.parent.mkdir(exist_ok=True)
        path.write_text("")
        assert module.git_revision() == clean + "-dirty", new
        path.unlink()
    (tmp_path / "a").write_text("2")
    assert module.git_revision() == clean + "-dirty"
    assert not module.is_committed(clean + "-dirty")


def test_revision_outside_a_checkout_is_the_stamp_or_unknown(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_root", lambda: tmp_path)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    found = module.git_revision()
    assert found.startswith("unknown-") and module.git_revision() == found
    (tmp_path / "mjx_grasp").mkdir()
    (tmp_path / "mjx_grasp" / "own.py").write_text("x = 1")
    assert module.git_revision() not in (found, "unknown-")
    (tmp_path / "REVISION").write_text("abc123\n")
    assert module.git_revision() == "abc123"


def test_a_repository_that_it_is_installed_in_does_not_say_the_revision(tmp_path, monkeypatch):
    git(tmp_path, "init", "-q")
    (tmp_path / "theirs.py").write_text("")
    git(tmp_path, "add", "theirs.py")
    git(tmp_path, "commit", "-qm", "somebody else's")
    packages = tmp_path / ".venv" / "site-packages"
    packages.mkdir(parents=True)
    monkeypatch.setattr(module, "_root", lambda: packages)
    assert module.git_revision().startswith("unknown-")
    monkeypatch.setattr(module, "_root", lambda: tmp_path)
    assert module.is_committed(module.git_revision())


def test_an_older_repository_in_a_copy_does_not_say_the_revision(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_root", lambda: tmp_path)

    def git(*arguments):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        done = subprocess.run(
            ["git", *who, "-C", str(tmp_path), *arguments], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    git("init", "--quiet")
    (tmp_path / ".gitignore").write_text("REVISION\n")
    git("add", ".")
    git("commit", "--quiet", "-m", "first")
    head = git("rev-parse", "HEAD")
    assert module.git_revision() == head
    # A stamp of a commit that the repository knows may be old: the repository says what is there.
    (tmp_path / "REVISION").write_text(f"{head}\n")
    (tmp_path / "more.py").write_text("")
    assert module.git_revision() == f"{head}-dirty"
    # Sources of a commit that it does not know have come with the stamp.
    (tmp_path / "REVISION").write_text("d32a703b909a42e9ead4fd6173be3e968671fd0f\n")
    assert module.git_revision() == "d32a703b909a42e9ead4fd6173be3e968671fd0f"


@pytest.mark.parametrize("name", ["mjx_grasp.train", "mjx_grasp.train.__main__"])
def test_command_is_what_a_user_would_type(monkeypatch, name):
    main = SimpleNamespace(__spec__=SimpleNamespace(name=name))
    monkeypatch.setitem(sys.modules, "__main__", main)
    monkeypatch.setattr(sys, "argv", ["/somewhere/train.py", "--out", "my run", "--seed", "1"])
    assert module.command_line() == "python -m mjx_grasp.train --out 'my run' --seed 1"


def test_script_is_named_relative_to_the_repository(monkeypatch):
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__spec__=None))
    script = module._root() / "benchmarks" / "throughput.py"
    monkeypatch.setattr(sys, "argv", [str(script), "--worlds", "8"])
    assert module.command_line() == "python benchmarks/throughput.py --worlds 8"


def test_missing_packages_are_said_to_be_missing(monkeypatch):
    monkeypatch.setattr(module, "_PACKAGES", ("numpy", "no_such_package"))
    found = module.versions()
    assert found["no_such_package"].startswith("not installed") and found["numpy"][0].isdigit()


def test_devices_in_words():
    gpu = SimpleNamespace(platform="gpu", device_kind="NVIDIA H200")
    assert module.device_name(gpu) == "NVIDIA H200"
    assert "cores" in module.device_name(SimpleNamespace(platform="cpu"))


@pytest.mark.parametrize(
    "error, status, said",
    [
        (InputError("--worlds", 0, "at least 1"), 2, "error: --worlds: found 0"),
        (FileError("a.npz", "nothing", "a policy"), 2, "error: a.npz: found nothing"),
    ],
)
def test_commands_end_with_one_line(capsys, error, status, said):
    def command():
        raise error

    with pytest.raises(SystemExit) as stop:
        run_command(command)
    assert stop.value.code == status
    streams = capsys.readouterr()
    assert streams.err.startswith(said) and streams.err.count("\n") == 1 and not streams.out


@pytest.mark.parametrize("said", ["interrupted", "continue with: x"])
def test_an_interrupted_command_ends_without_cleaning_up_after_threads(said):
    """Python's clean-up may crash while something still computes; here it always would."""
    text = "" if said == "interrupted" else repr(said)
    script = (
        "import atexit, os\n"
        "from mjx_grasp.cli import run_command\n"
        "atexit.register(os.abort)\n"
        "def command():\n"
        "    print('so far')\n"
        f"    raise KeyboardInterrupt({text})\n"
        "run_command(command)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "so far\n", f"{said}\n")


def test_other_errors_keep_their_traceback():
    def command():
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        run_command(command)
