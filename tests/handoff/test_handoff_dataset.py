import dataclasses

import handmade
import jax
import numpy as np
import pytest
from forging import rewrite

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.handoff.dataset import KINDS, HandoffSet, kind_of, load_handoffs, merge
from mjx_grasp.robot.identity import FIRST_ROBOT, RobotIdentity

ROBOT = RobotIdentity("rizon4_hx5d20", "a1" * 32)

ARRAYS = [f.name for f in dataclasses.fields(HandoffSet)][:10]


def unit(vectors):
    return np.float32(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def some(n=20, seed=0, names=("box", "can", "ball"), kind="ik", robot=ROBOT):
    rng = np.random.default_rng(seed)
    pos = np.float32(rng.normal(size=(n, 3)) * [1, 1, 0] + [0, 0, 0.05])
    return HandoffSet(
        object_index=np.sort(rng.integers(0, len(names) - 1, n)).astype(np.int32),
        object_pos=pos,
        object_quat=unit(rng.normal(size=(n, 4))),
        q=rng.normal(size=(n, 27)).astype(np.float32),
        target_pos=np.float32(pos[:, None] + 0.04 * unit(rng.normal(size=(n, 3, 3)))),
        target_normal=unit(rng.normal(size=(n, 3, 3))),
        score=rng.random(n).astype(np.float32),
        residual=rng.random((n, 3)).astype(np.float32) * 5e-3,
        midpoint=rng.random(n).astype(np.float32) * 5e-3,
        reached={"ik": np.zeros(n, bool), "reached": np.ones(n, bool), "mixed": np.arange(n) > 7}[
            kind
        ],
        object_names=tuple(names),
        object_content_hash=tuple(f"{name}-hash" for name in names),
        robot=robot,
    )


def equal(a, b):
    same = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ARRAYS)
    names = ("object_names", "object_content_hash", "robot")
    return same and all(getattr(a, name) == getattr(b, name) for name in names)


@pytest.mark.parametrize("n", [0, 1, 20])
@pytest.mark.parametrize("kind", KINDS)
def test_round_trip(tmp_path, n, kind):
    path = tmp_path / "set.npz"
    some(n, kind=kind).save(path)
    assert equal(load_handoffs(path), some(n, kind=kind))
    assert load_handoffs(path).kind == kind_of(some(n, kind=kind).reached)
    assert [p.name for p in tmp_path.iterdir()] == ["set.npz"]


def flip_one_number(arrays, header):
    arrays["q"][3, 5] += 1e-6


def rename_an_object(arrays, header):
    header["object_names"][0] = "bottle"


def raise_version(arrays, header):
    header["version"] += 1


def another_format(arrays, header):
    header["format"] = "a policy"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (flip_one_number, "checksum"),
        (rename_an_object, "checksum"),
        (raise_version, "version 4, expected version 3 or before"),
        (another_format, "another kind"),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_changed_file_is_refused(tmp_path, change, message):
    path = tmp_path / "set.npz"
    some().save(path)
    rewrite(path, change)
    with pytest.raises(FileError, match=message) as error:
        load_handoffs(path)
    assert error.value.path == path


def filled(name, value):
    """The array of a name with the value at state 7, and elsewhere as it was."""

    def change(arrays, header=None):
        arrays[name] = arrays[name].copy()
        arrays[name][7] = value

    return change


IMPOSSIBLE = {
    "zero quaternion": (filled("object_quat", 0.0), "object_quat of state 7.*unit quaternions"),
    "long quaternion": (filled("object_quat", 1.0), "unit quaternions"),
    "zero normals": (filled("target_normal", 0.0), "target_normal of state 7.*unit normals"),
    "long normal": (filled("target_normal", [[1, 1, 0], [1, 0, 0], [0, 1, 0]]), "unit normals"),
    "under the table": (filled("object_pos", [0.5, 0.0, -0.1]), "state 7.*above the table"),
    "in the sky": (filled("object_pos", [0.5, 0.0, 3.0]), "above the table"),
    "far from its targets": (filled("target_pos", 5.0), "target_pos of state 7 with.*within 1 m"),
    "negative score": (filled("score", -0.1), "score of state 7 with -0.1, expected.*0 to 1"),
    "large score": (filled("score", 1.1), "scores from 0 to 1"),
    "negative residual": (filled("residual", -1e-3), "residual of state 7 with -0.001"),
    "negative midpoint": (filled("midpoint", -1e-3), "midpoint of state 7 with -0.001"),
    "infinite joint": (filled("q", np.inf), "q with numbers that are not finite"),
    "index": (filled("object_index", 9), "object index up to 9"),
}


