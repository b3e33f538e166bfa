"""Coarse LoFTR, refined below its grid: a distilled one-level LoFTR on ONNX Runtime (Sun et al., CVPR 2021).

The network sees both crops in a frame of 640 x 480 and says how likely each cell of 16 x 16 pixels matches each other
one. A match of two cells becomes a match of two points: where the neighbours' likelihoods put it, then at the most
distinct corner nearby, then photometrically at the crops' own resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from sgam_core.types import Crop, Matches
from sgam_sfm.matchers.masks import wanted
from sgam_sfm.matchers.subpixel import local_affines, refine
from sgam_sfm.onnx_session import open_session
from sgam_sfm.weights import COARSE_LOFTR, find_weights

WIDTH, HEIGHT = 640, 480  # of the network's inputs
CELL = 16
COLUMNS, ROWS = WIDTH // CELL, HEIGHT // CELL
_CELLS = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), -1).reshape(-1, 2)  # (column, row) of every cell
# The network's convolutions centre cell i on pixel 16 i, not on the middle of its sixteen: measured.
_CENTERS = CELL * _CELLS + 0.5


class CoarseLoFTR:
    """Point matcher (`sgam_core.protocols.PointMatcher`): coarse LoFTR with photometric refinement.

    Crops of any size are resized into the network's frame, the rest of which is left black and not matched. Equal
    input gives equal output; `seed` is accepted as by every matcher, but nothing here is random. The score of a match
    is the network's confidence times the correlation of the refined patches.

    Args:
        weights: the ONNX file; looked for in the torch-hub cache when omitted.
        device: a torch device; without a CUDA build of ONNX Runtime the CPU, with a warning.
        threads: of ONNX Runtime; 0 for its own choice.
        min_confidence: of the network, for a pair of cells.
        min_correlation: of the refined patches; -1 disables.
    """

    def __init__(
        self,
        *,
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        threads: int = 0,
        min_confidence: float = 0.1,
        min_correlation: float = 0.8,
    ) -> None:
        path = find_weights(COARSE_LOFTR, weights)
        self._session = open_session(path, f"coarse-loftr ('{path}')", device, threads)
        self._inputs = [entry.name for entry in self._session.get_inputs()]
        self._confidence = self._session.get_outputs()[0].name
        self.min_confidence = min_confidence
        self.min_correlation = min_correlation

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`."""
        return [self._match(crop0, crop1) for crop0, crop1 in pairs]

    def _match(self, crop0: Crop, crop1: Crop) -> Matches:
        view0, view1 = _view(crop0), _view(crop1)
        frames = dict(zip(self._inputs, (view0.frame[None, None], view1.frame[None, None]), strict=True))
        (likelihood,) = self._session.run([self._confidence], frames)
        likelihood = likelihood[0] * view0.wanted[:, None] * view1.wanted
        cells0, cells1 = _mutual_best(likelihood, self.min_confidence)

        rough0 = _expected(likelihood.T, cells1, cells0) / view0.scale
        rough1 = _expected(likelihood, cells0, cells1) / view1.scale
        affines = local_affines(rough0, rough1)
        points0 = view0.anchors[cells0]
        start1 = rough1 + (affines @ (points0 - rough0)[..., None])[..., 0]
        points1, correlation = refine(view0.gray, view1.gray, points0, start1, affines)

        moved = np.linalg.norm((points1 - start1) * view1.scale, axis=1)
        good = (correlation > self.min_correlation) & (moved < CELL) & wanted(crop0, points0) & wanted(crop1, points1)
        scores = likelihood[cells0, cells1] * correlation.clip(0, 1)
        return Matches(points0=points0[good], points1=points1[good], scores=scores[good].clip(0, 1))


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A crop as both steps see it.

    gray: (h, w) its own pixels. frame: (480, 640) in [0, 1] as the network sees them. scale: (2,) frame pixels per crop
    pixel. wanted: (1200,) cells whose centre lies on the crop and inside its mask. anchors: (1200, 2) the most distinct
    corner within each cell, crop pixels: where the eye of a tracker would rest, and the same in every pair.
    """

    gray: Float32[np.ndarray, "h w"]
    frame: Float32[np.ndarray, "480 640"]
    scale: Float[np.ndarray, " 2"]
    wanted: Bool[np.ndarray, " 1200"]
    anchors: Float[np.ndarray, "1200 2"]


def _view(crop: Crop) -> _View:
    gray = crop.gray().astype(np.float32)
    factor = min(WIDTH / crop.size[0], HEIGHT / crop.size[1])
    width, height = (max(1, round(factor * side)) for side in crop.size)
    small = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)

    frame, valid = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), bool)
    frame[:height, :width] = small / 255
    mask = crop.mask()
    valid[:height, :width] = mask is None or cv2.resize(
        mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST_EXACT
    ).astype(bool)

    corners = np.full((HEIGHT, WIDTH), -1, np.float32)
    corners[:height, :width] = cv2.cornerMinEigenVal(small, 5)
    corners[~valid] = -1
    half = CELL // 2
    corners = np.pad(corners, ((half, 0), (half, 0)), constant_values=-1)[:HEIGHT, :WIDTH]
    best = corners.reshape(ROWS, CELL, COLUMNS, CELL).swapaxes(1, 2).reshape(-1, CELL * CELL).argmax(1)
    anchors = CELL * _CELLS - half + np.stack([best % CELL, best // CELL], -1) + 0.5
    scale = np.array([width / crop.size[0], height / crop.size[1]])
    return _View(gray, frame, scale, valid[::CELL, ::CELL].ravel(), anchors / scale)


def _mutual_best(likelihood: np.ndarray, minimum: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells of both crops that are each other's likeliest, where that likelihood exceeds the minimum."""
    best1 = likelihood.argmax(1)
    mutual = likelihood.argmax(0)[best1] == np.arange(len(best1))
    cells0 = np.flatnonzero(mutual & (likelihood.max(1) > minimum))
    return cells0, best1[cells0]


def _expected(likelihood: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> Float[np.ndarray, "M 2"]:
    """The mean centre, in frame pixels, of the 3 x 3 cells around each of `columns`, by their likelihoods in `rows`."""
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(-1, 2)
    cells = _CELLS[columns][:, None] + around
    x, y = np.moveaxis(cells, -1, 0)
    inside = (x >= 0) & (x < COLUMNS) & (y >= 0) & (y < ROWS)
    index = np.where(inside, y * COLUMNS + x, 0)
    weights = likelihood[rows[:, None], index] * inside
    mean: np.ndarray = (weights[..., None] * _CENTERS[index]).sum(1) / weights.sum(1, keepdims=True)
    return mean
