"""Readers of ground truth, one file a format; `read_ground_truth` finds the one that fits."""

from __future__ import annotations

from pathlib import Path

from sgam_core.errors import InputError, OptionError
from sgam_sfm.evaluation.ground_truth import (
    camera_table,
    colmap,
    image_matching_benchmark,
    kitti360,
    matterport3d,
    megadepth1500,
    pair_list,
    scannet,
    scannet1500,
    strecha,
    yfcc100m,
)
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.nearest import unknown

__all__ = ["FORMATS", "Format", "GroundTruth", "TrueView", "read_ground_truth"]

# Whole data sets come first: a folder of one may look like a scene too.
_MODULES = (
    scannet1500,
    megadepth1500,
    yfcc100m,
    kitti360,
    scannet,
    strecha,
    image_matching_benchmark,
    colmap,
    camera_table,
    pair_list,
    matterport3d,  # looks through sub-folders
)
FORMATS: dict[str, Format] = {module.FORMAT.name: module.FORMAT for module in _MODULES}
"""Every format by name, in the order in which they are tried."""


def read_ground_truth(path: Path, format: str | None = None, images: Path | None = None) -> GroundTruth:
    """Read ground truth from a file or folder.

    Args: format: a key of FORMATS, None to detect it. images: folder of the images, None for where the format has them;
        only formats that do not tell the sizes of the images read it.
    Raises: InputError when there is nothing there, no format fits, or the files are wrong; OptionError for an unknown
        format.
    """
    if format is not None and format not in FORMATS:
        raise OptionError(unknown("ground-truth format", format, FORMATS))
    if not path.exists():
        raise InputError(f"there is no ground truth at '{path}'; give a file or folder")
    chosen = FORMATS[format] if format else next((found for found in FORMATS.values() if found.detects(path)), None)
    if chosen is None:
        known = "; ".join(f"{found.name}: {found.expects}" for found in FORMATS.values())
        raise InputError(f"'{path}' is no ground truth of a known format; expected one of these. {known}")
    truth = chosen.read(path, images)
    if not truth.views:
        raise InputError(f"'{path}' has no image with a known camera ({chosen.name}); expected {chosen.expects}")
    return truth
