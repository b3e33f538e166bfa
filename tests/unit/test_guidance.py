"""Guided areas: where they lie, how finely they are cropped, and when there are none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core import SemanticAreaMatcher, SGAMOptions, a2pm
from sgam_core.a2pm import match_described, match_whole
from sgam_core.covisible import Frame
from sgam_core.geometry import estimate_two_view
from sgam_core.guidance import guided_areas, warp_between
from sgam_core.options import CropOptions, GuidanceOptions, changed
from sgam_core.types import Area, AreaMatch, AreaState, Box, Crop, Matches
from tests.room import Room, TrueMatcher

FRAME = Frame(name="a", width=3000, height=2000, camera_matrix=None)
CROP = CropOptions(area_size=640, max_crop_pixels=4_000_000)


def zoomed(factor: float, shift: float = 0.0, *, sigma: float = 3.0, count: int = 900, frame: Frame = FRAME) -> Matches:
    """Matches all over what two images share, the second `factor` times as large about the middle, and shifted."""
    points0 = np.random.default_rng(0).uniform(0, (frame.width, frame.height), (count, 2))
    middle = np.array([frame.width / 2, frame.height / 2])
    points1 = (points0 - middle) * factor + middle + (shift, 0)
    inside = ((points1 >= 0) & (points1 < (frame.width, frame.height))).all(axis=1)
    points0, points1 = points0[inside], points1[inside]
    sigmas = np.full(len(points0), sigma)
    return Matches(points0=points0, points1=points1, scores=np.ones(len(points0)), sigmas0=sigmas, sigmas1=sigmas)


def crop_sides(areas) -> np.ndarray:
    """Width and height of every crop, (A, 2 images, 2)."""
    return np.array(
        [
            [(area.box.width * scale, area.box.height * scale) for area, scale in sides]
            for sides in (((a.area0, a.scale0), (a.area1, a.scale1)) for a in areas)
        ]
    )


@settings(deadline=None)
@given(factor=st.floats(0.5, 2.0), shift=st.floats(-1500, 1500), size=st.integers(600, 2000))
def test_windows_cover_the_overlap_within_the_limits(factor, shift, size):
    matches, crop = zoomed(factor, shift, count=3000), replace(CROP, area_size=size)
    areas = guided_areas(matches, FRAME, FRAME, crop, GuidanceOptions())
    if not areas:
        return
    sides = crop_sides(areas)
    assert sides.max() <= size + 1e-6
    assert sides.prod(axis=2).sum() <= 4_000_000 * (1 + 1e-9)
    covered = [a.area0.box.contains(matches.points0) & a.area1.box.contains(matches.points1) for a in areas]
    assert np.any(covered, axis=0).mean() > 0.75  # the outermost matches are left out


@pytest.mark.parametrize("max_upsampling", [1.0, 2.0])
@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_things_have_one_size_in_both_crops_and_neither_is_enlarged_too_much(factor, max_upsampling):
    options = GuidanceOptions(max_upsampling=max_upsampling)
    areas = guided_areas(zoomed(factor), FRAME, FRAME, replace(CROP, image_size=3000), options)
    assert len(areas) > 1
    for area in areas:
        assert area.scale0 / area.scale1 == pytest.approx(factor, rel=1e-6)
        assert max(area.scale0, area.scale1) <= max_upsampling


@pytest.mark.parametrize("max_upsampling", [1.0, 1.5])
def test_more_pixels_are_spent_as_far_as_images_may_be_enlarged(max_upsampling):
    options = GuidanceOptions(max_upsampling=max_upsampling)
    few, many = (
        guided_areas(zoomed(1), FRAME, FRAME, replace(CROP, image_size=3000, max_crop_pixels=pixels), options)
        for pixels in (2_000_000, 0)
    )
    assert len(few) < len(many)
    assert max(area.scale0 for area in few) < 0.6
    assert max(area.scale0 for area in many) == pytest.approx(max_upsampling)


@pytest.mark.parametrize(("image_size", "finest"), [(1000, 1.0), (1500, 1.0), (2400, 1.6), (4000, 2.0)])
def test_photos_are_enlarged_to_be_twice_as_fine_as_the_first_round_saw_them(image_size, finest):
    crop = CropOptions(area_size=8000, image_size=image_size, max_crop_pixels=0)
    areas = guided_areas(zoomed(1), FRAME, FRAME, crop, GuidanceOptions())
    assert max(area.scale0 for area in areas) == pytest.approx(finest)


@pytest.mark.parametrize("height", [1500, 2000, 2250, 3000])
def test_photos_of_every_shape_are_seen_more_finely(height):
    frame = replace(FRAME, height=height)
    crop = CropOptions().of_shapes((frame.width, frame.height), (frame.width, frame.height))
    sigma = frame.width / crop.image_size
    areas = guided_areas(zoomed(1, frame.width / 5, sigma=sigma, frame=frame), frame, frame, crop, GuidanceOptions())
    assert areas
    assert min(area.scale0 for area in areas) * sigma > 1.15


def test_without_limits_every_crop_is_as_large_as_may_be():
    crop = CropOptions(area_size=640, max_crop_pixels=0)
    areas = guided_areas(zoomed(1), FRAME, FRAME, crop, GuidanceOptions(max_upsampling=0))
    assert crop_sides(areas).max(axis=(1, 2)) == pytest.approx(640)
    assert max(area.scale0 for area in areas) > 1.5


@pytest.mark.parametrize("matches", [zoomed(1, count=19), zoomed(1, sigma=1.0), Matches.empty()])
def test_no_window_with_few_matches_or_without_a_gain_in_resolution(matches):
    assert guided_areas(matches, FRAME, FRAME, CROP, GuidanceOptions()) == ()


WHOLE = Area(kind="guided", box=Box(x0=0, y0=0, x1=FRAME.width, y1=FRAME.height))
BOTH = AreaMatch(area0=WHOLE, area1=WHOLE, distance=0.0)
AFFINE = np.array([[0.8, -0.3, 500], [0.2, 0.5, 300]])


def mapped(points1, *, wrong: int = 0) -> Matches:
    """Matches (200) of points all over the image with what a function maps them to, some of them wrong."""
    rng = np.random.default_rng(0)
    points0 = rng.uniform((300, 300), (2700, 1700), (200, 2))
    found = points1(points0) + rng.normal(0, 1, (200, 2))
    found[:wrong] = rng.uniform((300, 300), (2700, 1700), (wrong, 2))
    return Matches(points0=points0, points1=found, scores=np.ones(200))


def test_the_map_that_most_matches_follow_is_found():
    warp = warp_between(mapped(lambda x: x @ AFFINE[:, :2].T + AFFINE[:, 2], wrong=60), BOTH, GuidanceOptions())
    assert warp is not None
    corners = np.array([(0, 0), (FRAME.width, FRAME.height)])
    expected = corners @ AFFINE[:, :2].T + AFFINE[:, 2]
    np.testing.assert_allclose(corners @ warp[:, :2].T + warp[:, 2], expected, atol=5)


@pytest.mark.parametrize(
    ("matches", "options"),
    [
        (mapped(lambda x: x + 500 * np.sin(x / 300)), GuidanceOptions()),  # no affine map
        (mapped(lambda x: x * (-1, 1) + (FRAME.width, 0)), GuidanceOptions()),  # a mirror image
        (mapped(lambda x: x * (0.2, 1) + (900, 0)), GuidanceOptions()),  # seen from the side
        (mapped(lambda x: x), GuidanceOptions(min_matches=201)),
        (mapped(lambda x: x), GuidanceOptions(max_bend=0)),
    ],
)
def test_no_map_where_matches_follow_none_or_one_that_no_two_views_have(matches, options):
    assert warp_between(matches, BOTH, options) is None


def test_matches_along_a_line_tell_no_map():
    points = np.column_stack([np.linspace(300, 2700, 100), np.linspace(400, 900, 100)])
    points = points + np.random.default_rng(0).normal(0, 0.3, points.shape)
    other = points + np.random.default_rng(1).normal(0, 3, points.shape)
    assert warp_between(Matches(points0=points, points1=other, scores=np.ones(100)), BOTH, GuidanceOptions()) is None


def in_room(room: Room, options: SGAMOptions, names=("view03.jpg", "view04.jpg"), point_matcher=None):
    matcher = SemanticAreaMatcher(options=options.semantic)
    images = [room.images[name] for name in names]
    described = [matcher.describe(room.images[name], room.renderings[name].labels.astype(np.int32)) for name in names]
    return match_described(*images, *described, matcher, point_matcher or TrueMatcher(room), options)


def test_whole_images_that_tell_nothing_are_judged_once(room, monkeypatch):
    """The geometry of their matches says that areas are needed, and is the pair's when there are none."""
    asked: list[int] = []

    def counted(matches, **settings):
        asked.append(len(matches))
        return estimate_two_view(matches, **settings)

    monkeypatch.setattr(a2pm, "estimate_two_view", counted)
    options = changed(
        SGAMOptions(),
        guidance__sure_matches=10_000,
        guidance__min_gain=1e9,
        looks__enabled=False,
        semantic__objects__enabled=False,
        semantic__intersections__enabled=False,
    )
    found = in_room(room, options)
    assert found.fallback == "no area match"
    assert found.two_view is not None
    assert len(asked) == 1


