"""Tables in a terminal: whole words where there is room for them one way round or the other."""

from rich.console import Console

from mjx_grasp.records.table import Table

NAMES = ("controller", "squeeze", "grip", "policy that it began with")
WIDE = Table(
    "Success", ("object", *(f"{name} {n}" for n in range(4) for name in NAMES)),
    (("rubiks cube", *(f"{n}.5" for n in range(16))), ("mean %", *("50.0",) * 16)), summary=1,
)  # fmt: skip


def printed(table: Table, width: int) -> str:
    console = Console(width=width, record=True, file=None, force_terminal=False)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_turned_twice_is_the_same() -> None:
    again = WIDE.turned().turned()
    assert (again.header, again.rows) == (WIDE.header, WIDE.rows)


def test_where_it_fits_rows_stay_rows() -> None:
    lines = printed(WIDE, 400).splitlines()
    assert any("rubiks cube" in line and "15.5" in line for line in lines)


def test_where_it_does_not_columns_become_rows_with_whole_words() -> None:
    lines = printed(WIDE, 80).splitlines()
    assert any("policy that it began with 3" in line and "15.5" in line for line in lines)
    assert all("squeeze" in line for line in lines if "squee" in line)
    assert max(map(len, lines)) <= 80


def test_what_is_wide_either_way_stays_as_it_is() -> None:
    square = Table("T", ("name", *("a" * 30,) * 4), tuple(("b" * 30, *"cdef") for _ in range(4)))
    assert square.turned()._width() >= square._width()
    rows = [line for line in printed(square, 60).splitlines() if "bbb" in line]
    assert all(line.startswith("│ b") for line in rows)


def test_what_is_the_same_in_all_rows_is_said_once() -> None:
    rows = (("easy", "policy", "1"), ("easy", "squeeze", "2"))
    table = Table("Success", ("condition", "controller", "N"), rows, names=2).condensed()
    assert table.title == "easy. Success" and table.header == ("controller", "N")
    assert table.rows == (("policy", "1"), ("squeeze", "2"))
    assert table.condensed() == table, "names of the only column stay"
    header, hard = ("condition", "controller", "N"), ("hard", "policy", "3")
    several = Table("Success", header, (*rows, hard), names=2)
    assert several.condensed() == several


def test_the_narrow_way_round_has_fewer_columns() -> None:
    narrow = WIDE.narrow()
    assert len(narrow.rows) == 16 and narrow.header == ("", "rubiks cube", "mean %")
    assert narrow.narrow() == narrow


def test_on_a_page_an_interval_is_not_taken_apart_and_an_empty_cell_is_empty() -> None:
    long = Table("T", ("object", "N"), (("a", "1 (0–2)"), ("b", "2"), ("c", "")))
    assert "<th>object</th><th>N</th>" in long.html()
    assert "<td>a</td><td><span>1</span> <span>(0–2)</span></td>" in long.html()
    assert "<td>c</td><td></td>" in long.html()
