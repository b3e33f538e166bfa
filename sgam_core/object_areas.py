"""Semantic object areas (SOA): detection, surrounding descriptor and matching (paper, Sec. III-B1).

Boxes and lengths are pixels of a label map 640 wide.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int32, Shaped

from sgam_core.candidates import Edges, split_candidates
from sgam_core.options import DESCRIPTOR_SCALES, ObjectAreaOptions
from sgam_core.types import Box


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectArea:
    """An object of one image. border: the labels that surround it. share: of the image, its box's."""

    label: int
    box: Box
    border: frozenset[int]
    share: float
    touches_edge: bool


def detect_object_areas(
    labels: Int32[np.ndarray, "H W"], ignored: Collection[int], options: ObjectAreaOptions
) -> tuple[tuple[ObjectArea, ...], tuple[str, ...]]:
    """The objects of a label map, largest first, and a note for every limit that was reached.

    Args: labels (H, W), 640 wide, 0 = void; ignored labels form no area but count as surroundings.
    """
    height, width = labels.shape
    notes: list[str] = []
    found: list[tuple[int, Box]] = []
    for label in np.flatnonzero(np.bincount(labels.ravel())).tolist():
        if label == 0 or label in ignored:
            continue
        boxes = [box for box in _fuse(_components(labels == label, options), options.fuse_px) if _fits(box, options)]
        boxes.sort(key=lambda box: (-box.area, box.y0, box.x0))
        if len(boxes) > options.max_per_label:
            notes.append(f"label {label}: {len(boxes)} areas, {options.max_per_label} kept (max_per_label)")
        found += [(label, box) for box in boxes[: options.max_per_label]]
    found.sort(key=lambda item: (-item[1].area, item[1].y0, item[1].x0))
    if len(found) > options.max_per_image:
        notes.append(f"{len(found)} object areas, {options.max_per_image} kept (max_per_image)")
    return tuple(
        ObjectArea(
            label=label,
            box=box,
            border=border_labels(labels, box, options.min_run_px) - {label},
            share=box.area / (height * width),
            touches_edge=box.x0 <= 0 or box.y0 <= 0 or box.x1 >= width or box.y1 >= height,
        )
        for label, box in found[: options.max_per_image]
    ), tuple(notes)


def _components(mask: Shaped[np.ndarray, "H W"], options: ObjectAreaOptions) -> list[Box]:
    """Boxes of the cleaned mask's components that are large enough, 8-connected."""
    min_pixels = options.min_share * mask.size
    if np.count_nonzero(mask) < min_pixels:
        return []
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    bottom, right = y + height + options.close_px, x + width + options.close_px  # closing reaches no farther
    y, x = max(y - options.close_px, 0), max(x - options.close_px, 0)
    cleaned: np.ndarray = mask[y:bottom, x:right].astype(np.uint8)
    for operation, size in ((cv2.MORPH_CLOSE, options.close_px), (cv2.MORPH_OPEN, options.open_px)):
        if size > 1:
            cleaned = cv2.morphologyEx(cleaned, operation, np.ones((size, size), np.uint8))
    stats = cv2.connectedComponentsWithStats(cleaned, connectivity=8)[2][1:].tolist()
    return [
        Box(x0=x + left, y0=y + top, x1=x + left + w, y1=y + top + h)
        for left, top, w, h, pixels in stats
        if pixels >= min_pixels
    ]


def _fuse(boxes: Sequence[Box], fuse_px: float) -> list[Box]:
    """Join the two boxes with the nearest centres until none are nearer than fuse_px."""
    fused = list(boxes)
    while len(fused) > 1:
        centers = np.array([box.center for box in fused])
        apart = np.linalg.norm(centers[:, None] - centers[None], axis=2) + np.diag(np.full(len(fused), np.inf))
        i, j = sorted(divmod(int(apart.argmin()), len(fused)))
        if apart[i, j] >= fuse_px:
            break
        a, b = fused[i], fused.pop(j)
        fused[i] = Box(x0=min(a.x0, b.x0), y0=min(a.y0, b.y0), x1=max(a.x1, b.x1), y1=max(a.y1, b.y1))
    return fused


def _fits(box: Box, options: ObjectAreaOptions) -> bool:
    return max(box.width, box.height) <= options.max_aspect * min(box.width, box.height)


