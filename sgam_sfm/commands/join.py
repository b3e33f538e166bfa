"""`sgam-sfm join`: the shards of a run put together."""

from __future__ import annotations

from rich.console import Console

from sgam_sfm.commands.match import exit_code
from sgam_sfm.logs import logging_to
from sgam_sfm.stage_options import JoinOptions


def run(options: JoinOptions, console: Console) -> int:
    """Join, merge and map; print the summary."""
    from sgam_sfm.progress import Stages
    from sgam_sfm.runs.joining import join, options_of
    from sgam_sfm.runs.summary import print_summary

    whole = options_of(options)  # before the log is begun
    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        summary = join(options, Stages(console=console))
        print_summary(summary, console)
    return exit_code(summary, whole)
