"""A table of ready text, for HTML and the terminal."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as RichTable


@dataclass(frozen=True)
class Table:
    """A table of ready text: columns of names, then columns of numbers."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    summary: int = 0
    """How many of the last rows sum up the others."""
    names: int = 1
    """How many of the first columns are names; the others are numbers."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table for a terminal; turned where only so its words stay whole."""
        turned = self.turned() if self.names == 1 else self
        wide = self._width() > options.max_width and turned._width() < self._width()
        yield (turned._without_corner() if wide else self)._rich()

    def turned(self) -> Table:
        """Rows as columns and columns as rows, of a table with one column of names."""
        header, *rows = zip(self.header, *self.rows, strict=True)
        return Table(self.title, header, tuple(rows))

    def condensed(self) -> Table:
        """Without a first column of names that says the same in all rows: the title says it."""
        same = {row[0] for row in self.rows}
        if self.names == 1 or len(same) != 1:
            return self
        rows = tuple(row[1:] for row in self.rows)
        title = f"{same.pop()}. {self.title}"
        return replace(self, title=title, header=self.header[1:], rows=rows, names=self.names - 1)

    def _width(self) -> int:
        """Columns of a terminal in which no word is taken apart."""
        words = (" ".join(column).split() for column in zip(self.header, *self.rows, strict=True))
        return 1 + sum(3 + max(map(len, of), default=0) for of in words)

    def _rich(self) -> RichTable:
        table = RichTable(title=self.title, title_justify="left")
        for i, name in enumerate(self.header):
            # Nothing is cut off where it is narrow, and names are not taken apart.
            words = " ".join(row[i] for row in self.rows).split() if i < self.names else []
            table.add_column(
                name,
                justify="left" if i < self.names else "right",
                overflow="fold",
                min_width=max(map(len, words), default=None),
            )
        for i, row in enumerate(self.rows):
            last = i == len(self.rows) - self.summary - 1
            table.add_row(*row, end_section=last)
        return table

    def narrow(self) -> Table:
        """The way round that has fewer columns, of a table with one column of names."""
        few = len(self.header) <= len(self.rows) + 1
        return self if few else self.turned()._without_corner()

    def _without_corner(self) -> Table:
        """Of a turned table: what its corner says is of the column that is now the header."""
        return replace(self, header=("", *self.header[1:]))

    def html(self) -> str:
        """The table with its title as caption, as HTML."""

        def cells(row: Sequence[str], tag: str) -> str:
            return "".join(f"<{tag}>{c}</{tag}>" for c in row)

        def numbers(row: Sequence[str]) -> tuple[str, ...]:
            return (*map(html.escape, row[: self.names]), *map(_number, row[self.names :]))

        first = len(self.rows) - self.summary
        body = "".join(
            f"<tr class='{'summary' if i >= first else 'single'}'>{cells(numbers(r), 'td')}</tr>"
            for i, r in enumerate(self.rows)
        )
        header = cells([html.escape(name) for name in self.header], "th")
        # The caption is outside what scrolls, to be read whole on a phone.
        return (
            f"<figure class='table'><figcaption>{html.escape(self.title)}</figcaption><div><table>"
            f"<thead><tr>{header}</tr></thead><tbody>{body}</tbody></table></div></figure>"
        )


def _number(cell: str) -> str:
    """A cell that a narrow page breaks before its interval alone."""
    parts = html.escape(cell).replace(" (", "</span> <span>(", 1)
    return f"<span>{parts}</span>" if parts else ""
