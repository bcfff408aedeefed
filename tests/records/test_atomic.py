"""Files are whole or not there, and what cannot be written is refused beforehand."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjx_grasp.errors import FileError, InputError
from mjx_grasp.records.atomic import (
    check_new_folder,
    check_replaceable,
    check_writable,
    read_json,
    replacing,
    write_json,
)


def test_a_writer_that_fails_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"kept": 1})
    before = path.read_text()
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == before and list(tmp_path.iterdir()) == [path]


def test_whoever_reads_while_a_file_is_replaced_has_the_old_one_whole(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"old": 1})
    with path.open() as reader:
        write_json(path, {"new": 2})
        assert json.load(reader) == {"old": 1}
    assert json.loads(path.read_text()) == {"new": 2}


def test_a_link_stays_one_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    path, link = tmp_path / "elsewhere" / "a.json", tmp_path / "a.json"
    link.symlink_to(path)
    for content in ({"first": 1}, {"second": 2}):
        write_json(link, content)
        assert link.is_symlink() and json.loads(path.read_text()) == content
    assert [each.name for each in path.parent.iterdir()] == ["a.json"]
    link.unlink()
    link.symlink_to(tmp_path / "elsewhere" / "without_a_suffix")
    with replacing(link) as temporary:
        assert temporary.suffix == ".json", "writers look at it"


def test_links_that_lead_nowhere_good_are_told_before_the_work(tmp_path):
    loop, astray = tmp_path / "loop.json", tmp_path / "astray.json"
    loop.symlink_to(loop)
    with pytest.raises(InputError, match="a link that leads to itself"):
        check_writable("--out", loop)
    astray.symlink_to(tmp_path / "missing" / "a.json")
    with pytest.raises(InputError, match="in a folder that does not exist"):
        check_writable("--out", astray)


def test_of_those_who_write_a_new_file_the_first_does(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"first": 1}, new=True)
    with pytest.raises(FileExistsError):
        write_json(path, {"second": 2}, new=True)
    assert read_json(path, "") == {"first": 1} and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("mode", [0o600, 0o664])
def test_modes_stay_but_for_whose_it_is(tmp_path, mode):
    path = tmp_path / "a.json"
    write_json(path, {})
    assert path.stat().st_mode & 0o777 == 0o644
    path.chmod(mode)
    write_json(path, {})
    assert path.stat().st_mode & 0o777 == mode
    path.chmod(mode & 0o444)
    write_json(path, {})
    assert path.stat().st_mode & 0o777 == mode & 0o444 | 0o200, "who made it may go on with it"


@pytest.mark.parametrize("content", ["no JSON", "{}", '{"schema": "theirs/1"}'])
def test_only_files_of_their_kind_are_replaced(tmp_path, content):
    path = tmp_path / "a.json"
    check_replaceable("--out", path, ["ours/1"])
    path.write_text('{"schema": "ours/1"}')
    check_replaceable("--out", path, ["ours/1"])
    path.write_text(content)
    with pytest.raises(InputError, match=r"--out: found '.*a\.json, which is another file"):
        check_replaceable("--out", path, ["ours/1"])
    assert path.read_text() == content


def test_what_can_be_written_leaves_nothing_behind(tmp_path):
    check_writable("--out", tmp_path / "a.json")
    check_new_folder("--out", tmp_path / "new" / "folder")
    assert not list(tmp_path.iterdir())


def test_a_file_in_a_folder_that_does_not_exist_is_refused(tmp_path):
    path = tmp_path / "missing" / "dir" / "a.json"
    with pytest.raises(InputError, match=rf"--out: .*does not exist \({path.parent}\)"):
        check_writable("--out", path)


def test_what_cannot_be_written_is_refused_with_the_setting_and_the_reason(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "made").mkdir()
    for check, path in (
        (check_writable, tmp_path),
        (check_writable, tmp_path / "file" / "a.json"),
        (check_writable, "/proc/a.json"),
        (check_new_folder, tmp_path / "file"),
        (check_new_folder, tmp_path / "file" / "folder"),
        (check_new_folder, "/proc/nowhere/folder"),
    ):
        with pytest.raises(InputError, match=r"--out: found .* can be written \(.+\)"):
            check("--out", path)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (None, "no such file"),
        ("{", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        ("9" * 5000, "no JSON"),
        ("[" * 100_000, "nested too deep"),
        ("[]", "a JSON list"),
        ("3", "a JSON int"),
    ],
)
def test_what_is_no_json_object_is_refused_by_name(tmp_path, text, found):
    path = tmp_path / "a.json"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(FileError, match=rf"a\.json: found .*{found}.*expected facts"):
        read_json(path, "facts")
    with pytest.raises(FileError, match="Is a directory"):
        read_json(tmp_path, "facts")


def test_what_was_written_is_read(tmp_path):
    write_json(tmp_path / "a.json", {"path": tmp_path, "numbers": (1, 2.5)})
    assert read_json(tmp_path / "a.json", "facts") == {"path": str(tmp_path), "numbers": [1, 2.5]}


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.integers(), inner),
)


@given(_JSON)
def test_json_says_what_json_dumps_would(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("json") / "a.json"
    write_json(path, content)
    assert json.loads(path.read_text()) == json.loads(json.dumps(content))


def test_a_list_of_numbers_is_a_line_and_so_is_a_row_without_lists(tmp_path):
    rows = [{"forces_n": [1.5, None], "empty": []}, {"object": "mug", "lifted_s": 1.5}, {}]
    write_json(tmp_path / "a.json", {"rows": rows, "seed": {"of": 0}})
    lines = ["{", ' "rows": [', "  {", '   "forces_n": [1.5, null],', '   "empty": []', "  },"]
    lines += [
        '  {"object": "mug", "lifted_s": 1.5},',
        "  {}",
        " ],",
        ' "seed": {',
        '  "of": 0',
        " }",
    ]
    assert (tmp_path / "a.json").read_text().splitlines() == [*lines, "}"]
