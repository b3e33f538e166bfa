"""Tables of figures on the terminal: one figure a row, one method or variant a column."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

_NO_LIMIT = 100_000  # characters: pipes and logs of jobs have no width


def print_figures(
    title: str, columns: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], console: Console
) -> None:
    """Print the rows that have any cell; names are broken where their parts end.

    A terminal gets as many columns at a time as fit; a file or pipe gets all of them, however wide they are.
    """
    if not console.is_terminal:
        console = Console(file=console.file, width=_NO_LIMIT)
    shown = [(figure, cells) for figure, cells in rows if any(cells)]
    start, wide = 0, console.options.update(max_width=_NO_LIMIT)
    while start < len(columns):
        for stop in range(len(columns), start, -1):
            table = _table("" if start else title, columns, shown, slice(start, stop))
            if console.measure(table, options=wide).maximum <= console.width:
                break
        console.print(table)
        start = stop


def _table(title: str, columns: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], part: slice) -> Table:
    """Some of the columns. Where even one is too wide, its name is broken: neither a cell nor a word of a figure is."""
    table = Table(title=title or None, title_justify="left")
    table.add_column("", min_width=max(len(word) for figure, _ in rows for word in figure.split()) if rows else None)
    for number, name in enumerate(columns[part], part.start):
        widest = max((Text.from_markup(cells[number]).cell_len for _, cells in rows), default=0)
        table.add_column(re.sub(r"[:@,] ?| ", "\n", name), justify="right", overflow="fold", min_width=widest)
    for figure, cells in rows:
        table.add_row(figure, *cells[part])
    return table
