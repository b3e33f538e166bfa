"""The stages on the rendered room, checked against its exact truth: areas, GP, GR, GMC, matches and tracks.

The point matcher knows the truth (see `TrueMatcher`), so that what fails here is the area matching and its geometry.
The bounds leave about a third of room to what was measured when they were written.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from sgam_core import (
    CovisibleAreaMatcher,
    PairResult,
    SemanticAreaMatcher,
    SGAMOptions,
    TileAreaMatcher,
    WholeImages,
    match_described,
)
from sgam_core.options import changed
from sgam_sfm.merging.merge import merge_keypoints
from sgam_sfm.scene import correspond
from tests.room import Room, TrueMatcher

Results = dict[tuple[str, str], PairResult]
ONE_ROUND = changed(SGAMOptions(), guidance__enabled=False)
"""The paper's algorithm alone."""


@pytest.fixture(scope="module")
def point_matcher(room: Room) -> TrueMatcher:
    return TrueMatcher(room)


def match_all(room: Room, point_matcher: TrueMatcher, options: SGAMOptions) -> Results:
    matcher = SemanticAreaMatcher(options=options.semantic)
    described = {name: matcher.describe(image, room.renderings[name].labels) for name, image in room.images.items()}
    return {
        (a, b): match_described(
            room.images[a], room.images[b], described[a], described[b], matcher, point_matcher, options
        )
        for a, b in combinations(room.images, 2)
    }


@pytest.fixture(scope="module")
def results(room: Room, point_matcher: TrueMatcher) -> Results:
    return match_all(room, point_matcher, ONE_ROUND)


def overlaps(room: Room, results: Results, state: str, predicted: bool | None = None) -> np.ndarray:
    """True area overlap ratios of all area matches in a state."""
    return np.array(
        [
            room.overlap(pair[0], area.area0.box, pair[1], area.area1.box)
            for pair, result in results.items()
            for area in result.areas
            if area.state == state and predicted in (None, area.predicted)
        ]
    )


def errors(room: Room, pair: tuple[str, str], result: PairResult) -> np.ndarray:
    """Distance of each match from the truth, pixels; infinite where the other view does not see the point."""
    points1, visible = correspond(result.matches.points0, room.views[pair[0]], room.views[pair[1]])
    return np.where(visible, np.linalg.norm(points1 - result.matches.points1, axis=1), np.inf)


def test_areas_that_are_kept_show_the_same_part_of_the_room(room, results):
    kept = overlaps(room, results, "kept")
    assert len(kept) >= 45
    assert kept.mean() > 0.45
    assert (kept > 0.2).mean() > 0.85


def test_gr_rejects_what_does_not_overlap(room, results):
    rejected = overlaps(room, results, "rejected")
    assert len(rejected) >= 7
    assert rejected.mean() < 0.5 * overlaps(room, results, "kept").mean()


def test_gp_finds_the_true_ones_among_look_alikes(room, results):
    chosen, left = overlaps(room, results, "kept", predicted=True), overlaps(room, results, "unresolved")
    assert len(chosen) >= 11
    assert len(left) >= 15
    assert chosen.mean() > 2 * left.mean()


def test_every_area_says_why_it_was_not_kept(results):
    for result in results.values():
        for area in result.areas:
            assert (area.state == "kept") == (area.reason == "")
            assert area.scale0 > 0
            assert area.scale1 > 0


def test_matches_of_overlapping_pairs_are_true(room, results):
    found = {pair: errors(room, pair, result) for pair, result in results.items() if len(result.matches) >= 300}
    assert len(found) >= 6
    for distances in found.values():
        assert np.median(distances) < 1.2
        assert (distances < 3).mean() > 0.7  # a tenth of the matcher's are outliers, and a few pixels lie on edges


def test_gmc_adds_true_matches_where_areas_cover_little(room, point_matcher):
    everywhere = match_all(room, point_matcher, ONE_ROUND)
    little = match_all(room, point_matcher, changed(ONE_ROUND, collection__min_coverage=0.3))
    never = match_all(room, point_matcher, changed(ONE_ROUND, collection__rule="none"))
    distances = [errors(room, pair, r)[r.matches.area_index < 0] for pair, r in everywhere.items() if not r.fallback]
    gained = np.concatenate(distances)
    assert len(gained) > 500
    assert (gained < 5).mean() > 0.8
    for pair, result in never.items():
        assert result.fallback or (result.matches.area_index >= 0).all()
        assert len(result.matches) <= len(little[pair].matches)
    assert sum(len(r.matches) for r in little.values()) < sum(len(r.matches) for r in everywhere.values())


def test_guided_areas_show_the_same_part_of_the_room_more_finely(room, point_matcher):
    coarse = changed(SGAMOptions(), crop__image_size=256, crop__area_size=320)
    guided = match_all(room, point_matcher, coarse)
    plain = {
        (a, b): match_described(room.images[a], room.images[b], None, None, WholeImages(), point_matcher, coarse)
        for a, b in guided
    }
    used = [pair for pair, result in guided.items() if any(area.area0.kind == "guided" for area in result.areas)]
    assert len(used) >= 8
    found = {pair: guided[pair] for pair in used}
    assert np.median(overlaps(room, found, "kept")) > 0.55
    finer, before = (
        np.median(np.concatenate([errors(room, pair, results[pair]) for pair in used])) for results in (guided, plain)
    )
    assert finer < 0.8 * before


@pytest.mark.parametrize(("matcher", "fewest"), [(TileAreaMatcher(), 50), (CovisibleAreaMatcher(), 9)])
def test_areas_without_labels_show_the_same_part_of_the_room(room, point_matcher, matcher, fewest):
    images, options = room.images, SGAMOptions()
    described = {name: matcher.describe(image, None) for name, image in images.items()}
    results = {
        (a, b): match_described(images[a], images[b], described[a], described[b], matcher, point_matcher, options)
        for a, b in combinations(images, 2)
    }
    kept = overlaps(room, results, "kept")
    assert len(kept) >= fewest
    assert np.median(kept) > 0.5


def test_tracks_follow_points_of_the_room(room, results):
    merged = merge_keypoints({pair: result.matches for pair, result in results.items()})
    total = true = 0
    for (a, b), rows in merged.matches.items():
        points1, visible = correspond(merged.keypoints[a][rows[:, 0]], room.views[a], room.views[b])
        distance = np.linalg.norm(points1 - merged.keypoints[b][rows[:, 1]], axis=1)
        total += len(rows)
        true += int((visible & (distance < 3)).sum())
    assert total > 3500
    assert true / total > 0.75
