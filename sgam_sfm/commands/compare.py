"""`sgam-sfm compare`: what a method gains over another, and at what price."""

from __future__ import annotations

from rich.console import Console

from sgam_sfm.comparison.options import CompareOptions
from sgam_sfm.exit_codes import DONE
from sgam_sfm.logs import logging_to


def run(options: CompareOptions, console: Console) -> int:
    """Compare; print the table."""
    from sgam_sfm.comparison.compare import compare, print_table
    from sgam_sfm.comparison.report import write_report

    with logging_to(options.output / "log.txt", console, verbose=options.verbose, as_json=options.log_json):
        content = compare(options, console)
    print_table(content, console)
    if options.report:
        report = write_report(options.output, content)
        console.print(f"report     {report}", highlight=False, markup=False, soft_wrap=True)
    return DONE