COARSE = changed(SGAMOptions(), crop__image_size=256, crop__area_size=320)


def test_images_that_agree_are_looked_at_again_more_finely(room):
    found = in_room(room, COARSE)
    kept = [area for area in found.areas if area.state is AreaState.KEPT]
    assert kept
    assert {area.area0.kind for area in found.areas} == {"guided"}
    assert all(area.scale0 > 1.1 * found.whole_scale0 for area in kept)
    fine = found.matches.area_index >= 0
    assert fine.mean() > 0.5
    assert found.fallback == ""


@dataclass(frozen=True)
class Noting(TrueMatcher):
    """Remembers the crops that it is given."""

    seen: list[tuple[Crop, Crop]] = field(default_factory=list)

    def match(self, pairs):
        self.seen.extend(pairs)
        return super().match(pairs)


@pytest.mark.parametrize("max_bend", [0.0, 0.05])
def test_only_crops_whose_size_was_measured_are_said_to_be_alike(room, max_bend):
    matcher = Noting(room)
    found = in_room(room, changed(COARSE, guidance__max_bend=max_bend), point_matcher=matcher)
    whole, *guided = matcher.seen
    assert not any(crop.alike for crop in whole)
    assert len(guided) == len(found.areas) > 0
    assert all(crop.alike for pair in guided for crop in pair)


