"""How the paper evaluates each data set: sizes, thresholds, angles; and pairs by frame difference."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from sgam_sfm.pairs import Pair


@dataclass(frozen=True, kw_only=True, slots=True)
class DatasetPreset:
    """One data set of the paper.

    format: of its ground truth, a key of FORMATS. area_size: side in pixels that areas are matched at (paper, appendix,
    Implementation Details). error_width: image width in pixels that match errors are reported at. mma_thresholds: in
    those pixels. auc_angles: degrees. max_matches: drawn for MMA and poses (MCN). amp_threshold: of AOR.
    frame_differences: of the pairs it samples from video, empty where a list is published or the sampling is unknown.
    num_pairs: of each. tables: of the paper, by what they show. in_paper: False where we follow others.
    """

    format: str
    area_size: int
    auc_angles: tuple[float, ...] = (5, 10, 20)
    error_width: int = 640
    mma_thresholds: tuple[float, ...] = (1, 2, 3)
    max_matches: int = 500
    amp_threshold: float = 0.7
    frame_differences: tuple[int, ...] = ()
    num_pairs: int | None = None
    tables: tuple[str, ...] = ()
    in_paper: bool = True


PRESETS: Mapping[str, DatasetPreset] = {
    "scannet": DatasetPreset(
        format="scannet",
        area_size=256,
        frame_differences=(5, 10, 30),
        num_pairs=1500,
        tables=("MMA", "pose AUC, ScanNet", "AOR and AMP"),
    ),
    "scannet1500": DatasetPreset(
        format="scannet1500", area_size=640, num_pairs=1500, tables=("pose AUC, ScanNet1500",)
    ),
    "matterport3d": DatasetPreset(
        format="matterport3d",
        area_size=480,
        auc_angles=(10, 20, 30),
        num_pairs=500,
        tables=("MMA", "pose AUC, MatterPort3D"),
    ),
    "kitti360": DatasetPreset(format="kitti360", area_size=480, tables=("pose AUC, KITTI-360",)),
    "yfcc100m": DatasetPreset(format="yfcc100m", area_size=480, num_pairs=4000, tables=("pose AUC, YFCC100M",)),
    "megadepth1500": DatasetPreset(format="megadepth1500", area_size=640, num_pairs=1500, in_paper=False),
}
"""Presets by the name that `--dataset` takes."""


def frame_pairs(
    names: Iterable[str], difference: int, limit: int | None = None, rng: np.random.Generator | None = None
) -> tuple[Pair, ...]:
    """Pairs of frames whose numbers, the last in their file names, are `difference` apart; all before must be equal.

    Args: limit: at most that many, drawn by `rng`; None for all. Returns: sorted by folder and frame number. The paper
    does not say how it drew its pairs (FD@5/10/30), so equal figures cannot be expected from another draw.
    """
    frames: dict[tuple[str, int], str] = {}
    for name in names:
        folder, stem = PurePosixPath(name).parent, PurePosixPath(name).stem
        if found := re.search(r"(\d+)\D*$", stem):
            frames[str(folder / stem[: found.start()]), int(found[1])] = name
    pairs = [
        (name, other)
        for (series, number), name in sorted(frames.items())
        if (other := frames.get((series, number + difference))) is not None
    ]
    if limit is None or len(pairs) <= limit:
        return tuple(pairs)
    drawn = np.sort((rng or np.random.default_rng(0)).choice(len(pairs), limit, replace=False))
    return tuple(pairs[i] for i in drawn)
