import json
import re
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from forging import rewrite
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

import mjx_grasp
from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.archive import (
    ArchiveKind,
    ChecksumError,
    checked,
    read_archive,
    write_archive,
)
from mjx_grasp.records.settings import Positive, Settings


@dataclass(frozen=True)
class Header(Settings):
    name: str
    length: Positive = 1.0
    tags: tuple[str, ...] = ()
    more: dict | None = None


def nothing_below(path, header, arrays):
    if arrays["points"].min(initial=0.0) < -1e6:
        raise FileError(path, "points far below", "points above")


KIND = ArchiveKind(
    format="a test's file",
    version=3,
    header=Header,
    arrays={"points": "float64 n 3", "index": "int32 n", "on": "bool _", "part_*": "uint8 _"},
    check=nothing_below,
)
HEADER = Header("nine °C", 0.25, ("a", "b"), {"infinite": float("inf"), "list": [1, None]})
ARRAYS = {
    "points": np.arange(6.0).reshape(2, 3),
    "index": np.array([4, -1], np.int32),
    "on": np.array([True]),
    "part_0": np.frombuffer(b"some bytes", np.uint8),
    "part_1": np.zeros(0, np.uint8),
}


def same(found, expected):
    header, arrays = found
    return header == expected[0] and {k: a.tolist() for k, a in arrays.items()} == {
        k: np.asarray(a).tolist() for k, a in expected[1].items()
    }


@pytest.fixture
def path(tmp_path):
    write_archive(tmp_path / "a.npz", KIND, HEADER, ARRAYS)
    return tmp_path / "a.npz"


def refused(path, match, kind=KIND):
    with pytest.raises(FileError, match=match) as error:
        read_archive(path, kind)
    assert error.value.path == path and str(path) in str(error.value)


def test_everything_comes_back(path):
    assert same(read_archive(path, KIND), (HEADER, ARRAYS))
    assert [p.name for p in path.parent.iterdir()] == ["a.npz"]


numbers = st.floats(allow_nan=False, allow_infinity=False)
headers = st.builds(
    Header,
    name=st.text(),
    length=st.floats(1e-300, 1e300),
    tags=st.lists(st.text()).map(tuple),
    more=st.none() | st.dictionaries(st.text(), st.none() | st.integers() | numbers | st.text()),
)


@given(headers, st.integers(0, 5), st.data())
def test_whatever_fits_comes_back(tmp_path_factory, header, n, data):
    path = tmp_path_factory.mktemp("a") / "a.npz"
    points = arrays_of.arrays(np.float64, (n, 3), elements=st.floats(-1e6, 1e300))
    arrays = {
        "points": data.draw(points),
        "index": data.draw(arrays_of.arrays(np.int32, n)),
        "on": data.draw(arrays_of.arrays(bool, st.integers(0, 4))),
    }
    write_archive(path, KIND, header, arrays)
    assert same(read_archive(path, KIND), (header, arrays))


def test_the_same_content_makes_the_same_file(path, tmp_path):
    write_archive(tmp_path / "b.npz", KIND, HEADER, dict(reversed(ARRAYS.items())) | ARRAYS)
    first, second = (
        {name: file[name].tolist() for name in sorted(file.files)}
        for file in (np.load(path), np.load(tmp_path / "b.npz"))
    )
    assert first == second
    write_archive(tmp_path / "c.npz", KIND, HEADER, ARRAYS)
    assert (tmp_path / "c.npz").read_bytes() == path.read_bytes()


def test_arrays_are_converted_to_the_types_of_the_kind(tmp_path):
    fields = ARRAYS | {"points": [[1, 2, 3]], "index": np.array([7.0]), "on": [0, 1]}
    write_archive(tmp_path / "a.npz", KIND, HEADER, fields)
    _, arrays = read_archive(tmp_path / "a.npz", KIND)
    assert arrays["points"].dtype == np.float64 and arrays["index"].dtype == np.int32
    assert arrays["on"].tolist() == [False, True]


def test_no_damaged_byte_changes_what_is_read(path):
    whole, refusals = path.read_bytes(), 0
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            # Some bytes of a zip file, such as times, say nothing.
            assert same(read_archive(path, KIND), (HEADER, ARRAYS)), place
        except FileError as error:
            assert error.path == path
            refusals += 1
    assert refusals > 0.6 * len(whole)


@given(st.data())
def test_no_damaged_region_changes_what_is_read(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("a") / "a.npz"
    write_archive(path, KIND, HEADER, ARRAYS)
    content = bytearray(path.read_bytes())
    start = data.draw(st.integers(0, len(content) - 1))
    noise = data.draw(st.binary(min_size=1, max_size=200))
    content[start : start + len(noise)] = noise
    path.write_bytes(content)
    try:
        assert same(read_archive(path, KIND), (HEADER, ARRAYS))
    except FileError as error:
        assert error.path == path


def test_cut_files_are_refused(path):
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        refused(path, "damaged or foreign|another kind")


def test_missing_and_foreign_files_are_refused(path, tmp_path):
    refused(tmp_path / "none.npz", "no such file.*a test's file")
    refused(tmp_path, "directory")
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "single.npy", np.ones(3))
    with zipfile.ZipFile(tmp_path / "note.npz", "w") as file:
        file.writestr("header", b"{}")
    for name in ("text.npz", "single.npy", "note.npz"):
        refused(tmp_path / name, "damaged or foreign|another kind")
    np.savez(tmp_path / "other.npz", weights=np.ones(3))
    refused(tmp_path / "other.npz", "another kind of file .of no known format.")
    for text in ("[1, 2]", "3", "no JSON", "[" * 100_000):
        np.savez(tmp_path / "odd.npz", header=np.array(text))
        refused(tmp_path / "odd.npz", "damaged or foreign")
    refused(path, "another kind of file .a test's file.", replace(KIND, format="another file"))


