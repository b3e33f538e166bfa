"""Looks: photos taken sideways are matched as if they were upright, near ones as if they were taken from afar."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from sgam_core import SemanticAreaMatcher, SGAMOptions, WholeImages, match_described
from sgam_core.errors import OptionError
from sgam_core.geometry import residuals
from sgam_core.looks import Look, best_look
from sgam_core.options import GuidanceOptions, TurningOptions, ZoomOptions, changed
from sgam_core.types import Crop, Image, PairResult, TwoViewModel
from sgam_sfm.matchers.xfeat import XFeatStar
from tests.room import Room, TrueMatcher

PAIR = ("view03.jpg", "view04.jpg")


@dataclass(frozen=True)
class Upright:
    """The true matcher, for which the second image was stored turned, and is nothing but noise as it is.

    degrees: anticlockwise, of the second image as it is stored.
    """

    true: TrueMatcher
    degrees: int

    def match(self, pairs):
        noise = replace(self.true, points=0, known={})
        upright = [(_turn_of(crop1) + self.degrees) % 360 == 0 for _, crop1 in pairs]
        return [(self.true if seen else noise).match([pair])[0] for seen, pair in zip(upright, pairs, strict=True)]


def _turn_of(crop: Crop) -> int:
    """Degrees anticlockwise by which a crop shows its image."""
    along_x, along_y = crop.crop_from_image[:, 0]
    return round(np.rad2deg(np.arctan2(-along_y, along_x))) % 360


def matched(room: Room, matcher, options: SGAMOptions, images: tuple[Image, Image] | None = None) -> PairResult:
    image0, image1 = images or (room.images[name] for name in PAIR)
    areas = SemanticAreaMatcher(options=options.semantic)
    labels = np.zeros((120, 160), np.int32)  # nothing to make areas of: guided ones are left
    return match_described(
        image0, image1, areas.describe(image0, labels), areas.describe(image1, labels), areas, matcher, options
    )


@pytest.mark.parametrize("stored", range(0, 360, 45))
def test_the_second_image_is_turned_back(room, stored):
    # No crop is warped: a warp turns by itself, but only what is turned in truth.
    options = changed(SGAMOptions(), crop__image_size=320, guidance__max_bend=0.0)
    result = matched(room, Upright(TrueMatcher(room), stored), options)
    assert result.turned == (360 - stored) % 360
    assert result.two_view is not None
    assert result.two_view.num_inliers > 100
    assert any(area.area0.kind == "guided" for area in result.areas)


def test_images_that_show_nothing_in_common_stay_as_they_are(room):
    result = matched(room, TrueMatcher(room, points=0), SGAMOptions())
    assert result.turned == 0


def test_it_can_be_turned_off_and_plain_matching_stays_plain(room):
    matcher = Upright(TrueMatcher(room), 90)
    assert matched(room, matcher, changed(SGAMOptions(), turning__enabled=False)).turned == 0
    images = [room.images[name] for name in PAIR]
    plain = match_described(*images, None, None, WholeImages(), matcher, SGAMOptions())
    assert plain.turned == 0
    assert plain.two_view is None or plain.two_view.num_inliers < 20


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
FAR, NEAR = Look(sizes=(300, 600)), Look(sizes=(900, 200))
TURNED = {degrees: replace(PLAIN, degrees=degrees) for degrees in range(45, 360, 45)}
PLAIN_MATCHES = 200


def glance(look: Look) -> Look:
    """What a turn is judged by before it is looked at, or a size."""
    return look.within(256) if look.sizes == PLAIN.sizes else look.smaller(2, 2)


def chosen(found: dict[Look, int], glances: dict[Look, int] | None = None, **zoom) -> tuple[Look, list[Look]]:
    """The best look where those of `found` have so many inliers and others none, and all whose geometry was asked for.

    glances: matches that glances find, where they are not as many as the look's.
    """
    asked = []
    seen = {glance(look): count for look, count in found.items()}
    seen |= {glance(look): count for look, count in (glances or {}).items()} | {PLAIN: PLAIN_MATCHES}

    def models(looks):
        asked.extend(look for look in looks if look not in asked)
        return [
            TwoViewModel(F=np.eye(3), calibrated=False, num_inliers=n, num_matches=max(n, 100), planarity=0.0)
            if (n := found.get(look, 0))
            else None
            for look in looks
        ]

    def counts(looks):
        return [seen.get(look, 0) for look in looks]

    return best_look(PLAIN, counts, models, TurningOptions(), ZoomOptions(**zoom), GuidanceOptions()), asked


def test_images_that_agree_are_looked_at_once():
    assert chosen({PLAIN: 150, NEAR: 1000}) == (PLAIN, [PLAIN])
    assert chosen({PLAIN: 149, NEAR: 1000}) == (NEAR, [PLAIN, NEAR])  # what is aslant agrees a little, as near ones do
    assert chosen({PLAIN: 149, TURNED[45]: 298})[0] == TURNED[45]


def test_the_image_taken_from_near_is_made_smaller():
    assert chosen({NEAR: 40, FAR: 10, PLAIN: 12})[0] == NEAR
    assert chosen({NEAR: 40, FAR: 60, PLAIN: 12})[0] == FAR


def test_a_smaller_image_must_find_clearly_more():
    assert chosen({NEAR: 24})[0] == PLAIN  # as few as chance finds
    assert chosen({NEAR: 59, PLAIN: 40})[0] == PLAIN
    assert chosen({NEAR: 60, PLAIN: 40})[0] == NEAR
    assert chosen({NEAR: 60, PLAIN: 40}, enabled=False)[0] == PLAIN


def test_a_turned_image_may_be_near_too():
    turned = replace(NEAR, degrees=90)
    assert chosen({TURNED[90]: 30, turned: 50})[0] == turned
    assert chosen({TURNED[90]: 150}) == (TURNED[90], [PLAIN, TURNED[90]])
    assert chosen({TURNED[45]: 40, TURNED[90]: 150, TURNED[135]: 40})[0] == TURNED[90]


def test_a_turned_image_must_find_clearly_more():
    assert chosen({TURNED[180]: 30, PLAIN: 16})[0] == PLAIN
    assert chosen({TURNED[180]: 30, PLAIN: 15})[0] == TURNED[180]
    assert chosen({TURNED[180]: 24})[0] == PLAIN  # as few as chance finds


def test_what_a_glance_finds_nothing_in_is_not_looked_at():
    aslant, half = TURNED[45], TURNED[180]
    found = {PLAIN: 20, aslant: 100, half: 100, NEAR: 100, FAR: 100}
    turned = 0.5 * PLAIN_MATCHES * (256 / 600) ** 2  # as many per pixel of the smaller image
    near, far = PLAIN_MATCHES * (100 / 600) ** 2, PLAIN_MATCHES * (150 / 600) ** 2
    assert chosen(found, {aslant: turned - 1, half: turned - 1, NEAR: near - 1, FAR: far})[1] == [PLAIN, FAR]
    assert chosen(found, {aslant: turned - 1, half: turned, NEAR: near, FAR: far - 1})[1][:2] == [PLAIN, half]


def test_images_without_any_match_are_not_looked_at_again():
    asked = []

    def models(looks):
        asked.extend(looks)
        return [None] * len(looks)

    options = TurningOptions(), ZoomOptions(), GuidanceOptions()
    assert best_look(PLAIN, lambda looks: [0] * len(looks), models, *options) == PLAIN
    assert {*asked} == {PLAIN}


def test_what_is_next_to_the_right_turn_is_not_looked_at():
    glances = {TURNED[45]: 29, TURNED[90]: 60, TURNED[135]: 30}
    found = {TURNED[45]: 50, TURNED[90]: 150, TURNED[135]: 40}
    assert chosen(found, glances) == (TURNED[90], [PLAIN, TURNED[90], TURNED[135]])


def test_looks_get_smaller():
    assert Look(sizes=(511, 1), degrees=135).smaller(2, 4) == Look(sizes=(256, 1), degrees=135)
    assert Look(sizes=(511, 200), degrees=135).within(256) == Look(sizes=(256, 200), degrees=135)


def test_a_learned_matcher_sees_through_a_change_of_size(room):
    options = changed(SGAMOptions(), crop__image_size=640)
    image0, image1 = (room.images[name] for name in PAIR)
    width, height = image1.width // 4, image1.height // 4
    x, y = (image1.width - width) // 2, (image1.height - height) // 2
    centre = image1.pixels[y : y + height, x : x + width]
    near = Image(name="near", pixels=cv2.resize(centre, (4 * width, 4 * height), interpolation=cv2.INTER_CUBIC))

    found = matched(room, XFeatStar(), options, (image0, near))
    assert found.zoom == pytest.approx(1 / 3, rel=0.01)
    upright = matched(room, XFeatStar(), options)
    assert upright.two_view is not None
    original = replace(found.matches, points1=found.matches.points1 / 4 + (x, y))
    right = (residuals(upright.two_view.F, original) < options.geometry.max_residual).sum()
    plain = matched(room, XFeatStar(), changed(options, zoom__enabled=False), (image0, near))
    assert plain.two_view is None or right > 2 * plain.two_view.num_inliers
    assert right > 0.8 * len(found.matches) > 40


def test_a_smaller_image_is_not_larger():
    with pytest.raises(OptionError, match=r"factor is 0\.5; expected a number from 1 to 100"):
        ZoomOptions(factor=0.5)


def test_a_glance_of_no_size_is_refused():
    with pytest.raises(OptionError, match="glance_size is 0; expected a number from 1 to 65536"):
        TurningOptions(glance_size=0)
