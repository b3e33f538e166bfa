"""Write keypoints and matches as hloc's HDF5 files, for the tools that read those.

hloc puts the origin at the centre of the first pixel, so its coordinates are ours minus 0.5. In the matches file it
writes `/` in image names as `-` (hloc/utils/parsers.py, names_to_pair).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from pathlib import Path

import h5py
import numpy as np

from sgam_core.errors import ShapeError
from sgam_sfm.files import replacing, require_space
from sgam_sfm.pairs import Pair

_log = logging.getLogger(__name__)

_H5_OVERHEAD = 8192  # bytes a group, generously: on a full disk HDF5 ends the process instead of raising an error


def write_keypoints_h5(path: Path, keypoints: Mapping[str, np.ndarray]) -> None:
    """Write `/<name>/keypoints`, float32 (N, 2), first pixel's centre at (0, 0).

    Args: keypoints: (N, 2) pixels of every image, corner origin.
    Raises: ShapeError when an array is not (N, 2).
    """
    require_space(path, sum(_H5_OVERHEAD + 8 * len(points) for points in keypoints.values()))
    with replacing(path) as partial, h5py.File(partial, "w") as file:
        for name, points in sorted(keypoints.items()):
            if points.ndim != 2 or points.shape[1] != 2:
                raise ShapeError(f"keypoints of '{name}' have shape {points.shape}; expected (N, 2)")
            file[f"{name}/keypoints"] = (np.asarray(points, np.float64) - 0.5).astype(np.float32)


def write_matches_h5(
    path: Path,
    matches: Mapping[Pair, np.ndarray],
    scores: Mapping[Pair, np.ndarray],
    keypoint_counts: Mapping[str, int],
) -> None:
    """Write `/<a>/<b>/matches0` (int32, one entry a keypoint of a, -1 for none) and `matching_scores0` (float16).

    When two image names become equal in this format, no file is written, a warning names them, and an older file is
    removed, since it would be taken for this one.

    Args: matches: (M, 2) indices of keypoints, each used at most once on side 0; scores: (M,) in [0, 1];
        keypoint_counts: number of keypoints of every image.
    Raises: ShapeError when indices and counts disagree.
    """
    alike = _alike({name for pair in matches for name in pair})
    if alike:
        _log.warning(
            "%s is left out: images '%s' and '%s' are both '%s' in hloc's matches file, which writes '/' as '-'; "
            "rename one of them if you need it (the database is whole)",
            *(path.name, *alike, _flat(alike[0])),
        )
        path.unlink(missing_ok=True)
        return
    require_space(path, sum(_H5_OVERHEAD + 6 * keypoint_counts[pair[0]] for pair in matches))
    with replacing(path) as partial, h5py.File(partial, "w") as file:
        for pair, indices in sorted(matches.items()):
            counts = (keypoint_counts[pair[0]], keypoint_counts[pair[1]])
            if len(indices) != len(scores[pair]):
                raise ShapeError(f"pair {pair} has {len(indices)} matches but {len(scores[pair])} scores")
            if (indices < 0).any() or (indices >= counts).any():
                raise ShapeError(f"matches of pair {pair} point beyond its {counts[0]} and {counts[1]} keypoints")
            matches0 = np.full(counts[0], -1, np.int32)
            scores0 = np.zeros(counts[0], np.float16)
            matches0[indices[:, 0]] = indices[:, 1]
            scores0[indices[:, 0]] = scores[pair]
            if np.count_nonzero(matches0 >= 0) != len(indices):
                raise ShapeError(f"matches of pair {pair} use a keypoint of '{pair[0]}' twice; expected one-to-one")
            group = file.create_group("/".join(map(_flat, pair)))
            group["matches0"] = matches0
            group["matching_scores0"] = scores0


def _flat(name: str) -> str:
    return name.replace("/", "-")


def _alike(names: Iterable[str]) -> Pair | None:
    """Two names that hloc's matches file cannot tell apart."""
    originals: dict[str, str] = {}
    for name in sorted(names):
        other = originals.setdefault(_flat(name), name)
        if other != name:
            return other, name
    return None
