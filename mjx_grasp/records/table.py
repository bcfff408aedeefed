"""A table of ready text, for HTML and the terminal."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

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

    def __rich__(self) -> RichTable:
        """The table for a terminal."""
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

    def html(self) -> str:
        """The table with its title as caption, as HTML."""

        def cells(row: Sequence[str], tag: str) -> str:
            return "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in row)

        first = len(self.rows) - self.summary
        body = "".join(
            f"<tr class='{'summary' if i >= first else 'single'}'>{cells(r, 'td')}</tr>"
            for i, r in enumerate(self.rows)
        )
        return (
            f"<table><caption>{html.escape(self.title)}</caption>"
            f"<thead><tr>{cells(self.header, 'th')}</tr></thead><tbody>{body}</tbody></table>"
        )
