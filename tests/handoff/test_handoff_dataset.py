import dataclasses
import json
import zipfile
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.handoff.dataset import HandoffSet, load_handoffs, merge

ARRAYS = [f.name for f in dataclasses.fields(HandoffSet)][:8]


def some(n=20, seed=0, names=("box", "can", "ball"), kind="ik"):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3, 3))
    return HandoffSet(
        object_index=np.sort(rng.integers(0, len(names) - 1, n)).astype(np.int32),
        object_pos=rng.normal(size=(n, 3)).astype(np.float32),
        object_quat=rng.normal(size=(n, 4)).astype(np.float32),
        q=rng.normal(size=(n, 27)).astype(np.float32),
        target_pos=rng.normal(size=(n, 3, 3)).astype(np.float32),
        target_normal=np.float32(normal / np.linalg.norm(normal, axis=-1, keepdims=True)),
        score=rng.random(n).astype(np.float32),
        residual=rng.random((n, 3)).astype(np.float32) * 5e-3,
        object_names=tuple(names),
        object_content_hash=tuple(f"{name}-hash" for name in names),
        kind=kind,
    )


def equal(a, b):
    same = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ARRAYS)
    names = ("object_names", "object_content_hash", "kind")
    return same and all(getattr(a, name) == getattr(b, name) for name in names)


@pytest.mark.parametrize("n", [0, 1, 20])
@pytest.mark.parametrize("kind", ["ik", "reached"])
def test_round_trip(tmp_path, n, kind):
    path = tmp_path / "set.npz"
    some(n, kind=kind).save(path)
    assert equal(load_handoffs(path), some(n, kind=kind))
    assert [p.name for p in tmp_path.iterdir()] == ["set.npz"]


def rewritten(path, change):
    """The file with its members changed by a function of (arrays, header)."""
    with np.load(path) as file:
        members = {name: file[name] for name in file.files}
    header = json.loads(str(members.pop("header")))
    change(members, header)
    np.savez(path, header=np.array(json.dumps(header)), **members)


def flip_one_number(arrays, header):
    arrays["q"][3, 5] += 1e-6


def rename_an_object(arrays, header):
    header["object_names"][0] = "bottle"


def raise_version(arrays, header):
    header["version"] += 1


def drop_an_array(arrays, header):
    del arrays["residual"]


def another_format(arrays, header):
    header["format"] = "a policy"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (flip_one_number, "checksum"),
        (rename_an_object, "checksum"),
        (raise_version, "version 2"),
        (drop_an_array, "another kind"),
        (another_format, "another kind"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_changed_file_is_refused(tmp_path, change, message):
    path = tmp_path / "set.npz"
    some().save(path)
    rewritten(path, change)
    with pytest.raises(FileError, match=message) as error:
        load_handoffs(path)
    assert error.value.path == path


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path, share):
    path = tmp_path / "set.npz"
    some().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileError):
        load_handoffs(path)


@pytest.mark.parametrize("place", np.linspace(0.02, 0.98, 9))
def test_a_flipped_byte_never_loads_as_other_content(tmp_path, place):
    path = tmp_path / "set.npz"
    some().save(path)
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 0xFF
    path.write_bytes(content)
    try:
        loaded = load_handoffs(path)
    except FileError:
        return
    # Some bytes of a zip file, such as times, say nothing.
    assert equal(loaded, some())


def test_foreign_and_missing_files_are_refused(tmp_path):
    text, other, single = tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "c.npz"
    text.write_text("not a set")
    np.savez(other, weights=np.ones(3))
    with zipfile.ZipFile(single, "w") as file:
        file.writestr("note.txt", "hello")
    for path in (text, other, single, tmp_path / "missing.npz", tmp_path):
        with pytest.raises(FileError) as error:
            load_handoffs(path)
        assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("q", np.full((20, 27), np.nan, np.float32)),
        ("object_index", np.full(20, 7, np.int32)),
        ("target_pos", np.zeros((20, 2, 3), np.float32)),
        ("score", np.zeros(19, np.float32)),
        ("kind", "guessed"),
        ("object_names", ("box", "can")),
    ],
)
def test_what_does_not_fit_is_not_written(tmp_path, field, value):
    path = tmp_path / "set.npz"
    with pytest.raises(FileError):
        dataclasses.replace(some(), **{field: value}).save(path)
    assert not path.exists()


