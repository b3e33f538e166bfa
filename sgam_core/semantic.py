"""SAM: a label map becomes a per-image description, two descriptions become putative area matches (Sec. III-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Int32

from sgam_core.candidates import Edges
from sgam_core.errors import ShapeError
from sgam_core.intersection_areas import (
    IntersectionArea,
    LabelCounts,
    detect_intersection_areas,
    match_intersection_areas,
    window_sizes,
)
from sgam_core.object_areas import ObjectArea, detect_object_areas, match_object_areas, scale_between
from sgam_core.options import SemanticOptions
from sgam_core.types import Area, AreaMatch, Box, Image, Matches, PutativeAreas

LABEL_WIDTH = 640
"""Label maps are brought to this width, so that every layout length is an absolute number of pixels."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SemanticDescription:
    """All that area matching needs of one image; boxes are label-map pixels, `to_image` scales them (x, y)."""

    labels: frozenset[int]
    objects: tuple[ObjectArea, ...]
    counts: LabelCounts
    windows: tuple[IntersectionArea, ...]
    window_px: float
    to_image: tuple[float, float]
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class SemanticAreaMatcher:
    """The paper's area matcher, as an `AreaMatcher`."""

    needs_labels: ClassVar[bool] = True
    guides: ClassVar[bool] = True
    options: SemanticOptions = field(default_factory=SemanticOptions)

    def describe(self, image: Image, labels: Int32[np.ndarray, "H W"] | None) -> SemanticDescription:
        """Objects, windows and label counts of one image; masked pixels become void."""
        if labels is None or labels.ndim != 2 or labels.size == 0:
            came = "none" if labels is None else f"of shape {labels.shape}"
            raise ShapeError(f"labels of '{image.name}' are {came}; expected a (height, width) integer label map")
        if int(labels.min()) < 0:
            raise ShapeError(f"labels of '{image.name}' go down to {int(labels.min())}; expected ids from 0 (void) up")
        options = self.options
        sized = layout_labels(labels)
        if image.mask is not None:
            size = (sized.shape[1], sized.shape[0])
            wanted = cv2.resize(image.mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
            sized = np.where(wanted > 0, sized, 0)
        objects: tuple[ObjectArea, ...] = ()
        notes: tuple[str, ...] = ()
        if options.objects.enabled:
            objects, notes = detect_object_areas(sized, options.ignored_labels, options.objects)
        counts = LabelCounts.of(np.where(np.isin(sized, options.ignored_labels), 0, sized))
        window_px, _ = window_sizes(counts, counts, 1.0, options.intersections)
        enabled = options.intersections.enabled
        return SemanticDescription(
            labels=frozenset(np.flatnonzero(np.bincount(sized.ravel())).tolist()) - {0},
            objects=objects,
            counts=counts,
            windows=detect_intersection_areas(counts, window_px, options.intersections) if enabled else (),
            window_px=window_px,
            to_image=(image.width / sized.shape[1], image.height / sized.shape[0]),
            notes=tuple(f"{image.name}: {note}" for note in notes),
        )

    def match(
        self,
        description0: SemanticDescription,
        description1: SemanticDescription,
        match_whole: Callable[[], Matches] | None = None,
    ) -> PutativeAreas:
        """Objects first, then windows at the scale that the matched objects show."""
        d0, d1, options = description0, description1, self.options
        certain, doubtful, distances = match_object_areas(
            d0.objects, d1.objects, d0.labels | d1.labels, options.objects
        )
        scale = scale_between(d0.objects, d1.objects, certain)
        objects = _area_matches("object", d0, d1, d0.objects, d1.objects, certain, doubtful, distances)

        windows0, windows1 = self._windows(d0, d1, scale)
        found = match_intersection_areas(d0.counts, d1.counts, windows0, windows1, options.intersections)
        windows = _area_matches("intersection", d0, d1, windows0, windows1, *found)
        return PutativeAreas(
            confident=objects[0] + windows[0], doubtful=objects[1] + windows[1], notes=d0.notes + d1.notes
        )

    def _windows(
        self, d0: SemanticDescription, d1: SemanticDescription, scale: float
    ) -> tuple[tuple[IntersectionArea, ...], tuple[IntersectionArea, ...]]:
        """The windows of both images, detected again where the scale between the images asks for another size."""
        options = self.options.intersections
        if not options.enabled:
            return (), ()
        wanted = window_sizes(d0.counts, d1.counts, scale, options)
        return tuple(  # type: ignore[return-value]
            d.windows if abs(px - d.window_px) < 1 else detect_intersection_areas(d.counts, px, options)
            for d, px in zip((d0, d1), wanted, strict=True)
        )


def layout_labels(labels: Int32[np.ndarray, "H W"]) -> Int32[np.ndarray, "h w"]:
    """A label map at LABEL_WIDTH, as `describe` brings it to; never interpolated."""
    height = max(round(labels.shape[0] * LABEL_WIDTH / labels.shape[1]), 1)
    if labels.shape == (height, LABEL_WIDTH):
        return labels
    rows = np.minimum(((np.arange(height) + 0.5) * labels.shape[0] / height).astype(int), labels.shape[0] - 1)
    columns = ((np.arange(LABEL_WIDTH) + 0.5) * labels.shape[1] / LABEL_WIDTH).astype(int)
    return labels[rows[:, None], columns]


def _area_matches(
    kind: str,
    d0: SemanticDescription,
    d1: SemanticDescription,
    areas0: Sequence[ObjectArea] | Sequence[IntersectionArea],
    areas1: Sequence[ObjectArea] | Sequence[IntersectionArea],
    certain: Edges,
    doubtful: list[Edges],
    distances: np.ndarray,
) -> tuple[tuple[AreaMatch, ...], tuple[tuple[AreaMatch, ...], ...]]:
    """Candidate indices as area matches in image pixels: (confident, doubtful groups)."""

    def match(edge: tuple[int, int]) -> AreaMatch:
        i, j = edge
        return AreaMatch(
            area0=_area(kind, areas0[i].box, d0, getattr(areas0[i], "label", None)),
            area1=_area(kind, areas1[j].box, d1, getattr(areas1[j], "label", None)),
            distance=float(distances[i, j]),
        )

    return tuple(map(match, certain)), tuple(tuple(map(match, group)) for group in doubtful)


def _area(kind: str, box: Box, description: SemanticDescription, label: int | None) -> Area:
    return Area(kind=kind, box=box.times(*description.to_image), label=label)