def test_nothing_pickled_is_read_or_written(path, tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("it was unpickled",))

    np.savez(path, header=np.array(Trap(), object), **ARRAYS)
    refused(path, "damaged or foreign")
    np.savez(path, header=np.array(json.dumps({"format": KIND.format})), index=np.array([Trap()]))
    refused(path, "damaged or foreign")
    with pytest.raises((FileError, TypeError)):
        write_archive(tmp_path / "b.npz", KIND, HEADER, ARRAYS | {"index": np.array([Trap()])})
    assert not (tmp_path / "b.npz").exists()


def in_header(**fields):
    return lambda arrays, header: header.update(fields)


def in_arrays(**fields):
    return lambda arrays, header: arrays.update(fields)


CHANGES = {
    "header": in_header(length=0.5),
    "array": in_arrays(index=np.array([4, -2], np.int32)),
    "type": in_arrays(index=np.array([4, -1], np.int32).view(np.uint32)),
    "shape": in_arrays(points=np.arange(6.0).reshape(3, 2)),
    "name": lambda arrays, header: arrays.update(part_2=arrays.pop("part_1")),
    "swap": lambda arrays, header: arrays.update(part_0=arrays["part_1"], part_1=arrays["part_0"]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_the_checksum_is_over_all_that_is_said(path, change):
    rewrite(path, change)
    refused(path, "checksum")


FORGERIES = {
    "newer": (in_header(version=4), "version 4, expected version 3 or before; newer"),
    "older than known": (in_header(version=0), "version 0"),
    "no version": (in_header(version=None), "version None"),
    "strange version": (in_header(version=[3]), "version None"),
    "unknown field": (in_header(colour="red"), "colour.*some of "),
    "missing field": (lambda arrays, header: header.pop("name"), "header.name = 'nothing'"),
    "impossible value": (in_header(length=-1.0), "length = -1.0, expected more than 0"),
    "another type": (in_header(tags="ab"), "tags = 'ab'"),
    "missing array": (lambda arrays, header: arrays.pop("on"), "no array on"),
    "unknown array": (in_arrays(extra=np.ones(2)), "an array extra"),
    "array of another type": (in_arrays(on=np.ones(1)), "on float64.*expected bool"),
    "length": (in_arrays(index=np.ones(3, np.int32)), r"index int32 \(3,\), expected int32 \(2\)"),
    "dimensions": (in_arrays(points=np.ones(6)), r"points float64 \(6,\), expected.*\(6, 3\)"),
    "fixed length": (in_arrays(points=np.ones((2, 4))), r"points.*expected float64 \(2, 3\)"),
    "not finite": (in_arrays(points=np.full((2, 3), np.nan)), "points with numbers that are not"),
    "its own check": (in_arrays(points=np.full((2, 3), -1e9)), "points far below"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), FORGERIES.values(), ids=FORGERIES)
def test_what_makes_no_sense_is_refused_with_a_right_checksum(path, change, message):
    rewrite(path, change, sign=True)
    refused(path, message)


def test_a_header_without_a_checksum_is_refused(path):
    rewrite(path, lambda arrays, header: header.pop("checksum"))
    refused(path, "incomplete content")


@pytest.mark.parametrize(
    "bad",
    [
        {"points": np.full((2, 3), np.inf)},
        {"points": np.full((2, 3), -1e9)},
        {"index": np.zeros(3)},
        {"extra": np.zeros(3)},
    ],
    ids=str,
)
def test_what_would_not_be_read_is_not_written(path, bad):
    before = path.read_bytes()
    with pytest.raises(FileError):
        write_archive(path, KIND, HEADER, ARRAYS | bad)
    with pytest.raises(InputError):
        write_archive(path, KIND, replace(HEADER, length=-1.0), ARRAYS)
    assert path.read_bytes() == before


def test_an_interrupted_write_leaves_the_old_file(path, monkeypatch):
    def broken(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", broken)
    with pytest.raises(OSError, match="disk full"):
        write_archive(path, KIND, Header("another"), ARRAYS)
    assert same(read_archive(path, KIND), (HEADER, ARRAYS))
    assert [p.name for p in path.parent.iterdir()] == ["a.npz"]


def test_files_of_older_versions_are_lifted_to_the_present(path):
    def with_label(header, arrays):
        fields, arrays = checked(header, arrays)
        return {"name": fields.pop("label"), **fields}, arrays

    def damaged(header, arrays):
        raise ChecksumError

    old = lambda arrays, header: header.update(version=2, label=header.pop("name"))  # noqa: E731
    rewrite(path, old, sign=True)
    refused(path, "version 2, expected version 3")
    assert same(read_archive(path, replace(KIND, older={2: with_label})), (HEADER, ARRAYS))
    refused(path, "checksum", replace(KIND, older={2: damaged}))
    refused(path, "incomplete content", replace(KIND, older={2: lambda h, a: {}["x"]}))
    rewrite(path, in_header(label="another"))
    refused(path, "checksum", replace(KIND, older={2: with_label}))


def test_there_is_no_other_way_to_write_and_read_such_files():
    uses = re.compile(r"\bnp\.(savez|savez_compressed|load)\(")
    package = Path(mjx_grasp.__file__).parent
    found = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if uses.search(path.read_text())
    }
    # What is made again when it cannot be read, what is shipped, what is written for people to look
    # into, and what they bring: a depth image.
    others = {
        "objects/kept_pieces.py",
        "objects/parametric.py",
        "learning/run.py",
        "language/seen.py",
    }
    assert found == {"records/archive.py"} | others
