"""hloc's HDF5 files: write keypoints and matches for the tools that read those, read descriptors and pairs.

hloc puts the origin at the centre of the first pixel, so its coordinates are ours minus 0.5. In the matches file it
writes `/` in image names as `-` (hloc/utils/parsers.py, names_to_pair).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float32

from sgam_core.errors import InputError, ShapeError
from sgam_sfm.files import replacing, require_space
from sgam_sfm.pairs import Pair

_log = logging.getLogger(__name__)

_GROUP_BYTES = 1500  # a pair, before its arrays
_H5_OVERHEAD = 8192  # bytes a group, generously: on a full disk HDF5 ends the process instead of raising an error


def write_keypoints_h5(path: Path, keypoints: Mapping[str, np.ndarray]) -> None:
    """Write `/<name>/keypoints`, float32 (N, 2), first pixel's centre at (0, 0).

    Args: keypoints: (N, 2) pixels of every image, corner origin.
    Raises: ShapeError when an array is not (N, 2).
    """
    require_space(path, sum(_H5_OVERHEAD + 8 * len(points) for points in keypoints.values()))
    with replacing(path) as partial, h5py.File(partial, "w") as file:
        for name in sorted(keypoints):
            points = keypoints[name]
            if points.ndim != 2 or points.shape[1] != 2:
                raise ShapeError(f"keypoints of '{name}' have shape {points.shape}; expected (N, 2)")
            file[f"{name}/keypoints"] = (np.asarray(points, np.float64) - 0.5).astype(np.float32)


def matches_h5_size(pairs: Iterable[Pair], keypoint_counts: Mapping[str, int]) -> int:
    """About how many bytes a matches file takes."""
    return sum(_GROUP_BYTES + 6 * keypoint_counts[pair[0]] for pair in pairs)


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
        for pair in sorted(matches):
            indices = matches[pair]
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


def read_global_descriptors(path: Path, names: Sequence[str]) -> dict[str, Float32[np.ndarray, " D"]]:
    """`/<name>/global_descriptor` of the images that have one.

    Raises: InputError when the file cannot be read, has none of the images, or holds what is no descriptor.
    """
    found: dict[str, np.ndarray] = {}
    with _opened(path) as file:
        for name in names:
            if isinstance(data := file.get(f"{name}/global_descriptor"), h5py.Dataset):
                found[name] = np.asarray(data, np.float32).ravel()
                size = len(next(iter(found.values())))
                if len(found[name]) != size or not size or not np.isfinite(found[name]).all():
                    raise InputError(
                        f"descriptor of '{name}' in '{path}' has {len(found[name])} numbers; expected {size}, as the "
                        "others, none of them NaN: extract it again"
                    )
        inside = next(iter(file), "")
    if not found:
        raise InputError(
            f"'{path}' has a data set '<image name>/global_descriptor' for none of the {len(names)} images (it holds "
            f"'{inside}', the images are like '{names[0]}'); names are relative to the image folder, and "
            "`python -m hloc.extract_features --conf netvlad` makes such a file"
        )
    return found


def read_match_counts_h5(path: Path, names: Sequence[str]) -> dict[Pair, int]:
    """How many matches every pair of the given images has in a matches file.

    Raises: InputError when the file cannot be read, names none of the pairs, or could mean two images by one name.
    """
    if alike := _alike(names):
        raise InputError(
            f"images '{alike[0]}' and '{alike[1]}' are both '{_flat(alike[0])}' in '{path}', since hloc writes '/' as "
            "'-'; give hloc's pairs.txt instead"
        )
    original = {_flat(name): name for name in names}
    counts: dict[Pair, int] = {}
    inside = ""
    with _opened(path) as file:
        for flat0, partners in file.items():
            for flat1, group in partners.items() if isinstance(partners, h5py.Group) else ():
                inside = f"{flat0}/{flat1}"
                matches = group.get("matches0") if isinstance(group, h5py.Group) else None
                if isinstance(matches, h5py.Dataset) and flat0 in original and flat1 in original:
                    counts[original[flat0], original[flat1]] = int(np.count_nonzero(np.asarray(matches) >= 0))
    if not counts:
        raise InputError(
            f"'{path}' has matches ('<name>/<name>/matches0') of no pair of the {len(names)} images"
            f"{f' (it holds {inside!r})' if inside else ''}; names are relative to the image folder"
        )
    return counts


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Raises: InputError when it is no HDF5 file, or damaged where it is read."""
    if not path.is_file():
        raise InputError(f"there is no file '{path}'; give an h5 file of hloc")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"'{path}' cannot be read as an h5 file of hloc ({reason}); copy or make it again") from error


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
