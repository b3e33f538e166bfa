"""Areas that put one place of an image in two places of the other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core.prediction import MatchedArea
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches
from sgam_core.uniqueness import without_contradictions

SHEAR = np.array([[1.2, 0.1], [-0.05, 0.9]])


def area(x: float, y: float, side: float = 200, count: int = 60, shift: float = 0.0, seed: int = 0) -> MatchedArea:
    """A window of a facade, put `shift` pixels to the right of where it is in image 1."""
    rng = np.random.default_rng(seed)
    points0 = np.array([x, y]) + rng.uniform(0, side, (count, 2))
    points1 = points0 @ SHEAR.T + [300 + shift, 40] + rng.normal(0, 3, (count, 2))
    boxes = [Box(x0=low[0], y0=low[1], x1=high[0], y1=high[1]) for low, high in map(corners, (points0, points1))]
    first, second = (Area(kind="guided", box=box) for box in boxes)
    found = Matches(points0=points0, points1=points1, scores=np.ones(count, np.float32))
    return MatchedArea(area=AreaMatch(area0=first, area1=second, distance=0.0), matches=found)


def corners(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return points.min(axis=0) - 20, points.max(axis=0) + 20


def kept(areas: list[MatchedArea]) -> list[bool]:
    return [each.area.state is AreaState.KEPT for each in without_contradictions(areas)]


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 900), st.integers(0, 500), st.integers(10, 80)), min_size=1, max_size=7))
def test_areas_of_one_view_do_not_contradict_each_other(places):
    assert all(kept([area(x, y, count=count, seed=row) for row, (x, y, count) in enumerate(places)]))


@settings(max_examples=40, deadline=None)
@given(st.permutations(range(4)), st.sampled_from([-400, 250, 700]))
def test_one_that_is_a_window_further_is_rejected_whatever_the_order(order, shift):
    areas = [area(0, 0, count=90), area(150, 30, count=80, seed=1), area(20, 10, shift=shift), area(600, 0, seed=2)]
    judged = without_contradictions([areas[row] for row in order])
    assert [each.area.state is AreaState.KEPT for each in judged] == [row != 2 for row in order]
    assert {each.area.reason for each in judged} == {"", "areas with more matches put the same ground elsewhere"}


def test_two_places_of_one_image_are_not_one_place_of_the_other():
    right, wrong = area(400, 0, count=90), area(0, 0, shift=480)
    assert not right.area.area0.box.contains(wrong.matches.points0).any()
    assert right.area.area1.box.contains(wrong.matches.points1).mean() > 0.9
    assert kept([wrong, right]) == [False, True]


@pytest.mark.parametrize(("x", "expected"), [(0, False), (180, True)])
def test_a_few_shared_points_tell_nothing(x, expected):
    assert kept([area(0, 0, count=90), area(x, 0, shift=400)]) == [True, expected]


def test_areas_that_were_not_kept_have_no_say():
    skipped = area(0, 0, count=200).resolved(AreaState.SKIPPED, "beyond the budget")
    [first, second] = without_contradictions([skipped, area(10, 0, shift=400)])
    assert first is skipped
    assert second.area.state is AreaState.KEPT
