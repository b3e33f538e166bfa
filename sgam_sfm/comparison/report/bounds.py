"""How much of a comparison its report holds, so that thousands of pairs open as quickly as ten."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from sgam_sfm.pictures.canvas import evenly

_Item = TypeVar("_Item")


@dataclass(frozen=True, kw_only=True, slots=True)
class Bounds:
    """At most so many of each; what is left out is left out evenly.

    points, cameras: of a model. thumbnails: of images, thumbnail_side pixels long. gallery: pairs that gained, and as
    many that lost; picture_width: pixels of their pictures. matrix_side: cells of a matrix, each of several images
    where there are more. pose_pairs: pairs whose pose is estimated from their matches, pose_matches of each.
    curve_images: images whose relative poses make the curve of pose errors. curve_points: of a curve. track_length:
    images a track, where the histogram ends.
    """

    points: int = 5000
    cameras: int = 300
    thumbnails: int = 60
    thumbnail_side: int = 128
    gallery: int = 6
    picture_width: int = 1200
    matrix_side: int = 300
    pose_pairs: int = 400
    pose_matches: int = 500
    curve_images: int = 200
    curve_points: int = 500
    track_length: int = 50

    def sentences(self) -> tuple[str, ...]:
        """The bounds, for readers of the report."""
        return (
            f"3D: {self.points:,} points and {self.cameras:,} cameras a model; points far outside are not drawn.",
            f"Thumbnails: {self.thumbnails:,} images, {self.thumbnail_side} pixels wide at most.",
            f"Matrices: {self.matrix_side:,} cells a side; with more images, a cell is a mean over neighbours by name.",
            f"Pose of a pair from its matches: {self.pose_pairs:,} pairs, {self.pose_matches:,} matches of each.",
            f"Curves of pose errors: all pairs among {self.curve_images:,} images, {self.curve_points:,} points a "
            "curve; the table is over all images.",
            f"Gallery: {self.gallery:,} pairs that gained most and as many that lost most.",
            f"Track lengths: longer tracks than {self.track_length:,} images count there.",
            "With several seeds: figures and times are means; pairs, tracks and models are those of the first seed.",
        )


def evenly_of(items: Sequence[_Item], wanted: int) -> list[_Item]:
    """At most `wanted` of the items, evenly over them, the same every time."""
    return [items[row] for row in evenly(len(items), wanted)] if items else []
