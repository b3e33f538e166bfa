"""Looks: photos taken sideways are matched as if they were upright, near ones as if they were taken from afar."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core import SemanticAreaMatcher, SGAMOptions, WholeImages, match_described
from sgam_core.geometry import residuals
from sgam_core.landmarks import Vote, vote
from sgam_core.looks import Look, best_look, voted_look
from sgam_core.options import GuidanceOptions, LookOptions, changed
from sgam_core.types import Box, Crop, Image, PairResult, TwoViewModel
from sgam_sfm.matchers.xfeat import XFeatStar
from tests.room import Room, TrueMatcher

PAIR = ("view03.jpg", "view04.jpg")


def matched(room: Room, matcher, options: SGAMOptions, images: tuple[Image, Image] | None = None) -> PairResult:
    image0, image1 = images or (room.images[name] for name in PAIR)
    areas = SemanticAreaMatcher(options=options.semantic)
    labels = np.zeros((120, 160), np.int32)  # nothing to make areas of: guided ones are left
    return match_described(
        image0, image1, areas.describe(image0, labels), areas.describe(image1, labels), areas, matcher, options
    )


def stored_turned(image: Image, degrees: int) -> Image:
    """The image turned anticlockwise by the camera that took it; what it does not show is black."""
    whole = Crop(image=image, window=Box(x0=0, y0=0, x1=image.width, y1=image.height), size=(image.width, image.height))
    return Image(name=f"turned {degrees}", pixels=whole.turned(degrees).pixels())


@pytest.mark.parametrize("stored", [0, 30, 75, 90, 135, 180, 270])
def test_the_second_image_is_turned_back(room, stored):
    options = changed(SGAMOptions(), crop__image_size=480, looks__sure_matches=10**6, looks__min_lead=0.5)
    image0, image1 = (room.images[name] for name in PAIR)
    result = matched(room, XFeatStar(), options, (image0, stored_turned(image1, stored)))
    assert abs((result.turned + stored + 180) % 360 - 180) <= 15
    assert result.two_view is not None
    assert result.two_view.num_inliers > 100
    assert any(area.area0.kind == "guided" for area in result.areas)


def test_images_that_show_nothing_in_common_stay_as_they_are(room):
    result = matched(room, TrueMatcher(room, points=0), SGAMOptions())
    assert result.turned == 0


def test_it_can_be_turned_off_and_plain_matching_stays_plain(room):
    image0, image1 = (room.images[name] for name in PAIR)
    sideways = stored_turned(image1, 90)
    options = changed(SGAMOptions(), crop__image_size=480)
    assert matched(room, XFeatStar(), changed(options, looks__enabled=False), (image0, sideways)).turned == 0
    assert match_described(image0, sideways, None, None, WholeImages(), XFeatStar(), options).turned == 0


def test_a_learned_matcher_finds_sideways_what_it_finds_upright(room):
    options = changed(SGAMOptions(), crop__image_size=480)
    image0, image1 = (room.images[name] for name in PAIR)
    sideways = Image(name="sideways", pixels=np.ascontiguousarray(np.rot90(image1.pixels)))
    upright = matched(room, XFeatStar(), options)
    turned = matched(room, XFeatStar(), options, (image0, sideways))
    assert turned.turned == 270
    assert len(turned.matches) > 0.9 * len(upright.matches)
    back = np.stack([image1.width - turned.matches.points1[:, 1], turned.matches.points1[:, 0]], axis=1)
    assert upright.two_view is not None
    stored = replace(turned.matches, points1=back)
    assert (residuals(upright.two_view.F, stored) < options.geometry.max_residual).mean() > 0.9


PLAIN = Look(sizes=(900, 600))


def chosen(vote: Vote, found: dict[Look, int], **options) -> tuple[Look, list[Look]]:
    """The best look where those of `found` have so many inliers, others none; and all whose geometry was asked for."""
    asked = []

    def model(look):
        if look not in asked:
            asked.append(look)
        if not (n := found.get(look, 0)):
            return None
        return TwoViewModel(F=np.eye(3), calibrated=False, num_inliers=n, num_matches=max(n, 100), planarity=0.0)

    return best_look(PLAIN, lambda: vote, model, LookOptions(**options), GuidanceOptions()), asked


def voted(degrees: int = 0, growth: float = 1.5, count: int = 20) -> Vote:
    """As large at the matcher as things are in the first image, when it says nothing else."""
    return Vote(degrees=degrees, growth=growth, count=count)


TURNED = replace(PLAIN, degrees=90)


def test_images_that_agree_are_looked_at_once():
    assert chosen(voted(90), {PLAIN: 150, TURNED: 1000}) == (PLAIN, [PLAIN])
    assert chosen(voted(90), {PLAIN: 149, TURNED: 1000}) == (TURNED, [PLAIN, TURNED])


def test_another_look_must_find_clearly_more():
    assert chosen(voted(90), {TURNED: 24})[0] == PLAIN  # as few as chance finds
    assert chosen(voted(90), {TURNED: 59, PLAIN: 40})[0] == PLAIN
    assert chosen(voted(90), {TURNED: 60, PLAIN: 40})[0] == TURNED
    assert chosen(voted(90), {TURNED: 60, PLAIN: 40}, enabled=False) == (PLAIN, [])


@pytest.mark.parametrize(
    ("vote", "look"),
    [
        (voted(45), Look(sizes=(900, 600), degrees=45)),
        (voted(345), PLAIN),  # matchers see through so small a turn
        (voted(growth=6.0), Look(sizes=(900, 150))),
        (voted(growth=0.375), Look(sizes=(225, 600))),
        (voted(180, growth=6.0), Look(sizes=(900, 150), degrees=180)),
        (voted(growth=2.1), PLAIN),  # and so small a change of size
        (voted(180, growth=6.0, count=4), PLAIN),
        (voted(growth=1e9), Look(sizes=(900, 1))),
    ],
)
def test_a_vote_is_a_look_of_one_image_turned_and_the_nearer_one_made_smaller(vote, look):
    assert voted_look(PLAIN, vote, LookOptions()) == look
    if look == PLAIN:
        assert chosen(vote, {}) == (PLAIN, [PLAIN])


def test_a_learned_matcher_sees_through_a_change_of_size(room):
    options = changed(SGAMOptions(), crop__image_size=640)
    image1, image0 = (room.images[name] for name in PAIR)
    width, height = round(image1.width / 4.5), round(image1.height / 4.5)
    x, y = (image1.width - width) // 2, (image1.height - height) // 2
    centre = image1.pixels[y : y + height, x : x + width]
    pixels = cv2.resize(centre, (image1.width, image1.height), interpolation=cv2.INTER_CUBIC)
    near = Image(name="near", pixels=pixels)

    found = matched(room, XFeatStar(), options, (image0, near))
    assert found.zoom == pytest.approx(1 / 4.5, rel=0.2)
    upright = matched(room, XFeatStar(), options, (image0, image1))
    assert upright.two_view is not None
    points1 = found.matches.points1 * (width / image1.width, height / image1.height) + (x, y)
    original = replace(found.matches, points1=points1)
    right = (residuals(upright.two_view.F, original) < options.geometry.max_residual).sum()
    plain = matched(room, XFeatStar(), changed(options, looks__enabled=False), (image0, near))
    assert plain.two_view is None or right > 2 * plain.two_view.num_inliers
    assert right > 0.8 * len(found.matches) > 40


def test_a_photo_turned_and_taken_from_near_at_once_is_seen_through(room):
    options = changed(SGAMOptions(), crop__image_size=640)
    image0, image1 = (room.images[name] for name in PAIR)
    width, height = image1.width // 3, image1.height // 3
    centre = image1.pixels[height : 2 * height, width : 2 * width]
    near = cv2.resize(centre, (3 * width, 3 * height), interpolation=cv2.INTER_CUBIC)
    sideways = Image(name="sideways", pixels=np.ascontiguousarray(np.rot90(near)))
    found = matched(room, XFeatStar(), options, (image0, sideways))
    assert found.turned == pytest.approx(270, abs=15)
    assert found.zoom == pytest.approx(1 / 3, rel=0.2)
    assert found.two_view is not None
    assert found.two_view.num_inliers > 40


@settings(max_examples=20, deadline=None)
@given(st.floats(0, 360), st.floats(1, 4))
def test_landmarks_vote_for_the_turn_and_the_change_of_size(room, degrees, growth):
    image = room.images[PAIR[0]]
    center = (image.width / 2, image.height / 2)
    turn = cv2.getRotationMatrix2D(center, degrees, growth)  # anticlockwise
    pixels = cv2.warpAffine(image.pixels, turn, (image.width, image.height), flags=cv2.INTER_CUBIC)
    found = vote(image.landmarks, Image(name="turned", pixels=pixels).landmarks)
    assert abs((found.degrees + degrees + 180) % 360 - 180) <= 20
    assert 0.7 < found.growth / growth < 1.4


def test_an_image_without_landmarks_has_no_vote():
    blank = Image(name="blank", pixels=np.zeros((64, 64, 3), np.uint8))
    assert vote(blank.landmarks, blank.landmarks).count == 0


def test_landmarks_lie_inside_the_mask(room):
    image = room.images[PAIR[0]]
    left = np.zeros(image.pixels.shape[:2], bool)
    left[:, : image.width // 4] = True
    part = Image(name="part", pixels=image.pixels, mask=left)
    assert 0 < len(part.landmarks.angles) < len(image.landmarks.angles)
    nothing = Image(name="nothing", pixels=image.pixels, mask=np.zeros_like(left))
    assert len(nothing.landmarks.angles) == 0
