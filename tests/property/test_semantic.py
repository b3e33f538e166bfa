"""Symmetries of area matching: exchanging the images, renaming the labels, resizing the label maps."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core import AreaMatch, Image, PutativeAreas, SemanticAreaMatcher

MATCHER = SemanticAreaMatcher()


def regions(seed: int, width: int, height: int, count: int) -> np.ndarray:
    """A map of smooth random regions, labels 1 to count, some void."""
    noise = np.random.default_rng(seed).normal(size=(height, width, count + 1)).astype(np.float32)
    smooth = np.stack([cv2.GaussianBlur(noise[..., k], (0, 0), width / 16) for k in range(count + 1)], axis=2)
    return smooth.argmax(axis=2).astype(np.int32)


def image(labels: np.ndarray, name: str) -> Image:
    return Image(name=name, pixels=np.zeros((*labels.shape, 3), np.uint8))


def propose(labels0: np.ndarray, labels1: np.ndarray) -> PutativeAreas:
    described = (MATCHER.describe(image(labels, name), labels) for labels, name in ((labels0, "a"), (labels1, "b")))
    return MATCHER.match(*described)


def swapped(match: AreaMatch) -> tuple:
    return (match.area1, match.area0, round(match.distance, 9))


def as_is(match: AreaMatch) -> tuple:
    return (match.area0, match.area1, round(match.distance, 9))


def views(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Two overlapping cuts of one larger map."""
    large = regions(seed, 900, 560, count)
    return large[20:500, 20:660], large[60:540, 150:790]


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 9))
def test_exchanging_the_images_exchanges_the_areas(seed, count):
    labels0, labels1 = views(seed, count)
    forward, backward = propose(labels0, labels1), propose(labels1, labels0)
    assert set(map(as_is, forward.confident)) == set(map(swapped, backward.confident))
    assert {frozenset(map(as_is, group)) for group in forward.doubtful} == {
        frozenset(map(swapped, group)) for group in backward.doubtful
    }


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 9), st.randoms(use_true_random=False))
def test_renaming_labels_changes_nothing(seed, count, random):
    labels0, labels1 = views(seed, count)
    ids = random.sample(range(1, 60_000), count)
    names = np.array([0, *ids], np.int32)
    before, after = propose(labels0, labels1), propose(names[labels0], names[labels1])

    def boxes(matches) -> frozenset:
        return frozenset((m.area0.kind, m.area0.box, m.area1.box, round(m.distance, 9)) for m in matches)

    assert boxes(before.confident) == boxes(after.confident)
    assert set(map(boxes, before.doubtful)) == set(map(boxes, after.doubtful))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10_000))
def test_an_image_matches_itself_area_by_area(seed):
    labels, _ = views(seed, 6)
    found = propose(labels, labels)
    assert found.confident or found.doubtful
    for match in found.confident:
        assert match.area0.box == match.area1.box
        assert match.distance == 0.0


def test_boxes_are_in_image_pixels_whatever_the_size_of_the_label_map():
    labels, _ = views(3, 5)
    full = Image(name="a", pixels=np.zeros((960, 1280, 3), np.uint8))
    small, doubled = labels, labels.repeat(2, axis=0).repeat(2, axis=1)
    found = [MATCHER.describe(full, size) for size in (small, doubled)]
    assert [area.box for area in found[0].objects] == [area.box for area in found[1].objects]
    match = MATCHER.match(found[0], found[0])
    area = (*match.confident, *(m for group in match.doubtful for m in group))[0].area0
    assert area.box.x1 <= 1280
    assert area.box.x0 % 2 == 0


def test_masked_pixels_form_no_area():
    labels, _ = views(3, 5)
    mask = np.zeros(labels.shape, bool)
    masked = Image(name="a", pixels=np.zeros((*labels.shape, 3), np.uint8), mask=mask)
    described = MATCHER.describe(masked, labels)
    assert described.objects == ()
    assert described.windows == ()
