"""Semantic intersection areas (SIA): windows where several labels meet (paper, Sec. III-B2).

Boxes and lengths are pixels of a label map 640 wide. Label counts come from an integral histogram over cells of 4 px,
so that any window costs the same, whatever its size.

# Differs from the paper: no pyramid. With integral counts the search at full resolution is cheaper than its top layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32, Int64

from sgam_core.candidates import Edges, split_candidates
from sgam_core.options import DESCRIPTOR_SCALES, IntersectionAreaOptions
from sgam_core.types import Box

CELL_PX = 4


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LabelCounts:
    """Integral histogram of a label map.

    ids: (C,) the labels. integral: (rows + 1, columns + 1, C) pixels of each label above and left of a cell corner.
    """

    ids: Int64[np.ndarray, " C"]
    integral: Int32[np.ndarray, "R S C"]
    width: int
    height: int

    @staticmethod
    def of(labels: Int32[np.ndarray, "H W"]) -> LabelCounts:
        """Count the labels (H, W) per cell and sum up."""
        height, width = labels.shape
        ids, index = _compact(labels)
        rows, columns = -(-height // CELL_PX), -(-width // CELL_PX)
        cell = (np.arange(height) // CELL_PX)[:, None] * columns + np.arange(width) // CELL_PX
        flat = (cell * len(ids) + index).ravel()
        counts = np.bincount(flat, minlength=rows * columns * len(ids)).reshape(rows, columns, len(ids))
        integral = np.zeros((rows + 1, columns + 1, len(ids)), np.int32)
        integral[1:, 1:] = counts.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
        return LabelCounts(ids=ids, integral=integral, width=width, height=height)

    def proportions(
        self,
        x0: Int64[np.ndarray, " N"],
        y0: Int64[np.ndarray, " N"],
        x1: Int64[np.ndarray, " N"],
        y1: Int64[np.ndarray, " N"],
    ) -> Float[np.ndarray, "N C"]:
        """Share of each label in windows [x0, x1) x [y0, y1) of cells, clipped to the map: (N, C)."""
        rows, columns = self.integral.shape[0] - 1, self.integral.shape[1] - 1
        x0, x1 = np.clip(x0, 0, columns), np.clip(x1, 0, columns)
        y0, y1 = np.clip(y0, 0, rows), np.clip(y1, 0, rows)
        table = self.integral
        counts = table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0]
        return counts / np.maximum(counts.sum(1, keepdims=True), 1)


def _compact(labels: Int32[np.ndarray, "H W"]) -> tuple[Int64[np.ndarray, " C"], Int64[np.ndarray, "H W"]]:
    """The labels that occur (C,), sorted, and each pixel's position among them (H, W)."""
    ids = np.flatnonzero(np.bincount(labels.ravel()))
    position = np.zeros(int(ids[-1]) + 1, np.int64)
    position[ids] = np.arange(len(ids))
    return ids, position[labels]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class IntersectionArea:
    """A window of one image. proportions: (C,) mean share of each label of `LabelCounts.ids` over the scales."""

    box: Box
    proportions: Float[np.ndarray, " C"]


def window_sizes(
    counts0: LabelCounts, counts1: LabelCounts, scale: float, options: IntersectionAreaOptions
) -> tuple[float, float]:
    """Window sides for the two images when image 0 shows the objects `scale` times larger.

    The image with the larger objects gets the larger window; when that does not fit, the other's shrinks instead, so
    that the ratio holds.
    """
    ratio = float(np.clip(scale, 1 / options.max_scale, options.max_scale))
    largest = [options.max_window_share * min(counts.width, counts.height) for counts in (counts0, counts1)]
    wanted = [options.window_px * max(ratio, 1.0), options.window_px * max(1 / ratio, 1.0)]
    shrink = min(1.0, largest[0] / wanted[0], largest[1] / wanted[1])
    return wanted[0] * shrink, wanted[1] * shrink


