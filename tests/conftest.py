"""Shared fixtures, and run-time checks of the shapes that signatures promise."""

import gc
import itertools
import os
import sys
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import jaxtyping
import pytest
from checked import CHECKED
from jaxtyping import install_import_hook

# Many tests start commands, and these compile the same programs again: once is enough.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent.parent / ".cache/jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# The suite is the CPU's: several workers cannot each have a whole GPU. JAX_PLATFORMS=cuda with one
# worker (TEST_FLAGS=) runs it there.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# On the CPU the tests compile far longer than they compute, so XLA optimises little. XLA_FLAGS=
# (empty) runs them with the code that users get.
LITTLE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
if os.environ["JAX_PLATFORMS"] == "cpu":
    flags = LITTLE
    # Threads that compile one program together do more in all, and the workers have the cores.
    flags += " --xla_cpu_parallel_codegen_split_count=1"
    if version("jaxlib").startswith("0.10."):  # later ones end at a flag that they do not know
        flags += " --xla_cpu_use_fusion_emitters=false"
    os.environ.setdefault("XLA_FLAGS", flags)
# No test reads where in the source an operation is from: a tenth of the time to lower a program.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# The threads of NumPy's products would wait for each other, for matrices as small as these.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Before anything of the package is imported. An int may be given where a float is asked for.
TYPECHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
install_import_hook(CHECKED, TYPECHECKER)

hypothesis.settings.register_profile("mjx_grasp", deadline=None, max_examples=50)
hypothesis.settings.load_profile("mjx_grasp")


def share_contexts(programs=200):
    """Programs share an MLIR context: to make one takes longer than to lower a small program.

    Nothing is changed where JAX makes them elsewhere.
    """
    from jax._src.interpreters import mlir

    make = getattr(mlir, "make_ir_context", None)
    if make is None:
        return
    number, latest = itertools.count(), []

    def shared():
        if next(number) % programs == 0:  # anew now and then: it keeps the constants of them all
            latest[:] = [make()]
        return latest[0]

    mlir.make_ir_context = shared


share_contexts()

# What is imported stays, and little of what is traced hangs together in rings.
gc.set_threshold(100_000, 20, 10)


def pytest_collection_finish():
    gc.collect()
    gc.freeze()


SUBSTEPS = 5

# Whole files go to one worker each: the longest have to be started first, or one worker is left
# with them at the end. The order is that of measured times; what is not named follows.
LONGEST_FIRST = (
    "test_grasper.py",
    "test_closing_task.py",
    "test_commands.py",
    "test_training.py",
    "test_controller.py",
    "test_reactivity.py",
    "test_closer.py",
    "test_planning.py",
    "test_ik.py",
    "test_heatmaps_command.py",
    "test_devices.py",
    "test_end_to_end_helped.py",
    "test_refusals.py",
    "test_readme.py",
    "test_signed_distance.py",
    "test_handoff_generation.py",
    "test_viewer.py",
    "test_end_to_end.py",
    "test_mjx.py",
)


def pytest_collection_modifyitems(items):
    def place(item):
        name = item.path.name
        return LONGEST_FIRST.index(name) if name in LONGEST_FIRST else len(LONGEST_FIRST)

    items.sort(key=place)


@pytest.fixture(scope="session", autouse=True)
def _postures_are_drawn_fast():
    """Of a hundred thousand that are tried few are kept: what tries them is worth optimising."""
    if LITTLE not in os.environ.get("XLA_FLAGS", ""):
        yield
        return
    import jax

    from mjx_grasp.posture import draw

    optimised = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 1})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(draw, "jax", SimpleNamespace(jit=optimised, vmap=jax.vmap))
        yield


@pytest.fixture
def committed(monkeypatch):
    """A checkout without uncommitted changes: what was begun in it is gone on with."""
    monkeypatch.setattr("mjx_grasp.records.provenance.git_revision", lambda: "abc")


@pytest.fixture(scope="session")
def robot():
    from mjx_grasp.robot.spec import load_robot

    return load_robot()


@pytest.fixture(scope="session")
def body(robot):
    from mjx_grasp.posture.body import robot_body

    return robot_body(robot)


@pytest.fixture(scope="session")
def handmade_objects():
    """A box, a ball and a dumbbell: a hull, a sphere, and several pieces off-centre."""
    import handmade

    return [handmade.box(), handmade.ball(), handmade.dumbbell()]


@pytest.fixture(scope="session")
def scene(handmade_objects, robot):
    """The union scene of the hand-made objects."""
    from mjx_grasp.sim.scene import build_scene

    return build_scene(handmade_objects, robot)


@pytest.fixture(scope="session")
def starts(scene, handmade_objects):
    """Three start states per object: rows 0–2 box, 3–5 ball, 6–8 dumbbell."""
    import handmade

    from mjx_grasp.tasks.starts import build_starts

    return build_starts(scene, handmade.handoffs(handmade_objects), SUBSTEPS)


@pytest.fixture(scope="session")
def native(scene):
    from mjx_grasp.sim.native import NativePhysics

    return NativePhysics(scene, threads=2)


@pytest.fixture(autouse=True)
def _contacts_find_room(request, monkeypatch):
    """Full buffers of native MuJoCo are an error, but where a test asks for them."""
    native = sys.modules.get("mjx_grasp.sim.native")
    full = []
    if native is not None and not request.node.get_closest_marker("overflows"):
        step = native._Worlds.step

        def watched(self, *arguments):
            read = step(self, *arguments)
            full.extend(read["overflow"].nonzero()[0].tolist())
            return read

        monkeypatch.setattr(native._Worlds, "step", watched)
    yield
    assert not full, f"contacts or constraints of {len(full)} worlds found no room"


@pytest.fixture(autouse=True)
def _wrong_types_get_to_the_code(request):
    """Where the package has words of its own for them."""
    jaxtyping.config.update("jaxtyping_disable", "wrong_types" in request.keywords)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True)
def _logs_of_mujoco_stay_out_of_the_repository(tmp_path, monkeypatch):
    """MuJoCo appends its warnings to a file in the working directory."""
    monkeypatch.chdir(tmp_path)
