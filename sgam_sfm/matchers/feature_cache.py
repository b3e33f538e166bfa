"""Features of crops, extracted once and kept while there is room."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from threading import Lock
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

    Crops of equal size that are alike, or are not, are extracted together, `batch_size` at most. Threads may ask at
    once: what one of them extracts, the others wait for.

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
        self._coming: dict[tuple, Future[F]] = {}  # what a thread extracts now
        self._lock = Lock()  # of all of these, never held for long

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
        with self._lock:
            self._kept.clear()
            self.nbytes = 0

    def fetch(self, crops: Sequence[Crop]) -> None:
        """Extract those that are not kept yet, and that no other thread extracts, in batches of equal size."""
        by_kind: dict[tuple, list[Crop]] = {}
        with self._lock:
            for crop in crops:
                if crop.key not in self._kept and crop.key not in self._coming:
                    self._coming[crop.key] = Future()
                    by_kind.setdefault((crop.size, crop.alike), []).append(crop)
        self._extract_now(
            [
                missing[start : start + self.batch_size]
                for missing in by_kind.values()
                for start in range(0, len(missing), self.batch_size)
            ]
        )

    def of(self, crop: Crop) -> F:
        """The features of a crop, extracted now when they are not kept."""
        with self._lock:
            if crop.key in self._kept:
                self._kept.move_to_end(crop.key)
                return self._kept[crop.key]
            wanted = crop.key not in self._coming  # dropped since, or larger than the cache
            coming = self._coming.setdefault(crop.key, Future())
        if wanted:
            self._extract_now([[crop]])
        return coming.result()

    def _extract_now(self, batches: Sequence[Sequence[Crop]]) -> None:
        """Extract what is told to come; where that fails, the threads that wait for it fail alike."""
        waiting = [crop for batch in batches for crop in batch]
        try:
            for batch in batches:
                self._add(batch)
                del waiting[: len(batch)]
        except BaseException as error:
            with self._lock:
                for crop in waiting:
                    self._coming.pop(crop.key).set_exception(error)
            raise

    def _add(self, crops: Sequence[Crop]) -> None:
        start = time.perf_counter()
        extracted = list(zip(crops, self._extract(crops), strict=True))
        seconds = time.perf_counter() - start
        with self._lock:
            self.pixels_extracted += sum(crop.size[0] * crop.size[1] for crop in crops)
            self.seconds_extracting += seconds
            for crop, features in extracted:
                self._coming.pop(crop.key).set_result(features)
                self._kept[crop.key] = features
                self.nbytes += features.nbytes
                while self.nbytes > self.max_bytes and len(self._kept) > 1:
                    _, dropped = self._kept.popitem(last=False)
                    self.nbytes -= dropped.nbytes
