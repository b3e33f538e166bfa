"""`sgam-sfm segment`: the label maps of a collection, to look at, to name, and to match by."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from sgam_sfm.exit_codes import DONE, SOME_FAILED
from sgam_sfm.logs import logging_to

_MAX_LISTED = 32


@dataclass(frozen=True, kw_only=True)
class SegmentOptions:
    """Label maps of a folder of photos, with overlays to look at.

    Writes <image name>.png (ids), overlays/<image name>.jpg and labels.json (ids, colours, names where there are any,
    ignored ones). `sgam-sfm match --labels` reads the folder back, as if it had segmented the photos itself.
    """

    images: Path
    """Folder of photos; sub-folders are searched too."""
    output: Path
    """Folder for the label maps; made when missing."""
    segmenter: str = "coseg"
    """Who makes them: coseg learns regions from the collection itself, without a list of classes; ade20k knows 31
    by name (sky, person, car, ...)."""
    num_labels: int = 0
    """Regions that coseg looks for (0: as many as are stable over seeds)."""
    labels: Path | None = None
    """Label maps made elsewhere, to be checked, coloured and drawn; wins over --segmenter."""
    resize_labels: bool = False
    """Take label maps of another size than their image, resized to it; otherwise that is an error."""
    ignore_labels: str = ""
    """Labels that are to form no areas, comma-separated names or ids; labels.json keeps them for `match`."""
    overlay_size: int = 1200
    """Long side of an overlay in pixels (0: no overlays)."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    threads: int = 0
    """CPU threads (0: all cores)."""
    seed: int = 0
    """Seed of everything random."""
    verbose: bool = False
    """Show the log on the terminal."""


def run(options: SegmentOptions, console: Console) -> int:
    """Segment; say what was found."""
    from sgam_sfm.progress import Stages
    from sgam_sfm.segmentation import segment_collection

    with logging_to(None, console, verbose=options.verbose):
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
