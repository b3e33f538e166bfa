"""`sgam-sfm localize`: poses of new photos in a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from sgam_core.wording import counted
from sgam_sfm.exit_codes import DONE, NO_MODEL, SOME_FAILED
from sgam_sfm.logs import logging_to
from sgam_sfm.stage_options import LocalizeOptions

_MAX_REASONS = 10


def run(options: LocalizeOptions, console: Console) -> int:
    """Localize; say what has no pose and why."""
    from sgam_sfm.inputs import refuse_among_images
    from sgam_sfm.localization import localize
    from sgam_sfm.progress import Stages

    refuse_among_images(options.output, options.images)  # before the log is begun there
    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        content = localize(options, Stages(console=console))
    for what, text in poses_told(content):
        console.print(f"{what:<10} {text}", highlight=False, markup=False, soft_wrap=True)
    if not content["localized"]:
        return NO_MODEL
    return SOME_FAILED if content["failed"] else DONE


def poses_told(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The content of localize.json for a terminal: what a line is about, and its text."""
    total = content["localized"] + len(content["failed"])
    lines = [
        (
            "poses",
            f"{content['localized']} of {counted(total, 'photo')}, with {counted(content['references'], 'reference')}",
        )
    ]
    lines += [("failed", f"{name}: {reason}") for name, reason in list(content["failed"].items())[:_MAX_REASONS]]
    if len(content["failed"]) > _MAX_REASONS:
        lines.append(("", f"and {len(content['failed']) - _MAX_REASONS} more, in localize.json"))
    return lines
