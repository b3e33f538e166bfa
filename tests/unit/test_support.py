"""Area pairs that plain matches support, and those that they do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sgam_core.support import supported
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches, PutativeAreas

LEFT, RIGHT = Box(x0=0, y0=0, x1=50, y1=100), Box(x0=50, y0=0, x1=100, y1=100)


def area_match(box0: Box, box1: Box) -> AreaMatch:
    return AreaMatch(area0=Area(kind="object", box=box0), area1=Area(kind="object", box=box1), distance=0.1)


def matches(joined: int, wrong: int, seed: int = 0) -> Matches:
    """Some from left to left, the others from anywhere to anywhere."""
    rng = np.random.default_rng(seed)
    sides = [
        np.concatenate([rng.uniform(0, (50, 100), (joined, 2)), rng.uniform(0, 100, (wrong, 2))]) for _ in range(2)
    ]
    return Matches(points0=sides[0], points1=sides[1], scores=np.ones(joined + wrong))


def test_areas_that_matches_join_stay_and_others_are_skipped_with_the_reason():
    true, wrong = area_match(LEFT, LEFT), area_match(LEFT, RIGHT)
    judged = supported(PutativeAreas(confident=(true, wrong), doubtful=((wrong, true),)), matches(60, 100), 0.01, 0.0)
    assert judged.confident[0] == judged.doubtful[0][1] == true
    skipped = judged.confident[1]
    assert skipped.state == judged.doubtful[0][0].state == AreaState.SKIPPED
    assert skipped.reason.endswith("whole-image matches in its first area end in its second one, no more than chance")


@given(st.integers(0, 400), st.integers(0, 1000))
def test_chance_is_rarely_taken_for_support(wrong, seed):
    judged = supported(PutativeAreas(confident=(area_match(LEFT, LEFT),)), matches(0, wrong, seed), 1e-9, 0.0)
    assert judged.confident[0].state is AreaState.SKIPPED


@pytest.mark.parametrize("found", [Matches.empty(), matches(0, 1)])
def test_next_to_no_match_supports_nothing(found):
    judged = supported(PutativeAreas(confident=(area_match(LEFT, LEFT),)), found, 0.01, 0.0)
    assert judged.confident[0].state is AreaState.SKIPPED


@pytest.mark.parametrize(("height", "stays"), [(100, True), (70, True), (30, False)])
@pytest.mark.parametrize("first", [True, False])
def test_areas_that_overlap_in_a_small_part_are_skipped_whichever_is_the_larger(height, stays, first):
    part = Box(x0=0, y0=0, x1=50, y1=height)
    pair = area_match(LEFT, part) if first else area_match(part, LEFT)
    points = np.random.default_rng(0).uniform(0, 100, (400, 2))
    still = Matches(points0=points, points1=points, scores=np.ones(400))
    judged = supported(PutativeAreas(confident=(pair,)), still, 0.01, 0.5).confident[0]
    if stays:
        assert judged == pair
    else:
        assert judged.state is AreaState.SKIPPED
        assert judged.reason.endswith("they overlap in part")
