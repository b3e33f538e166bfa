"""A run as text files that COLMAP's own programs import, for a database that is made elsewhere.

    keypoints/<image name>.txt  for `colmap feature_importer`: `N 128`, then `x y scale orientation`, 128 zeros a line
    matches.txt                 for `colmap matches_importer --match_type raw`: two names, the matches, an empty line

Pixels have COLMAP's corner origin, as everywhere in this project: nothing is shifted here.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.files import replacing
from sgam_sfm.pairs import Pair

_NO_DESCRIPTOR = " 0" * 128  # COLMAP imports nothing without one; ours are not compared


def write_keypoints_text(folder: Path, keypoints: Iterable[tuple[str, np.ndarray]]) -> int:
    """Write the (N, 2) keypoints of images, with scale 1 and orientation 0, a file each. Returns: how many files."""
    count = 0
    for name, points in keypoints:
        lines = [f"{len(points)} 128\n"]
        lines += [f"{x:.9g} {y:.9g} 1 0{_NO_DESCRIPTOR}\n" for x, y in np.asarray(points, np.float64)[:, :2]]
        with replacing(folder / f"{name}.txt") as partial:
            partial.write_text("".join(lines), encoding="utf-8")
        count += 1
    return count


def write_matches_text(path: Path, matches: Iterable[tuple[Pair, np.ndarray]]) -> int:
    """Write (M, 2) rows of keypoints pair by pair, as they come. Returns: how many pairs.

    Raises: InputError for a name that COLMAP's format cannot hold.
    """
    count = 0
    with replacing(path) as partial, partial.open("w", encoding="utf-8") as file:
        for pair, rows in matches:
            require_plain_names(pair)
            file.write(" ".join(pair) + "\n" + "".join(f"{row0} {row1}\n" for row0, row1 in rows.tolist()) + "\n")
            count += 1
    return count


def require_plain_names(names: Iterable[str]) -> None:
    """Raises: InputError for a name that a file of names divided by spaces cannot hold."""
    spaced = next((name for name in names if len(name.split()) != 1 or name.startswith("#")), None)
    if spaced is not None:
        raise InputError(
            f"image name '{spaced}' cannot be written to COLMAP's matches file, where a space ends a name and # begins "
            "a comment; rename the image, or use OUT/database.db, which holds any name"
        )