def border_labels(labels: Int32[np.ndarray, "H W"], box: Box, min_run_px: int) -> frozenset[int]:
    """Labels that lie on the sides of the box at any of the descriptor's scales; void is none.

    A label counts on a side, one pixel thick, when it fills a run of at least min_run_px there. Sides that the image's
    edge cuts off are skipped.
    """
    height, width = labels.shape
    found: set[int] = set()
    for scale in DESCRIPTOR_SCALES:
        scaled = box.enlarged(scale)
        x0, y0 = int(np.floor(scaled.x0)), int(np.floor(scaled.y0))
        x1, y1 = int(np.ceil(scaled.x1)) - 1, int(np.ceil(scaled.y1)) - 1
        along_x, along_y = slice(max(x0, 0), x1 + 1), slice(max(y0, 0), y1 + 1)
        for y in {y0, y1}:
            if 0 <= y < height:
                found |= _long_runs(labels[y, along_x], min_run_px)
        for x in {x0, x1}:
            if 0 <= x < width:
                found |= _long_runs(labels[along_y, x], min_run_px)
    return frozenset(found - {0})


def _long_runs(line: Int32[np.ndarray, " N"], min_length: int) -> set[int]:
    starts = np.concatenate([[0], np.flatnonzero(np.diff(line)) + 1, [len(line)]])
    return set(line[starts[:-1][np.diff(starts) >= min_length]].tolist()) if len(line) else set()


def descriptor_distance(
    area0: ObjectArea, area1: ObjectArea, pair_labels: frozenset[int], options: ObjectAreaOptions
) -> float:
    """Distance of two border descriptors over the labels of the pair but the areas' own; 0 when there is no other.

    Returns: Hamming distance over the number of labels, or Jaccard distance; both in [0, 1].
    """
    others = pair_labels - {area0.label}
    border0, border1 = area0.border & others, area1.border & others
    total = len(others) if options.distance == "hamming" else len(border0 | border1)
    return len(border0 ^ border1) / total if total else 0.0


def object_distances(
    areas0: Sequence[ObjectArea],
    areas1: Sequence[ObjectArea],
    pair_labels: frozenset[int],
    options: ObjectAreaOptions,
) -> Float[np.ndarray, "A B"]:
    """Distances (A, B) between the objects of two images, infinite where they cannot match."""
    distances = np.full((len(areas0), len(areas1)), np.inf)
    for i, area0 in enumerate(areas0):
        for j, area1 in enumerate(areas1):
            if area0.label == area1.label and _sizes_agree(area0, area1, options):
                distance = descriptor_distance(area0, area1, pair_labels, options)
                if distance <= options.max_distance:
                    distances[i, j] = distance
    return distances


def _sizes_agree(area0: ObjectArea, area1: ObjectArea, options: ObjectAreaOptions) -> bool:
    small, large = sorted((area0.share, area1.share))
    zoomed = large <= options.max_share or small <= large / 4
    return zoomed and small <= options.max_share and area_ratio(area0, area1) <= options.max_area_ratio


def area_ratio(area0: ObjectArea, area1: ObjectArea) -> float:
    """How many times the larger box is the smaller one, in area."""
    return max(area0.box.area / area1.box.area, area1.box.area / area0.box.area)


def match_object_areas(
    areas0: Sequence[ObjectArea],
    areas1: Sequence[ObjectArea],
    pair_labels: frozenset[int],
    options: ObjectAreaOptions,
) -> tuple[Edges, list[Edges], Float[np.ndarray, "A B"]]:
    """Certain matches, doubtful groups and the distances of the objects of two images.

    Once three certain matches agree on the ratio of areas, candidates far from it are dropped and doubt is judged anew.
    """
    distances = object_distances(areas0, areas1, pair_labels, options)
    certain, doubtful = split_candidates(distances, options.doubt_margin)
    log_ratios = np.array([np.log(areas0[i].box.area / areas1[j].box.area) for i, j in certain])
    if len(certain) >= 3:
        spread, median = np.log(options.max_ratio_spread), np.median(log_ratios)
        if np.count_nonzero(np.abs(log_ratios - median) <= spread) >= 3:
            sizes0 = np.log([area.box.area for area in areas0])
            sizes1 = np.log([area.box.area for area in areas1])
            distances[np.abs(sizes0[:, None] - sizes1[None] - median) > spread] = np.inf
            certain, doubtful = split_candidates(distances, options.doubt_margin)
    return certain, doubtful, distances


def scale_between(areas0: Sequence[ObjectArea], areas1: Sequence[ObjectArea], certain: Edges) -> float:
    """How many times larger, in length, image 0 shows the matched objects; 1 when no match is whole in both images."""
    logs = [
        np.log(areas0[i].box.area / areas1[j].box.area) / 2
        for i, j in certain
        if not (areas0[i].touches_edge or areas1[j].touches_edge)
    ]
    return float(np.exp(np.median(logs))) if logs else 1.0