def test_images_without_more_resolution_cost_what_they_cost_plainly(room):
    options = changed(SGAMOptions(), crop__image_size=640, guidance__max_upsampling=1)
    found = in_room(room, options)
    images = [room.images[name] for name in ("view03.jpg", "view04.jpg")]
    plain = match_whole(*images, TrueMatcher(room), options.crop)
    assert found.fallback == "whole images agree, and crops would be no finer"
    assert found.areas == ()
    np.testing.assert_array_equal(found.matches.points0, plain.points0)
    assert found.pixels_matched == 2 * 640 * 480


def test_areas_find_the_evidence_where_whole_images_do_not_agree(room):
    options = changed(COARSE, guidance__sure_matches=10**6, crop__area_size=160)
    found = in_room(room, options)
    assert {area.area0.kind for area in found.areas} > {"guided"}
    first = in_room(room, changed(options, guidance__enabled=False))
    assert not any(area.area0.kind == "guided" for area in first.areas)
    assert np.median(found.matches.sigmas) < np.median(first.matches.sigmas)


class Timid(TrueMatcher):
    """Finds next to nothing on whole images, as matchers do that keep sure matches alone."""

    def match(self, pairs):
        rows = np.arange(10)
        return [
            found.select(rows) if crop0.window.width == crop0.image.width else found
            for (crop0, _), found in zip(pairs, super().match(pairs), strict=True)
        ]


def test_areas_find_the_evidence_where_whole_images_have_too_few_matches(room):
    found = in_room(room, COARSE, point_matcher=Timid(room))
    kept = [area for area in found.areas if area.state is AreaState.KEPT]
    assert {area.area0.kind for area in kept} & {"object", "intersection"}
    assert found.two_view is not None
    assert len(found.matches) > 100
