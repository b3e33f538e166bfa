"""`sgam-sfm segment`: the label maps of a collection, to look at, to name, and to match by."""

from __future__ import annotations

from rich.console import Console

from sgam_sfm.exit_codes import DONE, SOME_FAILED
from sgam_sfm.logs import logging_to
from sgam_sfm.options import SegmentOptions

_MAX_LISTED = 32


def run(options: SegmentOptions, console: Console) -> int:
    """Segment; say what was found."""
    from sgam_sfm.external import refuse_unused_script
    from sgam_sfm.inputs import refuse_among_images
    from sgam_sfm.progress import Stages
    from sgam_sfm.segmentation import segment_collection

    refuse_unused_script(options, "segmenter")
    refuse_among_images(options.output, options.images)  # before the log is begun there
    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        found = segment_collection(options, Stages(console=console))
    console.print(f"labels     {len(found.labels)}, made by {found.segmenter}: id, name, share of all pixels")
    for label in sorted(found.labels, key=lambda label: -label.share)[:_MAX_LISTED]:
        ignored = ", forms no areas" if label.id in found.ignored else ""
        console.print(
            f"  [{label.colour}]██[/] {label.id:>5} {label.name or '-'} {label.share:.1%}{ignored}", highlight=False
        )
    if len(found.labels) > _MAX_LISTED:
        console.print(f"  and {len(found.labels) - _MAX_LISTED} smaller ones, in labels.json", highlight=False)
    for reason in found.failed.values():
        console.print(f"[red]failed[/]     {reason}", highlight=False, soft_wrap=True)
    console.print(f"next       sgam-sfm match --labels {options.output} ...", highlight=False, soft_wrap=True)
    return SOME_FAILED if found.failed else DONE
