"""Pairs that another program chose: of COLMAP's database, of hloc's matches.h5, of a text list."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from sgam_core.errors import InputError
from sgam_sfm.colmap.reading import read_match_counts
from sgam_sfm.hloc_files import read_match_counts_h5
from sgam_sfm.pairs import Pair, read_pairs

_log = logging.getLogger(__name__)

_SQLITE, _HDF5 = b"SQLite format 3\0", b"\x89HDF\r\n\x1a\n"


def existing_pairs(path: Path, names: Sequence[str], min_matches: float) -> list[Pair]:
    """The pairs of a file among the given images, those with few matches left out where the file tells their number.

    Raises: InputError when the file cannot be used, or a text list names other images.
    """
    if path.is_dir():
        raise InputError(f"'{path}' is a folder; give a file, or a COLMAP model to `sgam-sfm pairs from-model --model`")
    start = b""
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(len(_SQLITE))
    if start.startswith(_SQLITE):
        return _matched(_of_database(path, names), min_matches, path)
    if start.startswith(_HDF5):
        return _matched(read_match_counts_h5(path, names), min_matches, path)
    return list(read_pairs(path, names).pairs)


def _of_database(path: Path, names: Sequence[str]) -> dict[Pair, int]:
    """Counts of matches between the given images."""
    counts, known = read_match_counts(path), set(names)
    others = sorted({name for pair in counts for name in pair} - known)
    if others:
        _log.warning("'%s' has %d images that are not in the folder, such as '%s'", path, len(others), others[0])
    found = {pair: count for pair, count in counts.items() if known.issuperset(pair)}
    if not found:
        hint = f" (it has '{others[0]}', the folder '{names[0]}')" if others else ""
        raise InputError(
            f"'{path}' has matches of no pair of the {len(names)} images{hint}; names are relative to the image folder"
        )
    return found


def _matched(counts: Mapping[Pair, int], min_matches: float, path: Path) -> list[Pair]:
    found = [pair for pair, count in counts.items() if count >= min_matches]
    if not found:
        raise InputError(
            f"no pair in '{path}' has {min_matches:g} matches, the best one has {max(counts.values())}; "
            "lower --min-score"
        )
    return found
