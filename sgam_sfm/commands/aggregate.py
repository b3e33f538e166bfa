"""`sgam-sfm aggregate`: the raw matches of a run merged again, with other settings."""

from __future__ import annotations

from rich.console import Console

from sgam_sfm.exit_codes import DONE, NO_MODEL
from sgam_sfm.logs import logging_to
from sgam_sfm.stage_options import AggregateOptions


def run(options: AggregateOptions, console: Console) -> int:
    """Merge and map; print what came out."""
    from sgam_sfm.progress import Stages
    from sgam_sfm.reconstruction import aggregate, source_of
    from sgam_sfm.runs.summary import print_models

    with logging_to(source_of(options).output / "log.txt", console, verbose=options.verbose):
        content = aggregate(options, Stages(console=console))
    print_models(content, console)
    return DONE if content["models"] or not options.mapping else NO_MODEL