@pytest.mark.parametrize(("change", "message"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_states_that_cannot_be_are_refused_with_a_right_checksum(tmp_path, change, message):
    path = tmp_path / "set.npz"
    some().save(path)
    rewrite(path, change, sign=True)
    with pytest.raises(FileError, match=message):
        load_handoffs(path)
    arrays = {name: getattr(some(), name) for name in ARRAYS}
    change(arrays)
    with pytest.raises(FileError, match=message):
        dataclasses.replace(some(), **arrays).save(tmp_path / "new.npz")
    assert not (tmp_path / "new.npz").exists()


@pytest.mark.parametrize(
    "fields", [{"kind": "guessed"}, {"kind": "reached"}, {"object_names": ["a", "a", "b"]}]
)
def test_a_header_that_cannot_be_is_refused_with_a_right_checksum(tmp_path, fields):
    path = tmp_path / "set.npz"
    some().save(path)
    rewrite(path, lambda arrays, header: header.update(fields), sign=True)
    with pytest.raises(FileError, match=r"set\.npz"):
        load_handoffs(path)


def test_joints_beyond_their_ranges_are_refused_where_the_robot_is_known(tmp_path, robot):
    path = tmp_path / "set.npz"
    made = dataclasses.replace(handmade.handoffs([handmade.box()]), robot=robot.identity)
    made.save(path)
    for used in (robot, robot.without_idle_fingers()):
        assert equal(load_handoffs(path, robot=used), made)
    far = made.q.copy()
    far[1, 2] = 7.0
    dataclasses.replace(made, q=far).save(path)
    assert len(load_handoffs(path)) == 3
    with pytest.raises(FileError, match=r"joint3 of state 1 at 7, expected -3\.\d+ to 3\.\d+"):
        load_handoffs(path, robot=robot)
    dataclasses.replace(made, q=made.q[:, 1:]).save(path)
    with pytest.raises(FileError, match="26 joints, expected 27"):
        load_handoffs(path, robot=robot)


def test_states_of_another_robot_are_refused(tmp_path, robot):
    path = tmp_path / "set.npz"
    made = handmade.handoffs([handmade.box()])
    assert made.robot == FIRST_ROBOT
    made.save(path)
    assert load_handoffs(path, robot=robot).robot == FIRST_ROBOT
    for other in (RobotIdentity("six_axis"), ROBOT):
        dataclasses.replace(made, robot=other).save(path)
        assert load_handoffs(path).robot == other
        with pytest.raises(
            FileError, match=rf"set\.npz: found the robot {other.name}.*{robot.name}"
        ):
            load_handoffs(path, robot=robot)


@pytest.mark.wrong_types
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("q", np.full((20, 27), np.nan, np.float32)),
        ("object_index", np.full(20, 7, np.int32)),
        ("target_pos", np.zeros((20, 2, 3), np.float32)),
        ("score", np.zeros(19, np.float32)),
        ("object_names", ("box", "can")),
    ],
)
def test_what_does_not_fit_is_not_written(tmp_path, field, value):
    path = tmp_path / "set.npz"
    with pytest.raises(FileError):
        dataclasses.replace(some(), **{field: value}).save(path)
    assert not path.exists()


def test_states_of_another_mesh_are_refused(tmp_path):
    path = tmp_path / "set.npz"
    some().save(path)
    right = [dataclasses.replace(handmade.ball("can"), content_hash="can-hash")]
    wrong = [handmade.ball("can")]
    unknown = [handmade.ball("mug")]
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


@pytest.mark.parametrize("share", [0.001, 0.999])
def test_several_states_are_never_all_on_one_side(share):
    handoffs = some(20).select(["box", "can"])
    training, evaluation = handoffs.split(share)
    least, other = (training, evaluation) if share > 0.5 else (evaluation, training)
    assert least.counts() == {"box": 1, "can": 1} and len(other) == 18
    alone = handoffs.take(np.array([0])).split(share)
    assert [len(part) for part in alone] == [round(1 - share), round(share)]


def test_a_mixture_is_split_into_mixtures():
    mixed = merge([some(40, 0), some(120, 1, kind="reached")])
    for name in ("box", "can"):
        both = mixed.select([name])
        for part, share in zip(both.split(0.25, 3), (0.75, 0.25), strict=True):
            assert abs(part.reached.sum() - share * both.reached.sum()) <= 0.5
            assert abs((~part.reached).sum() - share * (~both.reached).sum()) <= 0.5


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
    for sets in ([], [one, changed]):
        with pytest.raises(InputError, match="sets"):
            merge(sets)


def test_a_mixture_knows_of_each_state_what_it_is():
    ik, reached = some(10, 0), some(12, 1, kind="reached")
    assert (ik.kind, reached.kind) == ("ik", "reached")
    both = merge([ik, reached])
    assert both.kind == "mixed"
    assert equal(both.take(~both.reached), ik) and equal(both.take(both.reached), reached)
    assert both.take(both.reached).kind == "reached" and both.take(~both.reached).kind == "ik"


def test_merge_keeps_the_robot_and_forgets_a_digest_that_is_not_all_known():
    known, unknown = some(10), some(10, robot=FIRST_ROBOT)
    other = some(10, robot=dataclasses.replace(ROBOT, digest="b2" * 32))
    assert merge([known, known]).robot == ROBOT
    assert merge([known, unknown]).robot == merge([unknown, other]).robot == FIRST_ROBOT
    for sets in ([known, other], [unknown, known, other], [known, some(robot=RobotIdentity("x"))]):
        with pytest.raises(InputError, match="states of one robot"):
            merge(sets)


def test_it_is_a_pytree_of_its_arrays():
    handoffs = some()
    backwards = jax.tree.map(lambda x: x[::-1], handoffs)
    assert len(jax.tree.leaves(handoffs)) == len(ARRAYS)
    assert np.array_equal(backwards.q, handoffs.q[::-1]) and backwards.kind == "ik"
