"""Files are whole or not there, and what cannot be written is refused beforehand."""

import json

import pytest

from mjx_grasp.errors import InputError
from mjx_grasp.records.atomic import check_writable, replacing, write_json


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


def test_a_file_in_folders_that_are_not_there_yet_can_be_written(tmp_path):
    check_writable("--out", tmp_path / "new" / "folder" / "a.json")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_refused_with_the_setting_and_the_reason(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file" / "a.json", "/proc/nowhere/a.json"):
        with pytest.raises(InputError, match=r"--out: found .* that can be written \(.+\)"):
            check_writable("--out", path)
