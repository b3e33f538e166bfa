"""Tables of figures on the terminal: one figure a row, one method or variant a column."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

_MAX_COLUMNS = 5  # that fit into 80 characters
_NO_LIMIT = 100_000  # characters: pipes and logs of jobs have no width


def print_figures(
    title: str, columns: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], console: Console
) -> None:
    """Print the rows that have any cell; names are broken where their parts end.

    A terminal gets some columns at a time; a file or pipe gets all of them, however wide they are.
    """
    at_once = _MAX_COLUMNS if console.is_terminal else max(len(columns), 1)
    if not console.is_terminal:
        console = Console(file=console.file, width=_NO_LIMIT)
    shown = [(figure, cells) for figure, cells in rows if any(cells)]
    for start in range(0, len(columns), at_once):
        part = slice(start, start + at_once)
        table = Table(title=title if start == 0 else None, title_justify="left")
        table.add_column("", no_wrap=True)
        for name in columns[part]:
            table.add_column(re.sub(r"[:@,] ?| ", "\n", name), justify="right", no_wrap=True)
        for figure, cells in shown:
            table.add_row(figure, *cells[part])
        console.print(table)
