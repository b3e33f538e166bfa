"""A regular grid of overlapping tiles, paired by the matches of a first pass over the whole images.

What large photos are commonly matched with (the tile preselection of deep-image-matching): the baseline for areas that
know nothing of what they show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int32

from sgam_core.covisible import Frame, consistent
from sgam_core.crops import box_crop
from sgam_core.options import CropOptions, GeometryOptions, TileOptions
from sgam_core.types import Area, AreaMatch, Box, Crop, Image, Matches, PutativeAreas


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Grid:
    """The tiles of one image, row by row, in its pixels."""

    frame: Frame
    tiles: tuple[Box, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class TileAreaMatcher:
    """Tiles that whole-image matches join, as an `AreaMatcher`."""

    needs_labels: ClassVar[bool] = False
    options: TileOptions = field(default_factory=TileOptions)
    geometry: GeometryOptions = field(default_factory=GeometryOptions)

    def describe(self, image: Image, labels: Int32[np.ndarray, "H W"] | None) -> Grid:
        """The grid."""
        return Grid(frame=Frame.of(image), tiles=grid(image.width, image.height, self.options))

    def match(self, description0: Grid, description1: Grid, match_whole: Callable[[], Matches]) -> PutativeAreas:
        """The tile pairs with most whole-image matches in common, strongest first."""
        d0, d1, options = description0, description1, self.options
        whole = match_whole()
        used = consistent(whole, d0.frame, d1.frame, self.geometry) if options.verify else whole
        counts, spread = _joined(d0.tiles, d1.tiles, used)
        pairs = np.argwhere(counts >= max(options.min_matches, 1)).tolist()
        ranked = sorted((-counts[i, j], spread[i, j], i, j) for i, j in pairs)
        limit = options.max_pairs or len(ranked)
        # Of equals that the limit would part none is taken: which comes first depends on the order of the images.
        kept = [pair for pair in ranked if limit >= len(ranked) or pair[:2] < ranked[limit][:2]]
        areas0, areas1 = ([Area(kind="tile", box=tile) for tile in d.tiles] for d in (d0, d1))
        found = [
            AreaMatch(area0=areas0[i], area1=areas1[j], distance=1 - float(counts[i, j]) / len(used))
            for _, _, i, j in kept
        ]
        notes = (f"{len(ranked) - len(kept)} tile pairs beyond max_pairs",) if len(kept) < len(ranked) else ()
        return PutativeAreas(confident=tuple(found), notes=notes)

    def crop(self, image: Image, box: Box, options: CropOptions) -> Crop:
        """The tile itself, its long side at most `area_size`."""
        return box_crop(image, box, options.area_size, options.max_upsampling)


def grid(width: int, height: int, options: TileOptions) -> tuple[Box, ...]:
    """Square tiles over an image, evenly spaced, cut to its short side where that is shorter than a tile.

    The side follows the image's long side: the same grid at any resolution, so that `area_size` alone decides how fine
    a tile is matched; tiles of a fixed number of pixels would have that resolution fixed with them.
    """
    side = max(round(options.side_share * max(width, height)), 1)
    columns, rows = (_spans(length, side, options.overlap_share) for length in (width, height))
    return tuple(Box(x0=x0, y0=y0, x1=x1, y1=y1) for y0, y1 in rows for x0, x1 in columns)


def _spans(length: int, side: int, overlap_share: float) -> list[tuple[int, int]]:
    """As few spans of `side` as cover [0, length) with at least this overlap."""
    if side >= length:
        return [(0, length)]
    gaps = math.ceil((length - side) / max(math.floor(side * (1 - overlap_share)), 1))
    return [(start, start + side) for start in (k * (length - side) // gaps for k in range(gaps + 1))]


def _joined(tiles0: Sequence[Box], tiles1: Sequence[Box], matches: Matches) -> tuple[np.ndarray, np.ndarray]:
    """How many matches each tile of image 0 shares with each of image 1, (T, U), and how far from their centres.

    The latter breaks ties: of tiles that overlap where the matches lie, all have as many.
    """
    (inside0, far0), (inside1, far1) = _inside(tiles0, matches.points0), _inside(tiles1, matches.points1)
    return inside0 @ inside1.T, (far0 @ inside1.T + inside0 @ far1.T).round(9)


def _inside(tiles: Sequence[Box], points: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "2 T M"]:
    """Which points lie in which tile (1 or 0), and there their squared distance from its centre, in tile sides."""
    inside = np.array([tile.contains(points) for tile in tiles], np.float64)
    squared = [((points - tile.center) ** 2).sum(axis=1) / max(tile.width, tile.height) ** 2 for tile in tiles]
    return np.stack([inside, inside * np.array(squared)])
