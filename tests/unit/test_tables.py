"""Tables of figures, on a terminal and in a file."""

import io

from rich.console import Console

from sgam_sfm.tables import print_figures

COLUMNS = [f"tiles-{number}:xfeat-star@budget=m" for number in range(7)]


def printed(*, terminal: bool) -> str:
    file = io.StringIO()
    console = Console(file=file, width=80, force_terminal=terminal, color_system=None)
    print_figures("title", COLUMNS, [("points", ["1"] * len(COLUMNS))], console)
    return file.getvalue()


def test_a_file_gets_the_whole_table_however_wide_it_is():
    text = printed(terminal=False)
    assert "…" not in text
    assert all(column.partition(":")[0] in text for column in COLUMNS)
    assert text.count("points") == 1


def test_a_terminal_gets_some_columns_at_a_time():
    text = printed(terminal=True)
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("points") == 2
