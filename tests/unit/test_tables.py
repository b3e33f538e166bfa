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


def test_a_narrow_terminal_breaks_names_of_methods_and_no_word_of_a_figure():
    file = io.StringIO()
    console = Console(file=file, width=44, force_terminal=True, color_system=None)
    name = "sgam:superpoint-lightglue-with-a-very-long-name"
    print_figures("title", [name, "sift"], [("rotation error, degrees", ["[green]0.123[/]", "123456 ±12"])], console)
    lines = file.getvalue().splitlines()
    assert max(map(len, lines)) <= 44
    assert all(word in file.getvalue() for word in ("rotation", "error,", "degrees", "0.123", "123456 ±12", "sift"))
    names = "".join(line.split("┃")[2].strip() for line in lines[2:10] if line.startswith("┃"))
    assert names == name.replace(":", "")
