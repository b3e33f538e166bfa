"""Guided areas: where a first round of matches shows both images to overlap, looked at again as finely as is worth it.

Not in the paper, whose areas are matched once at one size. What a crop gains over the whole image is resolution, so a
second round spends its pixels on the ground that both images share and nowhere twice: few windows that cover it, of
both images at the scale at which things have one size, up to the resolution of the coarser one. Small photos, of which
the first round has seen all, are enlarged: networks whose cells are many pixels wide place points more exactly so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int

from sgam_core.covisible import Frame, enclosing_box
from sgam_core.options import CropOptions, GuidanceOptions
from sgam_core.types import Area, AreaMatch, Box, Matches

_MOST_SLANTED = 4.0  # matches along a line fit any map across it
_STRAY = 0.05  # a smaller share of a window's matches is no reason to look there


@dataclass(frozen=True, kw_only=True, slots=True)
class _Window:
    """What some matches enclose in both images.

    scales: of its crops, matcher pixels per image pixel. sigma: of the matches, image pixels per matcher
    pixel.
    """

    boxes: tuple[Box, Box]
    scales: tuple[float, float]
    sigma: float

    @property
    def gain(self) -> float:
        """How much finer the coarser of its crops is than the matches are."""
        return self.sigma * min(self.scales)

    def resized(self, factor: float) -> _Window:
        """The same with crops so many times the size."""
        return replace(self, scales=(self.scales[0] * factor, self.scales[1] * factor))

    @property
    def pixels(self) -> float:
        """Of both crops."""
        return sum(box.area * scale**2 for box, scale in zip(self.boxes, self.scales, strict=True))

    @property
    def sides(self) -> list[float]:
        """Width and height of the first crop, then of the second."""
        return [
            side * scale for box, scale in zip(self.boxes, self.scales, strict=True) for side in (box.width, box.height)
        ]


def guided_areas(
    matches: Matches, frame0: Frame, frame1: Frame, crop: CropOptions, options: GuidanceOptions
) -> tuple[AreaMatch, ...]:
    """Area matches that cover what the matches show in both images.

    `scale0`, `scale1` say how finely each is to be cropped: within `area_size` a side and `max_crop_pixels` in all.

    Args: matches: consistent with one geometry. frame0, frame1: the images.
    Returns: none with too few matches, or where crops would be no finer than the matches are.
    """
    if len(matches) < max(options.min_matches, 1):
        return ()
    rows = np.arange(len(matches))
    finest = most_enlarged(max(frame0.width, frame0.height, frame1.width, frame1.height), crop, options)
    whole = _window(matches, rows, frame0, frame1, options).resized(finest)
    largest = crop.area_size / _within_budget([whole], crop) / finest
    windows = [window.resized(finest) for window in _split(matches, rows, frame0, frame1, largest, options)]
    fitting = [window.resized(min(1.0, crop.area_size / max(window.sides))) for window in windows]
    factor = _within_budget(fitting, crop)
    finer = [window for window in (window.resized(factor) for window in fitting) if window.gain >= options.min_gain]
    return tuple(
        AreaMatch(
            area0=Area(kind="guided", box=window.boxes[0]),
            area1=Area(kind="guided", box=window.boxes[1]),
            distance=0.0,
            scale0=window.scales[0],
            scale1=window.scales[1],
        )
        for window in finer
    )


def most_enlarged(longest: int, crop: CropOptions, options: GuidanceOptions) -> float:
    """Crop pixels per image pixel at most: 1 where whole images are seen at much less than their own resolution.

    Args: longest: side of the images, pixels.
    """
    if not options.max_upsampling:
        return crop.area_size  # a pixel fills a crop
    return max(1.0, options.max_upsampling * min(1.0, crop.image_size / longest))


def warp_between(matches: Matches, area: AreaMatch, options: GuidanceOptions) -> Float[np.ndarray, "2 3"] | None:
    """The affine map from image 0 to image 1 that the matches of an area follow; None where they follow none closely.

    Seen through it, what is slanted in one image alone looks alike in both.
    """
    chosen = matches.select(area.joins(matches))
    if len(chosen) < max(options.min_matches, 4) or not options.max_bend:  # three fit any map
        return None
    affine, _ = cv2.estimateAffine2D(chosen.points0, chosen.points1, method=cv2.LMEDS)
    if affine is None or not _is_view(affine[:, :2]):
        return None
    off = np.linalg.norm(chosen.points0 @ affine[:, :2].T + affine[:, 2] - chosen.points1, axis=1)
    longest = max(area.area1.box.width, area.area1.box.height)
    return affine if np.median(off) <= options.max_bend * longest else None


def _is_view(linear: Float[np.ndarray, "2 2"]) -> bool:
    """Whether a linear map may be of what two images show: it mirrors nothing and slants nothing beyond recognition."""
    widest, narrowest = np.linalg.svd(linear, compute_uv=False)
    return bool(np.linalg.det(linear) > 0 and widest < _MOST_SLANTED * narrowest)


def _within_budget(windows: Sequence[_Window], crop: CropOptions) -> float:
    """What all crops are to be scaled by to stay within the pixels of a pair."""
    total = sum(window.pixels for window in windows)
    return min(1.0, (crop.max_crop_pixels / total) ** 0.5) if crop.max_crop_pixels else 1.0


def _split(
    matches: Matches,
    rows: Int[np.ndarray, " N"],
    frame0: Frame,
    frame1: Frame,
    largest: float,
    options: GuidanceOptions,
) -> Sequence[_Window]:
    """Windows at their images' own resolution, no side of whose crops exceeds `largest`, halved where they would."""
    window = _window(matches, rows, frame0, frame1, options)
    sides = window.sides
    longest = int(np.argmax(sides))
    if sides[longest] <= largest or len(rows) < 2 * options.min_matches:
        return [window]
    points = (matches.points0, matches.points1)[longest // 2][rows, longest % 2]
    box = window.boxes[longest // 2]
    low = points < ((box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2)[longest % 2]
    parts = [part for part in (rows[low], rows[~low]) if len(part) >= _STRAY * len(rows)]
    if min(map(len, parts)) < options.min_matches or len(parts[0]) == len(rows):
        return [window]
    return [leaf for part in parts for leaf in _split(matches, part, frame0, frame1, largest, options)]


def _window(
    matches: Matches, rows: Int[np.ndarray, " N"], frame0: Frame, frame1: Frame, options: GuidanceOptions
) -> _Window:
    chosen = matches.select(rows)
    boxes = (
        enclosing_box(chosen.points0, chosen.scores, frame0, options.quantile, options.margin),
        enclosing_box(chosen.points1, chosen.scores, frame1, options.quantile, options.margin),
    )
    ratio = _size_ratio(chosen.points0, chosen.points1)
    return _Window(boxes=boxes, scales=(min(1.0, ratio), min(1.0, 1 / ratio)), sigma=float(np.median(chosen.sigmas)))


def _size_ratio(points0: Float[np.ndarray, "N 2"], points1: Float[np.ndarray, "N 2"]) -> float:
    """How much larger things are in image 1: the median over distances between matches half the list apart."""
    other = np.roll(np.arange(len(points0)), len(points0) // 2)
    apart = [np.linalg.norm(points[other] - points, axis=1) for points in (points0, points1)]
    known = (apart[0] > 0) & (apart[1] > 0)
    return float(np.median(apart[1][known] / apart[0][known])) if known.any() else 1.0
