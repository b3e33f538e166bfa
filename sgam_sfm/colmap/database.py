"""COLMAP's database as a file: write keypoints and matches, copy it, replace it when all went well.

Pixels have COLMAP's corner origin, as everywhere in this project: nothing is shifted here.
"""

from __future__ import annotations

import sqlite3
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from sgam_core.errors import InputError, ShapeError, StageError
from sgam_sfm.colmap.reading import require_database
from sgam_sfm.files import replacing, require_space
from sgam_sfm.pairs import Pair

_SMALLEST_DATABASE = 2**20  # bytes, generously


def write_database(
    path: Path, imported: Path, keypoints: Mapping[str, np.ndarray], matches: Mapping[Pair, np.ndarray]
) -> None:
    """Write a database that is ready to be verified and mapped; it appears at `path` only when it is complete.

    Arrays are asked for one at a time.

    Args: imported: database of `import_cameras`, whose images and cameras are copied (it may be `path` itself).
        keypoints: (N, 2) pixels by image name, corner origin; an image left out gets none. matches: (M, 2) indices of
        keypoints by pair, one-to-one.
    Raises: ShapeError when an array has another shape, an index is out of range or used twice; InputError when a name
        is not in the database.
    """
    with changing_copy(imported, path) as database:
        database.clear_two_view_geometries()
        database.clear_matches()
        database.clear_descriptors()
        database.clear_keypoints()
        ids = {image.name: image.image_id for image in database.read_all_images()}
        unknown = ({*keypoints} | {name for pair in matches for name in pair}) - {*ids}
        if unknown:
            raise InputError(f"image '{min(unknown)}' is not in {imported}; import its camera first")
        counts = dict.fromkeys(ids, 0)
        with pycolmap.DatabaseTransaction(database):
            for name, image_id in sorted(ids.items(), key=lambda item: item[1]):
                points = keypoints.get(name, np.zeros((0, 2), np.float32))
                check_keypoints(name, points)
                counts[name] = len(points)
                database.write_keypoints(image_id, np.ascontiguousarray(points, np.float32))
            for pair in sorted(matches, key=lambda pair: sorted(ids[name] for name in pair)):
                if pair[::-1] in matches:
                    raise InputError(f"the pair {pair} has matches in both directions; give them in one")
                indices = matches[pair]
                check_matches(pair, indices, (counts[pair[0]], counts[pair[1]]))
                database.write_matches(ids[pair[0]], ids[pair[1]], np.ascontiguousarray(indices, np.uint32))


@contextmanager
def changing_copy(source: Path, target: Path) -> Iterator[pycolmap.Database]:
    """A copy of a database to change; it takes the place of `target` (which may be the source) when all went well."""
    with replacing_database(target) as partial:
        backup(source, partial)
        with pycolmap.Database.open(partial) as database:
            yield database


def check_keypoints(name: str, points: np.ndarray) -> None:
    """Raises: ShapeError for anything but finite pixels (N, 2)."""
    # COLMAP accepts more columns than it documents and ends the process when it verifies them.
    if points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind != "f":
        raise ShapeError(f"keypoints of '{name}' are {points.dtype} {points.shape}; expected float32 (N, 2)")
    if not np.isfinite(points).all():
        raise ShapeError(f"keypoints of '{name}' contain values that are not finite")


def check_matches(pair: Pair, indices: np.ndarray, counts: tuple[int, int]) -> None:
    """Raises: ShapeError for anything but one-to-one matches (M, 2) of so many keypoints."""
    # COLMAP checks none of this: out-of-range indices read foreign memory, repeated ones bend the geometry.
    if indices.ndim != 2 or indices.shape[1] != 2 or indices.dtype.kind not in "iu":
        raise ShapeError(f"matches of {pair} are {indices.dtype} {indices.shape}; expected uint32 (M, 2)")
    for side in (0, 1):
        column = indices[:, side]
        if len(column) and (column.min() < 0 or column.max() >= counts[side]):
            raise ShapeError(
                f"matches of {pair} name keypoint {column.max() if column.min() >= 0 else column.min()} of "
                f"'{pair[side]}', which has {counts[side]}"
            )
        if len(column) and np.bincount(column).max() > 1:
            raise ShapeError(f"matches of {pair} use a keypoint of '{pair[side]}' more than once; expected one-to-one")


def copy_database(source: Path, target: Path) -> None:
    """Copy a database with what is still in its journal; an older `target` is replaced once the copy is whole.

    Raises: InputError when there is none; StageError when it cannot be read.
    """
    with replacing_database(target) as partial:
        backup(source, partial)


def is_whole(path: Path) -> bool:
    """Whether a database has all its pages, as one that was cut short has not."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            (num_images,) = database.execute("SELECT COUNT(*) FROM images").fetchone()
            return num_images > 0 and database.execute("PRAGMA quick_check(1)").fetchone() == ("ok",)
    except sqlite3.Error:
        return False


def backup(source: Path, target: Path) -> None:
    """Copy a database with what is still in its journal, straight onto `target`.

    Raises: InputError when there is none; StageError when it cannot be read.
    """
    require_database(source)
    try:
        with closing(sqlite3.connect(source)) as old, closing(sqlite3.connect(target)) as new:
            old.backup(new)
    except sqlite3.Error as error:
        raise StageError(f"cannot copy the database {source}: {error}") from error


@contextmanager
def replacing_database(path: Path) -> Iterator[Path]:
    """A database beside `path` that takes its place, without the journals of either, when all went well."""
    require_space(path, _SMALLEST_DATABASE)  # COLMAP would not say why it cannot open one
    with replacing(path) as partial:
        try:
            yield partial
            _remove_journals(path)  # the old one's would be applied to the new one
        finally:
            _remove_journals(partial)


def _remove_journals(path: Path) -> None:
    for suffix in ("-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
