"""Sizes at which a method matches as many pixels as another."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sgam_core import Matches, WholeImages
from sgam_core.types import Area, AreaMatch, Box, PutativeAreas
from sgam_sfm.comparison.budget import fit_budget
from sgam_sfm.images import ImageFile
from sgam_sfm.options import MatchOptions

OPTIONS = MatchOptions(images=Path("photos"), output=Path("out"))
IMAGES = {name: ImageFile(name=name, path=Path(name), width=2000, height=1000, digest=name) for name in "abc"}
PAIRS = [("a", "b"), ("a", "c")]


class Halves:
    """An area matcher that proposes the left half of both images where there are whole-image matches."""

    needs_labels = False

    def describe(self, image, labels):
        return image

    def match(self, description0, description1, match_whole):
        if not len(match_whole()):
            return PutativeAreas()
        left = Area(box=Box(x0=0, y0=0, x1=1000, y1=1000), kind="half")
        return PutativeAreas(confident=(AreaMatch(area0=left, area1=left, distance=0.0),))


def some_matches() -> Matches:
    return Matches(points0=np.zeros((1, 2)), points1=np.zeros((1, 2)), scores=np.ones(1))


def test_whole_images_grow_until_the_pixels_are_spent():
    target = 2 * 2 * 1600 * 800  # both sides of two pairs
    budget = fit_budget(OPTIONS, IMAGES, PAIRS, target, WholeImages(), {}, 4096)
    assert budget.options.crop.image_size == 1600
    assert (budget.reached, budget.cap) == (target, "")


def test_whole_images_are_enlarged_where_areas_may_be():
    small = {name: replace(file, width=800, height=400) for name, file in IMAGES.items()}
    target = 2 * 2 * 1200 * 600
    assert fit_budget(OPTIONS, small, PAIRS, target, WholeImages(), {}, 4096).reached == target


@pytest.mark.parametrize(
    ("largest", "max_upsampling", "cap"),
    [
        (4096, 1.0, "capped at the images' own resolution (image-size 2000)"),
        (4096, 3.0, "capped at 1.536 times the images' own resolution (image-size 3072)"),
        (1200, 2.0, "capped at --budget-image-size (image-size 1200)"),
    ],
)
def test_a_cap_that_bites_is_told(largest, max_upsampling, cap):
    options = replace(OPTIONS, guidance=replace(OPTIONS.guidance, max_upsampling=max_upsampling))
    budget = fit_budget(options, IMAGES, PAIRS, 10**9, WholeImages(), {}, largest)
    assert budget.cap == cap
    assert budget.reached < budget.target


def test_a_first_match_that_costs_more_than_the_budget_is_told():
    whole = {pair: some_matches() for pair in PAIRS}
    first = 2 * 2 * 1024 * 512
    budget = fit_budget(OPTIONS, IMAGES, PAIRS, first // 2, Halves(), whole, 4096)
    assert budget.reached > first
    assert budget.cap == f"it takes {budget.reached / budget.target:.0%} of it at least"


def test_areas_grow_where_there_are_some_and_whole_images_stay():
    crop = replace(OPTIONS.crop, expand=1.0, image_size=1000)
    options = replace(OPTIONS, crop=crop)
    whole = {pair: some_matches() for pair in PAIRS}
    target = 2 * 2 * (1000 * 500 + 700 * 700)
    budget = fit_budget(options, IMAGES, PAIRS, target, Halves(), whole, 4096)
    assert (budget.options.crop.area_size, budget.options.crop.image_size) == (700, 1000)
    assert budget.reached == target
    assert budget.options.crop.max_crop_pixels == 0  # nothing is skipped that was counted


def test_without_any_area_the_whole_images_take_the_budget():
    target = 2 * 2 * 1600 * 800
    budget = fit_budget(OPTIONS, IMAGES, PAIRS, target, Halves(), {}, 4096)
    assert budget.options.crop.image_size == 1600
