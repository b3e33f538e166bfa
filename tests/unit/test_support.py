"""Area pairs that plain matches support, and those that they do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import hypergeom

from sgam_core.covisible import Frame
from sgam_core.options import GuidanceOptions
from sgam_core.support import chance_of, supported
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches, PutativeAreas

LEFT, RIGHT = Box(x0=0, y0=0, x1=50, y1=100), Box(x0=50, y0=0, x1=100, y1=100)
FRAME = Frame(name="", width=100, height=100, camera_matrix=None)
WHOLE_AREAS = 10**6  # matches, of which there are never so many: no area is cut


def area_match(box0: Box, box1: Box) -> AreaMatch:
    return AreaMatch(area0=Area(kind="object", box=box0), area1=Area(kind="object", box=box1), distance=0.1)


def judged_areas(
    putative: PutativeAreas, found: Matches, max_chance: float, min_overlap: float, min_matches: int = WHOLE_AREAS
) -> PutativeAreas:
    options = GuidanceOptions(max_chance=max_chance, min_overlap=min_overlap, min_matches=min_matches)
    return supported(putative, found, FRAME, FRAME, options)


def matches(joined: int, wrong: int, seed: int = 0) -> Matches:
    """Some from left to left, the others from anywhere to anywhere."""
    rng = np.random.default_rng(seed)
    sides = [
        np.concatenate([rng.uniform(0, (50, 100), (joined, 2)), rng.uniform(0, 100, (wrong, 2))]) for _ in range(2)
    ]
    return Matches(points0=sides[0], points1=sides[1], scores=np.ones(joined + wrong))


def still(number: int = 400) -> Matches:
    """Of two images that show the same."""
    points = np.random.default_rng(0).uniform(0, 100, (number, 2))
    return Matches(points0=points, points1=points, scores=np.ones(number))


def test_areas_that_matches_join_stay_and_others_are_skipped_with_the_reason():
    true, wrong = area_match(LEFT, LEFT), area_match(LEFT, RIGHT)
    judged = judged_areas(
        PutativeAreas(confident=(true, wrong), doubtful=((wrong, true),)), matches(60, 100), 0.01, 0.0
    )
    assert judged.confident[0] == judged.doubtful[0][1] == true
    skipped = judged.confident[1]
    assert skipped.state == judged.doubtful[0][0].state == AreaState.SKIPPED
    assert skipped.reason.endswith("whole-image matches lead from area to area: no more than chance")


@pytest.mark.parametrize("wrong", [0, 40])
@pytest.mark.parametrize("swapped", [False, True])
def test_an_area_that_the_other_image_shows_from_near_stays(wrong, swapped):
    small, whole = Box(x0=20, y0=20, x1=50, y1=50), Box(x0=0, y0=0, x1=100, y1=99)
    rng = np.random.default_rng(0)
    points0 = np.concatenate([rng.uniform(20, 50, (60, 2)), rng.uniform(0, 100, (wrong, 2))])
    found = Matches(points0=points0, points1=rng.uniform(0, 100, points0.shape), scores=np.ones(len(points0)))
    pair = area_match(small, whole)
    if swapped:
        pair, found = area_match(whole, small), found.swapped()
    assert judged_areas(PutativeAreas(confident=(pair,)), found, 0.01, 0.5).confident == (pair,)
    few = found.select(np.arange(7))
    assert judged_areas(PutativeAreas(confident=(pair,)), few, 0.01, 0.5).confident[0].state is AreaState.SKIPPED


@given(st.integers(0, 400), st.integers(0, 1000))
def test_chance_is_rarely_taken_for_support(wrong, seed):
    judged = judged_areas(PutativeAreas(confident=(area_match(LEFT, LEFT),)), matches(0, wrong, seed), 1e-9, 0.0)
    assert judged.confident[0].state is AreaState.SKIPPED


@pytest.mark.parametrize("found", [Matches.empty(), matches(0, 1)])
def test_next_to_no_match_supports_nothing(found):
    judged = judged_areas(PutativeAreas(confident=(area_match(LEFT, LEFT),)), found, 0.01, 0.0)
    assert judged.confident[0].state is AreaState.SKIPPED


@pytest.mark.parametrize(("height", "stays"), [(100, True), (70, True), (30, False)])
@pytest.mark.parametrize("first", [True, False])
def test_areas_that_overlap_in_a_small_part_are_skipped_whichever_is_the_larger(height, stays, first):
    part = Box(x0=0, y0=0, x1=50, y1=height)
    pair = area_match(LEFT, part) if first else area_match(part, LEFT)
    judged = judged_areas(PutativeAreas(confident=(pair,)), still(), 0.01, 0.5).confident[0]
    if stays:
        assert judged == pair
    else:
        assert judged.state is AreaState.SKIPPED
        assert judged.reason.endswith("they overlap in part")


@pytest.mark.parametrize("first", [True, False])
def test_areas_of_unequal_size_are_cut_to_what_both_show(first):
    part = Box(x0=0, y0=0, x1=50, y1=30)
    pair = area_match(LEFT, part) if first else area_match(part, LEFT)
    [cut] = judged_areas(PutativeAreas(confident=(pair,)), still(), 0.01, 0.5, min_matches=20).confident
    assert cut.state is AreaState.KEPT
    larger, smaller = (cut.area0.box, cut.area1.box) if first else (cut.area1.box, cut.area0.box)
    assert smaller == part
    assert (larger.x0, larger.y0, larger.x1) == (0, 0, 50)
    assert 30 <= larger.y1 <= 36  # the margin is a tenth of the long side


def test_doubtful_areas_stay_whole_since_they_exclude_each_other():
    part = Box(x0=0, y0=0, x1=50, y1=70)
    putative = PutativeAreas(doubtful=((area_match(LEFT, part),),))
    assert judged_areas(putative, still(), 0.01, 0.5, min_matches=20) == putative


@given(st.integers(0, 2**32 - 1), st.integers(0, 300), st.integers(0, 300))
def test_a_cut_area_lies_inside_the_whole_one(seed, joined, wrong):
    rng = np.random.default_rng(seed)
    sides = np.sort(rng.uniform(0, 100, (2, 2, 2)), axis=1)
    boxes = [Box(x0=x0, y0=y0, x1=x1, y1=y1) for (x0, y0), (x1, y1) in sides]
    pair = area_match(*boxes)
    found = matches(joined, wrong, seed)
    [cut] = judged_areas(PutativeAreas(confident=(pair,)), found, 1.0, 0.0, min_matches=0).confident
    for before, after in ((pair.area0.box, cut.area0.box), (pair.area1.box, cut.area1.box)):
        assert after.within(before) == after
    shared = [area.area0.box.contains(found.points0) & area.area1.box.contains(found.points1) for area in (pair, cut)]
    assert not (shared[1] & ~shared[0]).any()
    assert shared[1].sum() >= 0.8 * shared[0].sum()  # 2 % are left out at each of its four sides, in both images


@given(st.data())
def test_chance_is_the_tail_of_the_hypergeometric_distribution(data):
    count = data.draw(st.integers(0, 5000))
    leaving, arriving = data.draw(st.integers(0, count)), data.draw(st.integers(0, count))
    joined = data.draw(st.integers(0, min(leaving, arriving)))
    expected = float(hypergeom.sf(joined - 1, count, arriving, leaving)) if count else 1.0
    assert chance_of(joined, leaving, arriving, count) == pytest.approx(expected, rel=1e-8, abs=1e-300)
