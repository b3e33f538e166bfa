"""Write into a COLMAP database that holds other work: what is there stays, what is ours is appended."""

from __future__ import annotations

import logging
import sqlite3
import tempfile
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Collection, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

from sgam_core.errors import InputError
from sgam_sfm.colmap.database import changing_copy, check_keypoints, check_matches, copy_database
from sgam_sfm.colmap.reading import opened
from sgam_sfm.pairs import Pair

_log = logging.getLogger(__name__)

# What COLMAP's longer forms of a keypoint say after x and y, for one without scale and orientation.
_SHAPES = {2: (), 4: (1.0, 0.0), 6: (1.0, 0.0, 0.0, 1.0)}

Stamp = tuple[tuple[int, int], ...]
"""Sizes and times of a database's files: another one means that somebody has written."""


def stamp_of(path: Path) -> Stamp:
    """The stamp of a database.

    Raises: InputError when the file is missing, no COLMAP database, or made by a newer COLMAP than the one installed.
    """
    if not path.is_file():
        raise InputError(f"--database '{path}' does not exist; give a COLMAP database, or leave --database out")
    made, ours = _version(path), _installed_version()
    if made > ours:
        raise InputError(
            f"--database '{path}' was made by a newer COLMAP (its version number is {made}, pycolmap "
            f"{pycolmap.__version__} writes {ours}); upgrade pycolmap"
        )
    files = (path, path.with_name(path.name + "-wal"))
    return tuple((file.stat().st_mtime_ns, file.stat().st_size) for file in files if file.exists())


def require_no_descriptors(path: Path, copy: Path, names: Collection[str]) -> None:
    """Refuse images whose keypoints have descriptors, which ours have not.

    Args: copy: of the database, to look into (COLMAP writes to a file that it opens).
    Raises: InputError that names one.
    """
    with opened(copy) as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
        described = sorted(n for n in names if n in images and database.num_descriptors_for_image(images[n]))
    if described:
        raise InputError(
            f"{len(described)} images, such as '{described[0]}', have descriptors in --database '{path}'; ours have "
            "none, and COLMAP's own matchers expect one for every keypoint: pass --append when those have done their "
            "work (existing keypoints keep their numbers, ours follow them)"
        )


def append_to_database(
    path: Path, imported: Path, keypoints: Mapping[str, np.ndarray], matches: Mapping[Pair, np.ndarray]
) -> None:
    """Write a database with ours after what is in another one; it appears at `path` only when it is complete.

    Keypoints that are there keep their rows, matches too. A pair that gets matches loses its two-view geometry, which
    was estimated without them; other pairs stay as they are. Doing it twice adds nothing.

    Args: imported: a database that has all images. keypoints: (N, 2) pixels by image name, corner origin. matches:
        (M, 2) rows of these keypoints by pair, one-to-one.
    Raises: ShapeError for arrays as `write_database` does, InputError for keypoints of an unknown kind.
    """
    with changing_copy(imported, path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        first, counts = {}, {}
        for name in sorted(keypoints):
            points = keypoints[name]
            first[name], counts[name] = _append(database, ids[name], name, points), len(points)
        for pair in sorted(matches):
            rows = matches[pair]
            check_matches(pair, rows, (counts[pair[0]], counts[pair[1]]))
            id0, id1 = (ids[name] for name in pair)
            ours = rows.astype(np.int64) + [first[name] for name in pair]
            there = np.asarray(database.read_matches(id0, id1), np.int64).reshape(-1, 2)
            new = ours[~np.isin(_keys(ours), _keys(there))]
            if not len(new):
                continue
            if database.exists_matches(id0, id1):
                database.delete_matches(id0, id1)
            if database.exists_two_view_geometry(id0, id1):
                database.delete_two_view_geometry(id0, id1)
            database.write_matches(id0, id1, np.concatenate([there, new]).astype(np.uint32))


def replace_database(path: Path, made: Path, before: Stamp) -> None:
    """Put a database that was made from another one in its place.

    Args: before: stamp of the old one when it was read.
    Raises: InputError when it has changed since.
    """
    if stamp_of(path) != before:
        raise InputError(
            f"another program has written to --database '{path}' while this run lasted; start the same command again "
            "(no pair is matched twice)"
        )
    if _version(path) < _version(made):
        _log.warning("%s was made by an older COLMAP; it is now in the format of %s", path, pycolmap.__version__)
    copy_database(made, path)


def _append(database: pycolmap.Database, image_id: int, name: str, points: np.ndarray) -> int:
    """Add keypoints to an image. Returns: the row of the first of them."""
    check_keypoints(name, points)
    points = np.asarray(points, np.float32)
    exists = database.exists_keypoints(image_id)
    there = np.asarray(database.read_keypoints(image_id), np.float32) if exists else np.zeros((0, 2), np.float32)
    start = len(there) - len(points)
    if start >= 0 and np.array_equal(there[start:, :2], points):
        return start
    columns = there.shape[1] if len(there) else 2
    if columns not in _SHAPES:
        raise InputError(
            f"keypoints of '{name}' have {columns} columns in the database; COLMAP knows 2, 4 and 6: make it anew"
        )
    shape = np.tile(np.array(_SHAPES[columns], np.float32), (len(points), 1))
    both = np.concatenate([there.reshape(-1, columns), np.concatenate([points, shape], axis=1)])
    (database.update_keypoints if exists else database.write_keypoints)(image_id, np.ascontiguousarray(both))
    return len(there)


def _keys(rows: np.ndarray) -> np.ndarray:
    """One number a match."""
    return rows[:, 0] << 32 | rows[:, 1]


def _version(path: Path) -> int:
    """COLMAP's number of the version that made a database."""
    try:
        with closing(sqlite3.connect(path)) as database:
            return int(database.execute("PRAGMA user_version").fetchone()[0])
    except sqlite3.DatabaseError as error:
        raise InputError(f"--database '{path}' is not a COLMAP database ({error})") from error


def _installed_version() -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "empty.db")
        pycolmap.Database.open(path).close()
        return _version(path)