def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "set.npz"
    some().save(path)

    def broken(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", broken)
    with pytest.raises(OSError, match="disk full"):
        some(seed=1).save(path)
    assert equal(load_handoffs(path), some())
    assert [p.name for p in tmp_path.iterdir()] == ["set.npz"]


def test_states_of_another_mesh_are_refused(tmp_path):
    path = tmp_path / "set.npz"
    some().save(path)
    right = [SimpleNamespace(name="can", content_hash="can-hash")]
    wrong = [SimpleNamespace(name="can", content_hash="another")]
    unknown = [SimpleNamespace(name="mug", content_hash="another")]
    assert len(load_handoffs(path, right)) == len(load_handoffs(path, unknown)) == 20
    with pytest.raises(FileError, match="another can"):
        load_handoffs(path, wrong)


def test_select_take_and_counts():
    handoffs = some()
    can = handoffs.select(["can"])
    mask = handoffs.object_index == 1
    assert len(can) == mask.sum() > 0 and np.all(can.object_index == 0)
    assert np.array_equal(can.q, handoffs.q[mask])
    assert can.object_content_hash == ("can-hash",)
    swapped = handoffs.select(["ball", "can", "box"])
    assert len(swapped) == len(handoffs)
    assert swapped.counts() == {k: handoffs.counts()[k] for k in ("ball", "can", "box")}
    assert np.array_equal(handoffs.take(np.array([2, 0])).score, handoffs.score[[2, 0]])
    for names in (["mug"], ["can", "can"]):
        with pytest.raises(InputError, match="names"):
            handoffs.select(names)


def test_split_parts_every_object_and_depends_on_the_seed_alone():
    handoffs = some(200)
    training, evaluation = handoffs.split(0.25, 3)
    assert len(training) + len(evaluation) == 200
    both = np.concatenate([training.score, evaluation.score])
    assert np.array_equal(np.sort(both), np.sort(handoffs.score))
    for name, count in handoffs.counts().items():
        assert evaluation.counts()[name] == round(0.25 * count)
    assert equal(handoffs.split(0.25, 3)[1], evaluation)
    assert not equal(handoffs.split(0.25, 4)[1], evaluation)
    with pytest.raises(InputError, match="eval_share"):
        handoffs.split(1.0, 0)


def test_an_objects_split_does_not_depend_on_the_others():
    handoffs = some(100)
    alone = handoffs.select(["can"]).split(0.3, 0)[1]
    together = handoffs.split(0.3, 0)[1].select(["can"])
    assert equal(alone, together)


def test_merge_renumbers_and_refuses_what_differs():
    one, two = some(10, 0, ("box", "can")), some(12, 1, ("can", "ball"))
    merged = merge([one, two])
    assert merged.object_names == ("box", "can", "ball")
    assert len(merged.select(["can"])) == len(one.select(["can"])) + len(two.select(["can"]))
    assert np.array_equal(merged.q[:10], one.q)
    changed = dataclasses.replace(two, object_content_hash=("other", "ball-hash"))
    for sets in ([], [one, changed], [one, dataclasses.replace(two, kind="reached")]):
        with pytest.raises(InputError, match="sets"):
            merge(sets)


def test_it_is_a_pytree_of_its_arrays():
    handoffs = some()
    doubled = jax.tree.map(lambda x: 2 * x, handoffs)
    assert len(jax.tree.leaves(handoffs)) == len(ARRAYS)
    assert np.array_equal(doubled.q, 2 * handoffs.q) and doubled.kind == "ik"
