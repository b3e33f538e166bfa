"""The collection that comes with the project: a room is rendered, matched, reconstructed and compared with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sgam_core import AreaState
from sgam_sfm.files import write_json
from sgam_sfm.images import read_image, read_label_map
from sgam_sfm.mapping import pose_errors
from sgam_sfm.options import MatchOptions
from sgam_sfm.pictures import draw_areas, write_png
from sgam_sfm.progress import Stages
from sgam_sfm.runner import match_collection
from sgam_sfm.scene import demo_views, write_scene
from sgam_sfm.store import PairRecord, stored_records
from sgam_sfm.summary import print_summary

_NUM_PICTURES = 4


def run_demo(output: Path, device: str, threads: int, console: Console) -> tuple[MatchOptions, dict[str, Any]]:
    """Render the room, run the main job on it with default options, draw pairs, and print how true the model is.

    Returns: the options of the run and its summary; `summary["truth"]` holds the pose errors.
    """
    stages = Stages(console=console)
    if not (output / "pairs.txt").exists():
        views = demo_views()
        with stages.stage("Rendering the room", len(views)) as advance:
            write_scene(output, views, advance=lambda _: advance(1))
    options = MatchOptions(
        images=output / "images",
        pairs=output / "pairs.txt",
        output=output / "sgam",
        device=device,
        threads=threads,
    )
    summary = match_collection(options, stages)
    drawn = draw_pairs(output, _NUM_PICTURES)
    print_summary(summary, console)
    return options, summary