def detect_intersection_areas(
    counts: LabelCounts, window_px: float, options: IntersectionAreaOptions
) -> tuple[IntersectionArea, ...]:
    """Windows with at least min_labels labels, those with most labels and most even proportions first.

    Args: window_px side of the window; it is rounded to cells.
    """
    rows, columns = counts.integral.shape[0] - 1, counts.integral.shape[1] - 1
    side = min(max(round(window_px / CELL_PX), 2), rows, columns)
    y, x = (grid.ravel() for grid in np.meshgrid(*(_steps(n, side) for n in (rows, columns)), indexing="ij"))
    labels, variance = _score(counts, x, y, side, options)
    rich = labels >= options.min_labels
    x, y, labels, variance = _refine(counts, x[rich], y[rich], side, options)
    order = np.lexsort((x, y, variance, -labels))
    kept: list[int] = []
    for k in order.tolist():
        if len(kept) == options.max_per_image:
            break
        if all(np.hypot(x[k] - x[j], y[k] - y[j]) * CELL_PX >= options.nms_px for j in kept):
            kept.append(k)
    described = _describe(counts, x[kept], y[kept], side, options)
    return tuple(
        IntersectionArea(
            box=Box(
                x0=float(x[k] * CELL_PX),
                y0=float(y[k] * CELL_PX),
                x1=float(min((x[k] + side) * CELL_PX, counts.width)),
                y1=float(min((y[k] + side) * CELL_PX, counts.height)),
            ),
            proportions=proportions,
        )
        for k, proportions in zip(kept, described, strict=True)
    )


def _steps(length: int, side: int) -> np.ndarray:
    """Positions half a window apart, the last one flush with the end."""
    return np.unique(np.append(np.arange(0, length - side + 1, max(side // 2, 1)), length - side))


def _score(
    counts: LabelCounts, x: np.ndarray, y: np.ndarray, side: int, options: IntersectionAreaOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Number of labels in each window, and the variance of their proportions."""
    shares = counts.proportions(x, y, x + side, y + side)
    present = (shares >= options.min_label_share) & (counts.ids != 0)
    number = present.sum(1)
    mean = (shares * present).sum(1) / np.maximum(number, 1)
    variance = (((shares - mean[:, None]) * present) ** 2).sum(1) / np.maximum(number, 1)
    return number, variance


def _refine(
    counts: LabelCounts, x: np.ndarray, y: np.ndarray, side: int, options: IntersectionAreaOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Move every window by up to a quarter of its side to where most labels share it most evenly."""
    rows, columns = counts.integral.shape[0] - 1, counts.integral.shape[1] - 1
    reach = np.arange(-(side // 4), side // 4 + 1, 2)  # every second cell: 8 px
    dy, dx = (grid.ravel() for grid in np.meshgrid(reach, reach, indexing="ij"))
    moved_x = np.clip(x[:, None] + dx, 0, columns - side)
    moved_y = np.clip(y[:, None] + dy, 0, rows - side)
    labels, variance = _score(counts, moved_x.ravel(), moved_y.ravel(), side, options)
    labels, variance = labels.reshape(moved_x.shape), variance.reshape(moved_x.shape)
    best = (variance - labels).argmin(axis=1)  # a variance of shares is below 1: labels first, then evenness
    row = np.arange(len(x))
    return moved_x[row, best], moved_y[row, best], labels[row, best], variance[row, best]


def _describe(
    counts: LabelCounts, x: np.ndarray, y: np.ndarray, side: int, options: IntersectionAreaOptions
) -> Float[np.ndarray, "N C"]:
    """Label proportions, small ones dropped, averaged over windows of the descriptor's scales about one centre."""
    shares = []
    for scale in DESCRIPTOR_SCALES:
        margin = round(side * (scale - 1) / 2)
        share = counts.proportions(x - margin, y - margin, x + side + margin, y + side + margin)
        shares.append(np.where(share >= options.min_label_share, share, 0.0))
    mean: np.ndarray = np.mean(shares, axis=0)
    return mean


def match_intersection_areas(
    counts0: LabelCounts,
    counts1: LabelCounts,
    areas0: tuple[IntersectionArea, ...],
    areas1: tuple[IntersectionArea, ...],
    options: IntersectionAreaOptions,
) -> tuple[Edges, list[Edges], Float[np.ndarray, "A B"]]:
    """Certain matches, doubtful groups and L2 distances of the windows of two images."""
    ids = np.union1d(counts0.ids, counts1.ids)
    spread0, spread1 = _spread(areas0, counts0.ids, ids), _spread(areas1, counts1.ids, ids)
    distances = np.linalg.norm(spread0[:, None] - spread1[None], axis=2)
    distances[distances > options.max_distance] = np.inf
    return *split_candidates(distances, options.doubt_margin), distances


def _spread(areas: tuple[IntersectionArea, ...], ids: np.ndarray, all_ids: np.ndarray) -> np.ndarray:
    """Proportions (A, L) over the labels of the pair."""
    table = np.zeros((len(areas), len(all_ids)))
    columns = np.searchsorted(all_ids, ids)
    for row, area in zip(table, areas, strict=True):
        row[columns] = area.proportions
    return table
