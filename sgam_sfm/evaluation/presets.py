"""How the paper evaluates each data set: sizes and angles; and pairs by frame difference."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from sgam_sfm.pairs import Pair


@dataclass(frozen=True, kw_only=True, slots=True)
class DatasetPreset:
    """How a data set is evaluated.

    format: of its ground truth, a key of FORMATS. area_size: side in pixels that areas are matched at (paper, appendix,
    Implementation Details). auc_angles: degrees.
    """

    format: str
    area_size: int
    auc_angles: tuple[float, ...] = (5, 10, 20)


PRESETS: Mapping[str, DatasetPreset] = {
    "scannet": DatasetPreset(format="scannet", area_size=256),
    "scannet1500": DatasetPreset(format="scannet1500", area_size=640),
    "matterport3d": DatasetPreset(format="matterport3d", area_size=480, auc_angles=(10, 20, 30)),
    "kitti360": DatasetPreset(format="kitti360", area_size=480),
    "yfcc100m": DatasetPreset(format="yfcc100m", area_size=480),
    "megadepth1500": DatasetPreset(format="megadepth1500", area_size=640),  # not in the paper
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
