"""One area an image: where the matches of a first pass lie, matched again (the two stages of MKPC and OETR).

Source: what the paper compares itself with, its Sec. II-C and results on YFCC100M; here the first stage is the point
matcher itself instead of a network that estimates the overlap.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int32

from sgam_core.crops import box_crop, whole_pixels
from sgam_core.geometry import estimate_two_view, residuals
from sgam_core.options import CovisibleOptions, CropOptions, GeometryOptions
from sgam_core.types import Area, AreaMatch, Box, Crop, Image, Matches, PutativeAreas


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Frame:
    """An image without its pixels: name, size in pixels, (3, 3) camera matrix when known."""

    name: str
    width: int
    height: int
    camera_matrix: Float[np.ndarray, "3 3"] | None

    @staticmethod
    def of(image: Image) -> Frame:
        return Frame(name=image.name, width=image.width, height=image.height, camera_matrix=image.camera_matrix)

    @property
    def box(self) -> Box:
        return Box(x0=0, y0=0, x1=self.width, y1=self.height)


@dataclass(frozen=True, kw_only=True, slots=True)
class CovisibleAreaMatcher:
    """The matched part of both images as one area match, as an `AreaMatcher`."""

    needs_labels: ClassVar[bool] = False
    options: CovisibleOptions = field(default_factory=CovisibleOptions)
    geometry: GeometryOptions = field(default_factory=GeometryOptions)

    def describe(self, image: Image, labels: Int32[np.ndarray, "H W"] | None) -> Frame:
        """The image's size and camera."""
        return Frame.of(image)

    def match(self, description0: Frame, description1: Frame, match_whole: Callable[[], Matches]) -> PutativeAreas:
        """One area match; none with too few matches, or where whole images would be matched once more."""
        whole = match_whole()
        used = consistent(whole, description0, description1, self.geometry) if self.options.verify else whole
        if len(used) < max(self.options.min_matches, 1):
            return PutativeAreas()
        quantile, margin = self.options.quantile, self.options.margin
        box0 = enclosing_box(used.points0, used.scores, description0, quantile, margin)
        box1 = enclosing_box(used.points1, used.scores, description1, quantile, margin)
        if (box0, box1) == (description0.box, description1.box):
            return PutativeAreas()
        area0, area1 = Area(kind="covisible", box=box0), Area(kind="covisible", box=box1)
        return PutativeAreas(confident=(AreaMatch(area0=area0, area1=area1, distance=1 - len(used) / len(whole)),))

    def crop(self, image: Image, box: Box, options: CropOptions) -> Crop:
        """The box itself, at least at the size of a whole image, which it replaces."""
        return box_crop(image, box, max(options.image_size, options.area_size), options.max_upsampling)


def consistent(matches: Matches, frame0: Frame, frame1: Frame, geometry: GeometryOptions) -> Matches:
    """The matches that agree with one robust geometry of the pair; all of them where they give none.

    It is estimated with the images in the order of their names: the estimator is random, and its answer must not
    depend on which image comes first.
    """
    swap = (frame0.name, frame0.width, frame0.height) > (frame1.name, frame1.width, frame1.height)
    ordered = matches.swapped() if swap else matches
    first, second = (frame1, frame0) if swap else (frame0, frame1)
    model = estimate_two_view(ordered, first.camera_matrix, second.camera_matrix, geometry)
    return matches if model is None else matches.select(residuals(model.F, ordered) <= geometry.max_residual)


def enclosing_box(
    points: Float[np.ndarray, "N 2"], scores: Float[np.ndarray, " N"], frame: Frame, quantile: float, margin: float
) -> Box:
    """The box about all but the outermost points and its margin, in whole pixels of the image.

    Args: quantile: share of the points, weighted by score, left out at each side. margin: added on each side, share of
        the long side.
    """
    low, high = (sign * _quantile(sign * points, scores, quantile) for sign in (1, -1))
    added = margin * float((high - low).max())
    x0, x1 = whole_pixels(float(low[0]) - added, float(high[0]) + added, frame.width)
    y0, y1 = whole_pixels(float(low[1]) - added, float(high[1]) + added, frame.height)
    return Box(x0=x0, y0=y0, x1=x1, y1=y1)


def _quantile(points: np.ndarray, weights: np.ndarray, share: float) -> np.ndarray:
    """Of each column the smallest value that, with all below it, has at least this share of the weight."""
    order = np.argsort(points, axis=0, kind="stable")
    summed = np.cumsum(weights.astype(np.float64)[order], axis=0)
    rows = (summed < share * summed[-1]).sum(axis=0)
    return np.take_along_axis(points, order, axis=0)[rows, [0, 1]]
