"""Features of a crop are extracted once, also when threads ask at once, and dropped where there is no room."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock

import numpy as np
import pytest

from sgam_core import Crop, match_pair
from sgam_sfm.matchers.feature_cache import FeatureCache
from sgam_sfm.matchers.sift import sift
from tests.textures import similarity, view, whole

THREADS = 8


@dataclass
class Named:
    """Features of a crop."""

    of: tuple
    nbytes: int = 100


class Extractor:
    """Counts how often a crop is extracted; failing: what extracting one raises."""

    def __init__(self, failing: tuple = ()) -> None:
        self.calls: list[tuple] = []
        self.failing = failing
        self._lock = Lock()

    def __call__(self, crops: Sequence[Crop]) -> list[Named]:
        with self._lock:
            self.calls += [crop.key for crop in crops]
        time.sleep(0.005)
        if self.failing in [crop.key for crop in crops]:
            raise MemoryError("Unable to allocate 9 GiB")
        return [Named(crop.key) for crop in crops]


@pytest.fixture(scope="module")
def crops() -> list[Crop]:
    return [whole(np.full((40, 40 + number % 2, 3), number, np.uint8), str(number)) for number in range(6)]


def by_threads(work: Callable[[int], None]) -> None:
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, range(THREADS)))


@pytest.mark.parametrize("batch_size", [1, 2])
def test_threads_extract_each_crop_once(crops, batch_size):
    extract = Extractor()
    cache = FeatureCache(extract, batch_size=batch_size, max_bytes=10**6)

    def work(number: int) -> None:
        mine = [*crops[number % 3 :], *crops[: number % 3]]
        cache.fetch(mine)
        for crop in mine:
            assert cache.of(crop).of == crop.key

    by_threads(work)
    assert sorted(extract.calls) == sorted(crop.key for crop in crops)
    assert cache.pixels_extracted == sum(crop.size[0] * crop.size[1] for crop in crops)
    assert cache.nbytes == 100 * len(crops)


def test_threads_that_leave_each_other_no_room_get_their_features_nevertheless(crops):
    cache = FeatureCache(Extractor(), batch_size=1, max_bytes=1)

    def work(number: int) -> None:
        for crop in crops[number % 6 :]:
            cache.fetch([crop])
            assert cache.of(crop).of == crop.key

    by_threads(work)
    assert len(cache.keys) == 1
    assert cache.nbytes == 100


def test_what_cannot_be_extracted_is_told_to_all_who_wait_and_tried_again(crops):
    extract = Extractor(failing=crops[2].key)
    cache = FeatureCache(extract, batch_size=2, max_bytes=10**6)

    def work(number: int) -> None:
        with pytest.raises(MemoryError, match="9 GiB"):
            cache.of(crops[2])

    with pytest.raises(MemoryError):
        cache.fetch(crops)
    by_threads(work)
    extract.failing = ()
    assert [cache.of(crop).of for crop in crops] == [crop.key for crop in crops]


def test_a_matcher_that_is_used_again_takes_no_image_for_one_before():
    matcher, labels = sift(), np.zeros((240, 320), np.int32)
    for seed, shift in ((1, 20), (2, 45)):
        image = view(np.eye(3), (320, 240), seed)
        moved = view(similarity(1.0, 0.0, (shift, 0.0), (0.0, 0.0)), (320, 240), seed)
        matches = match_pair(image, moved, labels, labels, matcher).matches
        assert np.median(matches.points1 - matches.points0, axis=0) == pytest.approx([shift, 0], abs=0.1)
