"""The matches of all pairs in one file, a row each, and the keypoints of both sides once these are known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sgam_core.errors import InputError, ShapeError
from sgam_core.types import Matches
from sgam_sfm.merging.affine import fit_maps
from sgam_sfm.merging.compiled import compiled
from sgam_sfm.merging.scratch import Rows, Scratch, batches
from sgam_sfm.pairs import Pair
from sgam_sfm.threads import in_order

_AT_ONCE = 2**15  # matches in one go
_MIN_WEIGHT = 1e-3  # a match of score 0 still has a place
ROWS_A_PART = 2**18  # rows that are sorted in memory

# The columns of a match: its points, sigmas and score, its variance in squared image-1 pixels (below 0 for one that
# does not agree with the geometry of its pair) and the local affine map from image 0 to image 1.
POINTS, SIGMAS, SCORE, VARIANCE, AFFINE = slice(0, 4), slice(4, 6), 6, 7, slice(8, 12)
_WIDTH = 12

RawPair = tuple[Pair, Matches, np.ndarray | None]
"""A pair, its matches, and (M,) which of them agree with its geometry; None for all."""


class PairRows(NamedTuple):
    """Where the matches of a pair are; image0 < image1 are rows in the sorted names."""

    pair: Pair
    image0: int
    image1: int
    begin: int
    length: int


@dataclass(frozen=True, kw_only=True, slots=True)
class RawMatches:
    """All matches; index: the keypoints of both sides of every match, once these are known."""

    names: list[str]
    pairs: list[PairRows]
    rows: Rows
    index: tuple[Rows, Rows]

    def rows_of(self, pairs: Sequence[PairRows]) -> np.ndarray:
        """The matches of some pairs, one after the other."""
        return self.rows.read_parts([(pair.begin, pair.length) for pair in pairs])

    def index_of(self, pairs: Sequence[PairRows]) -> np.ndarray:
        """(M, 2) keypoints of the matches of some pairs, one after the other."""
        parts = [(pair.begin, pair.length) for pair in pairs]
        return np.concatenate([side.read_parts(parts) for side in self.index], axis=1)


def collect(pairs: Iterable[RawPair], scratch: Scratch) -> RawMatches:
    """All matches on disk, pairs in the order of their names.

    Raises: InputError when a pair holds one image twice or comes in both orders; ShapeError for a mask that does not
        fit its matches.
    """
    rows = scratch.rows("matches.rows", _WIDTH, np.float32)
    found: dict[Pair, tuple[Pair, int, int]] = {}
    for told, part in in_order(_rows_of, batches(pairs, lambda raw: len(raw[1]), _AT_ONCE)):
        begin = rows.count
        for pair, count in told:
            key = (min(pair), max(pair))
            if key in found:
                raise InputError(f"the pair of '{key[0]}' and '{key[1]}' comes in both orders; keep one of them")
            found[key] = (pair, begin, count)
            begin += count
        rows.append(part)
    names = sorted({name for key in found for name in key})
    row_of = {name: row for row, name in enumerate(names)}
    sides = [scratch.rows(f"keypoints{side}.rows", 1, np.int32) for side in (0, 1)]
    return RawMatches(
        names=names,
        pairs=[PairRows(pair, row_of[a], row_of[b], *where) for (a, b), (pair, *where) in sorted(found.items())],
        rows=rows,
        index=(sides[0], sides[1]),
    )


def _rows_of(batch: list[RawPair]) -> tuple[list[tuple[Pair, int]], np.ndarray]:
    """Some pairs with the number of their matches, and these as they are kept."""
    masks = [np.ones(len(matches), bool) if mask is None else mask for _, matches, mask in batch]
    for (pair, matches, _), mask in zip(batch, masks, strict=True):
        if pair[0] == pair[1]:
            raise InputError(f"pair ('{pair[0]}', '{pair[1]}') matches an image with itself; remove it from the pairs")
        if mask.shape != (len(matches),) or mask.dtype != np.bool_:
            raise ShapeError(
                f"inliers of pair {pair} are {mask.dtype} {mask.shape}; expected bool ({len(matches)},), one per match"
            )
    told = [(pair, len(matches)) for pair, matches, _ in batch]
    joined = Matches.concatenate([m if pair[0] < pair[1] else m.swapped() for pair, m, _ in batch])
    rows = np.empty((len(joined), _WIDTH), np.float32)
    rows[:, 0:2], rows[:, 2:4] = joined.points0, joined.points1
    rows[:, 4], rows[:, 5], rows[:, SCORE] = joined.sigmas0, joined.sigmas1, joined.scores
    ends = np.cumsum([count for _, count in told])
    trusted = np.concatenate(masks)
    rows[:, AFFINE] = maps = _maps(joined.points0, joined.points1, trusted, ends)
    determinants = maps[:, 0] * maps[:, 3] - maps[:, 1] * maps[:, 2]
    variances = joined.sigmas1.astype(np.float64) ** 2 + np.abs(determinants) * joined.sigmas0**2
    rows[:, VARIANCE] = np.where(trusted, variances, -variances)
    return told, rows


@compiled
def _maps(points0: np.ndarray, points1: np.ndarray, trusted: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """The local maps (M, 4) of matches. Args: ends: of the matches of every pair."""
    maps, begin = np.empty((len(points0), 4)), 0
    for end in ends:
        fit_maps(points0, points1, trusted, begin, end, maps)
        begin = end
    return maps


def weights_of(rows: np.ndarray) -> np.ndarray:
    """What matches count by, above 0."""
    return np.maximum(rows[:, SCORE], np.float32(_MIN_WEIGHT))


def ends_of(pairs: Sequence[PairRows]) -> np.ndarray:
    """Where the matches of every pair end, one after the other."""
    return np.cumsum([pair.length for pair in pairs])


def batches_of(raw: RawMatches) -> Iterator[list[PairRows]]:
    """The pairs that have matches, several together where they have few."""
    return batches((pair for pair in raw.pairs if pair.length), lambda pair: pair.length, _AT_ONCE)
