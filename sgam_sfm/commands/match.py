"""`sgam-sfm match`: photos and a pair list in, a COLMAP database and model out."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from sgam_sfm.exit_codes import DONE, NO_MODEL, SOME_FAILED
from sgam_sfm.logs import logging_to
from sgam_sfm.options import MatchOptions


def run(options: MatchOptions, console: Console) -> int:
    """Match and reconstruct; print the summary."""
    from sgam_sfm.external import refuse_unused_script
    from sgam_sfm.inputs import refuse_among_images
    from sgam_sfm.progress import Stages
    from sgam_sfm.runs.runner import match_collection
    from sgam_sfm.runs.summary import print_shard, print_summary

    refuse_unused_script(options, "matcher")
    refuse_unused_script(options, "segmenter")
    refuse_among_images(options.output, options.images)  # before the log is begun there
    with logging_to(options.output / "log.txt", console, verbose=options.verbose, as_json=options.log_json):
        summary = match_collection(options, Stages(console=console))
        (print_shard if options.shard else print_summary)(summary, console)
    return exit_code(summary, options)


def exit_code(summary: dict[str, Any], options: MatchOptions) -> int:
    """What a finished run tells the shell."""
    if options.shard:
        return DONE  # what failed is told by `join`, and must not keep a job scheduler from starting it
    if options.mapping and not summary["models"]:
        return NO_MODEL
    failed = summary["images"]["failed"] or summary["pairs"]["failed"] or summary["pairs"]["of_unusable_images"]
    return SOME_FAILED if failed or summary["labels"].get("failed") else DONE
