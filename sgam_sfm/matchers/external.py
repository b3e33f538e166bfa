"""A point matcher that runs in another Python environment, as a worker."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sgam_core.types import Crop, Matches
from sgam_sfm.external import Worker, WorkerCommand
from sgam_sfm.matchers.masks import wanted

_log = logging.getLogger(__name__)
_ORIGINS = {"corner": 0.0, "center": 0.5}
"""What is added to points of a worker, by what it says of them."""
_MESSAGE_BYTES = 2**26
_FAR_PX = 1.0  # outside a crop: more than a matcher's rounding explains
_SCORE_ROUNDING = 1e-3

Pairs = Sequence[tuple[Crop, Crop]]


class ExternalMatcher:
    """Point matcher (`sgam_core.protocols.PointMatcher`): what a worker finds, checked.

    Pairs are sent in batches of 64 MB. Points outside their crop or under its mask are dropped.

    Raises: see `Worker`; also when the worker does not say where the origin of its pixels is.
    """

    def __init__(
        self, *, worker: WorkerCommand, weights: Path | None = None, device: str = "cpu", seed: int = 0
    ) -> None:
        file = weights.absolute() if weights is not None and weights.exists() else weights
        settings = {"device": device, "weights": None if file is None else str(file), "seed": seed}
        self._worker = Worker(worker, settings)
        origin = self._worker.hello.get("origin")
        if not isinstance(origin, str) or origin not in _ORIGINS:
            raise self._worker.unusable(
                f"says that the origin of its points is {origin!r}; expected 'corner', where the centre of the first "
                "pixel is (0.5, 0.5), or 'center', where it is (0, 0)"
            )
        self._offset = _ORIGINS[origin]
        self._has_warned = False

    def match(self, pairs: Pairs) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`."""
        return [matches for batch in _batches(pairs) for matches in self._match(batch)]

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def _match(self, pairs: Pairs) -> list[Matches]:
        crops = {crop.key: crop for pair in pairs for crop in pair}
        rows = {key: row for row, key in enumerate(crops)}
        header = {"type": "match", "pairs": [[rows[crop.key] for crop in pair] for pair in pairs]}

        def read(arrays: list[np.ndarray]) -> list[Matches]:
            if len(arrays) != 3 * len(pairs):
                raise self._worker.wrong(f"gave {len(arrays)} arrays for {len(pairs)} pairs; expected 3 for each")
            return [self._read(*pair, *arrays[3 * row : 3 * row + 3]) for row, pair in enumerate(pairs)]

        return self._worker.ask(header, [crop.pixels() for crop in crops.values()], read, len(pairs))

    def _read(self, crop0: Crop, crop1: Crop, points0: np.ndarray, points1: np.ndarray, scores: np.ndarray) -> Matches:
        count = len(scores) if scores.ndim == 1 else -1
        if not points0.shape == points1.shape == (count, 2):
            shapes = ", ".join(str(array.shape) for array in (points0, points1, scores))
            raise self._worker.wrong(f"gave points0, points1, scores of shapes {shapes}; expected (M, 2), (M, 2), (M,)")
        if not all(np.isfinite(array).all() for array in (points0, points1, scores)):
            raise self._worker.wrong("gave points or scores that are not finite; let the script drop these matches")
        if count and not -_SCORE_ROUNDING <= scores.min() <= scores.max() <= 1 + _SCORE_ROUNDING:
            between = f"{scores.min():.3g} to {scores.max():.3g}"
            raise self._worker.wrong(f"gave scores from {between}; expected [0, 1]: let the script scale them")
        points0, points1 = points0 + self._offset, points1 + self._offset
        self._warn_of_outside(crop0, points0)
        self._warn_of_outside(crop1, points1)
        good = wanted(crop0, points0) & wanted(crop1, points1)
        return Matches(points0=points0[good], points1=points1[good], scores=scores[good].clip(0, 1))

    def _warn_of_outside(self, crop: Crop, points: Float[np.ndarray, "M 2"]) -> None:
        far = np.any((points < -_FAR_PX) | (points > np.array(crop.size) + _FAR_PX), axis=1)
        if far.any() and not self._has_warned:
            self._has_warned = True
            x, y = points[far][0]
            _log.warning(
                "%d of %d points of a worker lie outside their crop, which is %d x %d, for example (%.1f, %.1f), and "
                "are dropped; the script must give pixels of the images that it is sent, not of resized ones",
                *(far.sum(), len(points), *crop.size, x, y),
            )


def _batches(pairs: Pairs) -> Iterator[Pairs]:
    """The pairs in order, as many together as a message may hold."""
    start, num_bytes = 0, 0
    for row, pair in enumerate(pairs):
        own = sum(3 * crop.size[0] * crop.size[1] for crop in pair)
        if row > start and num_bytes + own > _MESSAGE_BYTES:
            yield pairs[start:row]
            start, num_bytes = row, 0
        num_bytes += own
    if start < len(pairs):
        yield pairs[start:]
