"""Point matches that were computed before are looked up, and charged for."""

import time
from pathlib import Path

import numpy as np

from sgam_core import Box, Crop, Image, Matches
from sgam_sfm.match_cache import CachedMatcher


class Counting:
    """Matches pixels of equal rows; counts what it is asked for."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, int]] = []
        self.resets = 0

    def match(self, pairs):
        time.sleep(0.02 * len(pairs))
        self.asked += [(crop0.size[0], crop1.size[0]) for crop0, crop1 in pairs]
        return [self._match(crop0) for crop0, _ in pairs]

    def _match(self, crop: Crop) -> Matches:
        points = np.linspace(0, crop.size[0] - 1, 5)[:, None].repeat(2, 1)
        return Matches(points0=points, points1=points + 0.25, scores=np.full(5, 0.5), sigmas1=np.full(5, 2.0))

    def reset(self) -> None:
        self.resets += 1


def crop(name: str, width: int = 40) -> Crop:
    image = Image(name=name, pixels=np.zeros((30, 50, 3), np.uint8))
    return Crop(image=image, window=Box(x0=0, y0=0, x1=width, y1=20), size=(width, 20))


def cached(folder: Path, key: str = "k", digests: dict[str, str] | None = None) -> tuple[CachedMatcher, Counting]:
    matcher = Counting()
    digests = digests or {"a": "1", "b": "2"}
    return CachedMatcher(matcher=matcher, digests=digests, key=key, folder=folder), matcher


def test_what_was_computed_is_looked_up_and_charged(tmp_path):
    first, counting = cached(tmp_path)
    (computed,) = first.match([(crop("a"), crop("b"))])
    assert counting.asked == [(40, 40)]
    assert first.charged > 0.015
    assert abs(first.saved) < 1e-9

    second, counting = cached(tmp_path)
    looked_up, other = second.match([(crop("a"), crop("b")), (crop("a", 30), crop("b"))])
    assert counting.asked == [(30, 40)]
    for name in ("points0", "points1", "scores", "sigmas0", "sigmas1"):
        np.testing.assert_array_equal(getattr(looked_up, name), getattr(computed, name))
    assert len(other) == 5
    np.testing.assert_allclose(second.saved, first.charged)
    assert second.charged > second.saved


def test_images_with_other_content_and_other_keys_are_other_matches(tmp_path):
    cached(tmp_path)[0].match([(crop("a"), crop("b"))])
    for key, digests in (("other", None), ("k", {"a": "1", "b": "3"})):
        matcher, counting = cached(tmp_path, key, digests)
        matcher.match([(crop("a"), crop("b"))])
        assert counting.asked == [(40, 40)]
    renamed, counting = cached(tmp_path, digests={"x": "1", "y": "2"})
    renamed.match([(crop("x"), crop("y"))])
    assert counting.asked == []


def test_pixels_of_a_crop_count_once(tmp_path):
    matcher, counting = cached(tmp_path)
    matcher.match([(crop("a"), crop("b")), (crop("a"), crop("b", 30))])
    assert matcher.pixels_extracted == 40 * 20 * 2 + 30 * 20
    matcher.start()
    assert (matcher.pixels_extracted, matcher.charged, matcher.saved) == (0, 0.0, 0.0)
    matcher.reset()
    assert counting.resets == 1
    assert matcher.match([]) == []


def test_a_damaged_result_is_matched_again(tmp_path, caplog):
    cached(tmp_path)[0].match([(crop("a"), crop("b"))])
    (path,) = tmp_path.rglob("*.npz")
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"\x80\x04K\x01."):  # the last one is a pickle
        path.write_bytes(damaged)
        matcher, counting = cached(tmp_path)
        (found,) = matcher.match([(crop("a"), crop("b"))])
        assert counting.asked == [(40, 40)]
        assert len(found) == 5
        assert "is damaged" in caplog.text
        caplog.clear()
