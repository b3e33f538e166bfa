"""GMC and the merging of matches of several resolutions (paper, Sec. III-C3 and Alg. 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain

import numpy as np
from scipy.spatial import cKDTree

from sgam_core.geometry import residuals
from sgam_core.options import CollectionOptions
from sgam_core.types import Box, Matches, TwoViewModel

_TOGETHER = 1024  # matches whose neighbours are in memory together


def coverage(boxes: Sequence[Box], width: int, height: int) -> float:
    """Share of an image inside the union of the boxes."""
    if not boxes:
        return 0.0
    x = np.unique(np.clip([v for box in boxes for v in (box.x0, box.x1)], 0, width))
    y = np.unique(np.clip([v for box in boxes for v in (box.y0, box.y1)], 0, height))
    middle_x, middle_y = (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2
    inside = np.zeros((len(middle_y), len(middle_x)), bool)
    for box in boxes:
        columns = (middle_x >= box.x0) & (middle_x < box.x1)
        inside |= ((middle_y >= box.y0) & (middle_y < box.y1))[:, None] & columns
    return float((inside * np.diff(y)[:, None] * np.diff(x)).sum() / (width * height))


def collect(
    inside: Sequence[Matches],
    smaller_coverage: float,
    model: TwoViewModel | None,
    match_whole: Callable[[], Matches],
    options: CollectionOptions,
) -> Matches:
    """Whole-image matches that agree with the geometry of the areas; none when the areas cover enough.

    Args: inside, the matches of every kept area; model, their geometry.
    """
    if options.rule == "none" or smaller_coverage >= options.min_coverage or model is None or not any(map(len, inside)):
        return Matches.empty()
    found = [residuals(model.F, matches) for matches in inside if len(matches)]
    if options.rule == "paper":
        bound = float(np.mean([r.mean() for r in found]))
    elif options.rule == "paper-literal":
        bound = float(np.mean([r.sum() for r in found]))
    else:
        # Differs from the paper: the median keeps one stray match from opening the gate, and 1 is the resolution of
        # the matcher itself.
        bound = max(2 * float(np.median([r.mean() for r in found])), 1.0)
    whole = match_whole()
    return whole.select(residuals(model.F, whole) <= bound)


def merge(areas: Sequence[Matches], whole: Matches, options: CollectionOptions) -> Matches:
    """The matches of areas and whole images as one list, the finer ones first.

    Duplicates are removed, and coarse whole-image matches where finer ones cover the ground in both images.
    """
    inside = Matches.concatenate(areas)
    inside = inside.select(np.argsort(inside.sigmas, kind="stable"))
    inside = inside.select(_first_of_duplicates(inside, options.duplicate_px))
    if len(inside) and len(whole):
        whole = whole.select(~_covered(whole, inside, options.covered_px))
    merged = Matches.concatenate([inside, whole])
    return merged.select(_first_of_duplicates(merged, options.duplicate_px))


def _first_of_duplicates(matches: Matches, duplicate_px: float) -> np.ndarray:
    """Rows that no earlier kept row equals, up to duplicate_px in both images."""
    keep = np.ones(len(matches), bool)
    if len(matches) and duplicate_px > 0:
        pairs = cKDTree(matches.points0).query_pairs(duplicate_px, output_type="ndarray")
        apart = np.linalg.norm(matches.points1[pairs[:, 0]] - matches.points1[pairs[:, 1]], axis=1)
        same = pairs[apart <= duplicate_px]  # the lower row first
        for i, j in same[np.lexsort(same.T)].tolist():
            keep[j] &= not keep[i]
    return keep


def _covered(coarse: Matches, fine: Matches, covered_px: float) -> np.ndarray:
    """Which coarse matches have a finer one near them in both images."""
    covered = np.zeros(len(coarse), bool)
    tree, sigmas = cKDTree(fine.points0), fine.sigmas
    for start in range(0, len(coarse), _TOGETHER):
        part = coarse.select(np.arange(start, min(start + _TOGETHER, len(coarse))))
        near0 = tree.query_ball_point(part.points0, covered_px * part.sigmas0)
        rows = np.repeat(np.arange(len(part)), [len(neighbours) for neighbours in near0])
        neighbours = np.fromiter(chain.from_iterable(near0), np.intp, len(rows))
        apart = np.linalg.norm(fine.points1[neighbours] - part.points1[rows], axis=1)
        near = (sigmas[neighbours] < part.sigmas[rows]) & (apart <= covered_px * part.sigmas1[rows])
        covered[start + rows[near]] = True
    return covered
