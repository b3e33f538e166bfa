"""`sgam-sfm reconstruct`: a model anew from matches that exist, with other mapping options."""

from __future__ import annotations

from rich.console import Console

from sgam_sfm.exit_codes import DONE, NO_MODEL
from sgam_sfm.logs import logging_to
from sgam_sfm.stage_options import ReconstructOptions


def run(options: ReconstructOptions, console: Console) -> int:
    """Map; print the models."""
    from sgam_sfm.progress import Stages
    from sgam_sfm.reconstruction import reconstruct, source_of
    from sgam_sfm.runs.summary import print_models

    with logging_to(source_of(options).output / "log.txt", console, verbose=options.verbose):
        content = reconstruct(options, Stages(console=console))
    print_models(content, console)
    return DONE if content["models"] else NO_MODEL
