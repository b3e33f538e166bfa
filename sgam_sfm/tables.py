"""Tables of figures on the terminal: one figure a row, one method or variant a column."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

_MAX_COLUMNS = 5  # that fit into 80 characters


def print_figures(
    title: str, columns: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], console: Console
) -> None:
    """Print the rows that have any cell, some columns at a time; names are broken where their parts end."""
    shown = [(figure, cells) for figure, cells in rows if any(cells)]
    for start in range(0, len(columns), _MAX_COLUMNS):
        part = slice(start, start + _MAX_COLUMNS)
        table = Table(title=title if start == 0 else None, title_justify="left")
        table.add_column("", no_wrap=True)
        for name in columns[part]:
            table.add_column(re.sub(r"[:@,] ?| ", "\n", name), justify="right", no_wrap=True)
        for figure, cells in shown:
            table.add_row(figure, *cells[part])
        console.print(table)
