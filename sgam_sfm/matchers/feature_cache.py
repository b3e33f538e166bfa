"""Features of crops, extracted once and kept while there is room."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Generic, Protocol, TypeVar, runtime_checkable

from sgam_core.types import Crop


@runtime_checkable
class Sized(Protocol):
    """Something that knows how much memory it takes."""

    @property
    def nbytes(self) -> int:
        """Bytes."""
        ...


F = TypeVar("F", bound=Sized)


class FeatureCache(Generic[F]):
    """Features by crop; the least recently used are dropped first.

    Crops of equal size that are alike, or are not, are extracted together, `batch_size` at most.

    Args:
        extract: the features of crops of one size, all alike or none.
        batch_size: crops that are extracted together.
        max_bytes: bound of what is kept; the last crop is kept whatever it takes.

    Attributes:
        nbytes: of all that is kept.
        pixels_extracted, seconds_extracting: crop pixels extracted so far, and the time that they took, for cost
            reports; on CUDA some of it shows elsewhere.
    """

    def __init__(self, extract: Callable[[Sequence[Crop]], list[F]], *, batch_size: int, max_bytes: int) -> None:
        self.batch_size = batch_size
        self.max_bytes = max_bytes
        self.nbytes = 0
        self.pixels_extracted = 0
        self.seconds_extracting = 0.0
        self._extract = extract
        self._kept: OrderedDict[tuple, F] = OrderedDict()

    @property
    def repeatable(self) -> bool:
        """Whether what a crop gives does not depend on what else is asked for or kept: it is extracted alone."""
        return self.batch_size == 1

    @property
    def keys(self) -> list[tuple]:
        """Of the crops whose features are kept, least recently used first."""
        return list(self._kept)

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()
        self.nbytes = 0

    def fetch(self, crops: Sequence[Crop]) -> None:
        """Extract those that are not kept yet, in batches of equal size."""
        by_kind: dict[tuple, dict[tuple, Crop]] = {}
        for crop in crops:
            if crop.key not in self._kept:
                by_kind.setdefault((crop.size, crop.alike), {})[crop.key] = crop
        for same_kind in by_kind.values():
            missing = list(same_kind.values())
            for start in range(0, len(missing), self.batch_size):
                self._add(missing[start : start + self.batch_size])

    def of(self, crop: Crop) -> F:
        """The features of a crop, extracted now when they are not kept."""
        if crop.key not in self._kept:  # dropped since, or larger than the cache
            self._add([crop])
        self._kept.move_to_end(crop.key)
        return self._kept[crop.key]

    def _add(self, crops: Sequence[Crop]) -> None:
        self.pixels_extracted += sum(crop.size[0] * crop.size[1] for crop in crops)
        start = time.perf_counter()
        extracted = self._extract(crops)
        self.seconds_extracting += time.perf_counter() - start
        for crop, features in zip(crops, extracted, strict=True):
            self._kept[crop.key] = features
            self.nbytes += features.nbytes
            while self.nbytes > self.max_bytes and len(self._kept) > 1:
                _, dropped = self._kept.popitem(last=False)
                self.nbytes -= dropped.nbytes
