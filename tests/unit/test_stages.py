"""GP, GR and GMC on areas of exact two-view scenes."""

from dataclasses import replace

import numpy as np
import pytest

from sgam_core import collection
from sgam_core.collection import collect, coverage, merge
from sgam_core.geometry import estimate_two_view, residuals
from sgam_core.options import CollectionOptions, GeometryOptions, PredictionOptions, RejectionOptions
from sgam_core.prediction import MatchedArea, predict
from sgam_core.rejection import reject
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches
from tests.two_views import two_views

GEOMETRY = GeometryOptions()
WINDOWS = [(50, 50, 350, 350), (400, 50, 700, 350), (50, 400, 350, 700), (400, 400, 700, 700), (700, 200, 990, 500)]


def box_of(window) -> Box:
    x0, y0, x1, y1 = map(float, window)
    return Box(x0=x0, y0=y0, x1=x1, y1=y1)


def estimate(matches: Matches):
    return estimate_two_view(matches, None, None, GEOMETRY)


def true_area(window, seed: int, count: int = 120) -> MatchedArea:
    matches = two_views(count, noise=0.3, outliers=0.1, seed=seed, window=window).matches
    return MatchedArea(area=area_match(window, window), matches=matches)


def wrong_area(window0, window1, seed: int, count: int = 120) -> MatchedArea:
    """The points of one window matched, in order, with those of another: what a matcher finds on look-alikes."""
    first = two_views(count, noise=0.3, outliers=0, seed=seed, window=window0).matches
    shift = np.array(window1[:2]) - np.array(window0[:2])
    points1 = first.points1 + shift + [0, 25.0]
    matches = Matches(points0=first.points0, points1=points1, scores=first.scores)
    return MatchedArea(area=area_match(window0, window1), matches=matches)


def area_match(window0, window1) -> AreaMatch:
    return AreaMatch(
        area0=Area(kind="object", box=box_of(window0), label=1),
        area1=Area(kind="object", box=box_of(window1), label=1),
        distance=0.1,
    )


def states(areas) -> list[str]:
    return [str(area.area.state) for area in areas]


# GP


def test_gp_picks_the_true_candidates_of_two_look_alikes():
    confident = [true_area(WINDOWS[k], seed=k) for k in (2, 3, 4)]
    a, b = WINDOWS[0], WINDOWS[1]
    group = [true_area(a, 10), wrong_area(a, b, 11), wrong_area(b, a, 12), true_area(b, 13)]
    judged = predict(confident, [group], estimate, GEOMETRY, PredictionOptions())
    assert states(judged) == ["kept", "unresolved", "unresolved", "kept"]
    assert [area.area.predicted for area in judged] == [True, False, False, True]
    assert judged[1].area.reason.startswith("GP: not the consistent choice (cost ")


def test_gp_works_with_more_areas_on_one_side():
    confident = [true_area(WINDOWS[k], seed=k) for k in (2, 3, 4)]
    a, b = WINDOWS[0], WINDOWS[1]
    assert states(
        predict(confident, [[wrong_area(b, a, 1), true_area(a, 2)]], estimate, GEOMETRY, PredictionOptions())
    ) == [
        "unresolved",
        "kept",
    ]


def test_gp_leaves_all_alone_when_no_candidate_is_true():
    confident = [true_area(WINDOWS[k], seed=k) for k in (2, 3, 4)]
    a, b = WINDOWS[0], WINDOWS[1]
    group = [wrong_area(a, b, 1), wrong_area(b, a, 2)]
    assert states(predict(confident, [group], estimate, GEOMETRY, PredictionOptions())) == ["unresolved"] * 2


def test_gp_does_not_choose_between_candidates_that_fit_alike():
    confident = [true_area(WINDOWS[k], seed=k) for k in (2, 3, 4)]
    a, b = WINDOWS[0], WINDOWS[1]
    twice = true_area(a, 10)
    twin = MatchedArea(area=area_match(a, b), matches=twice.matches)
    sure = true_area(WINDOWS[4], 20)
    judged = predict(
        confident, [[twice, twin], [sure, wrong_area(WINDOWS[4], a, 3)]], estimate, GEOMETRY, PredictionOptions()
    )
    assert states(judged) == ["unresolved", "unresolved", "kept", "unresolved"]
    assert "GP: ambiguous, costs" in judged[0].area.reason + judged[1].area.reason


def test_gp_enumerates_without_confident_matches():
    a, b = WINDOWS[0], WINDOWS[1]
    group = [true_area(a, 10), wrong_area(a, b, 11), wrong_area(b, a, 12), true_area(b, 13)]
    assert states(predict([], [group], estimate, GEOMETRY, PredictionOptions())) == [
        "kept",
        "unresolved",
        "unresolved",
        "kept",
    ]


def test_gp_does_not_enumerate_large_groups():
    group = [true_area(window, k) for k, window in enumerate(WINDOWS)]
    judged = predict([], [group], estimate, GEOMETRY, PredictionOptions())
    assert {area.area.reason for area in judged} == {
        "GP: 5 x 5 doubtful areas without a confident match (max_enumerated)"
    }


def test_gp_can_be_turned_off():
    judged = predict([], [[true_area(WINDOWS[0], 1)]], estimate, GEOMETRY, PredictionOptions(enabled=False))
    assert [(area.area.state, area.area.reason) for area in judged] == [(AreaState.UNRESOLVED, "GP is off")]


# GR


def judge(areas, rule="consensus", whole=None, **options):
    return reject(
        areas,
        lambda: Matches.empty() if whole is None else whole,
        whole is not None,
        estimate,
        GEOMETRY,
        RejectionOptions(rule=rule, **options),
    )


@pytest.mark.parametrize("rule", ["consensus", "paper"])
def test_gr_rejects_the_wrong_areas_and_keeps_the_true_ones(rule):
    areas = [true_area(window, k) for k, window in enumerate(WINDOWS)]
    areas += [wrong_area(WINDOWS[0], WINDOWS[3], 9)]
    verdict = judge(areas, rule, phi=0.5)
    assert states(verdict.areas) == ["kept"] * 5 + ["rejected"]
    assert verdict.fallback == ""
    assert verdict.model is not None
    assert verdict.areas[0].area.num_inliers > 90


@pytest.mark.parametrize("phi", [0.5, 0.99])
def test_gr_as_printed_rejects_everything(phi):
    verdict = judge([true_area(window, k) for k, window in enumerate(WINDOWS)], "paper-literal", phi=phi)
    assert states(verdict.areas) == ["rejected"] * 5
    assert verdict.fallback == "GR rejected all: 5 area matches"


def test_gr_states_its_reasons():
    few = true_area(WINDOWS[4], 7, count=14)
    verdict = judge([*(true_area(WINDOWS[k], k) for k in range(4)), few, wrong_area(WINDOWS[0], WINDOWS[1], 9)])
    assert verdict.areas[4].area.reason.endswith("inliers of 14, below 15")
    assert verdict.areas[5].area.reason.startswith("GR: ")


def test_gr_compares_a_single_area_with_the_whole_images():
    whole = two_views(500, noise=0.4, outliers=0.3, seed=2).matches
    assert states(judge([true_area(WINDOWS[0], 1)], whole=whole).areas) == ["kept"]
    assert states(judge([wrong_area(WINDOWS[0], WINDOWS[3], 1)], whole=whole).areas) == ["rejected"]


def test_gr_leaves_kept_areas_their_inliers_so_that_outliers_do_not_open_gmc():
    areas = [true_area(window, k) for k, window in enumerate(WINDOWS)]  # a tenth are outliers
    verdict = judge(areas)
    assert verdict.model is not None
    assert states(verdict.areas) == ["kept"] * 5
    for before, after in zip(areas, verdict.areas, strict=True):
        assert 0.85 * len(before.matches) < len(after.matches) < 0.95 * len(before.matches)
        assert (residuals(verdict.model.F, after.matches) <= GEOMETRY.max_residual).mean() > 0.97
    whole = Matches.concatenate([area.matches for area in areas])
    inside = [area.matches for area in verdict.areas]
    collected = collect(inside, 0.1, verdict.model, lambda: whole, CollectionOptions())
    assert (residuals(verdict.model.F, collected) <= 1).all()
    assert len(collected) > 0.75 * len(whole)


def test_gr_falls_back_when_the_areas_agree_on_nothing():
    rng = np.random.default_rng(0)

    def noise(window) -> MatchedArea:
        points = [rng.uniform(window[:2], window[2:], (100, 2)) for _ in range(2)]
        return MatchedArea(
            area=area_match(window, window), matches=Matches(points0=points[0], points1=points[1], scores=np.ones(100))
        )

    verdict = judge([noise(window) for window in WINDOWS])
    assert verdict.fallback.startswith("areas disagree: 0.")


def test_gr_without_areas_says_so():
    assert judge([]).fallback == "no area match"
    gone = true_area(WINDOWS[0], 1).resolved(AreaState.UNRESOLVED, "GP: ...")
    skipped = true_area(WINDOWS[0], 1).resolved(AreaState.SKIPPED, "no more than chance")
    assert judge([gone, skipped]).fallback == "no area match left after GP"
    assert judge([skipped]).fallback == "every area match was skipped"


@pytest.mark.parametrize("rule", ["paper", "none"])
def test_gr_falls_back_where_areas_have_too_few_matches_for_a_geometry(rule):
    verdict = judge([true_area(WINDOWS[0], 1, count=3)], rule)
    assert (verdict.model, verdict.fallback) == (None, "no geometry: the areas' matches give none")


def test_gr_can_be_turned_off():
    verdict = judge([wrong_area(WINDOWS[0], WINDOWS[3], 1), true_area(WINDOWS[1], 2)], "none")
    assert states(verdict.areas) == ["kept", "kept"]


# GMC


def test_coverage_counts_overlaps_once():
    boxes = [box_of((0, 0, 50, 100)), box_of((25, 0, 75, 100)), box_of((90, 90, 500, 500))]
    assert coverage(boxes, 100, 100) == pytest.approx(0.75 + 0.01)
    assert coverage([], 100, 100) == 0.0


def test_gmc_collects_consistent_whole_image_matches_only_where_areas_cover_little():
    inside = two_views(200, noise=0.3, outliers=0, seed=1, window=WINDOWS[0]).matches
    whole = two_views(600, noise=0.3, outliers=0.5, seed=2).matches
    model = estimate(two_views(500, noise=0.1, outliers=0, seed=3).matches)
    found = collect([inside], 0.1, model, lambda: whole, CollectionOptions(min_coverage=0.3))
    assert 250 < len(found) < 330
    assert len(collect([inside], 0.5, model, lambda: whole, CollectionOptions(min_coverage=0.3))) == 0
    assert len(collect([inside], 0.1, None, lambda: whole, CollectionOptions(min_coverage=0.3))) == 0
    assert len(collect([Matches.empty()], 0.1, model, lambda: whole, CollectionOptions(min_coverage=0.3))) == 0
    literal = collect([inside], 0.1, model, lambda: whole, CollectionOptions(rule="paper-literal", min_coverage=0.3))
    paper = collect([inside], 0.1, model, lambda: whole, CollectionOptions(rule="paper", min_coverage=0.3))
    assert len(paper) < len(found) < len(literal)


def matches(points0, points1, sigma: float, area: int) -> Matches:
    count = len(points0)
    return Matches(
        points0=np.array(points0, float),
        points1=np.array(points1, float),
        scores=np.ones(count),
        sigmas0=np.full(count, sigma),
        sigmas1=np.full(count, sigma),
        area_index=np.full(count, area, np.int32),
    )


def test_merging_keeps_the_finer_of_duplicates_and_drops_coarse_matches_on_covered_ground():
    coarse_area = matches([[10, 10], [40, 40]], [[110, 10], [140, 40]], 2.0, 0)
    fine_area = matches([[10.5, 10]], [[110.5, 10]], 1.0, 1)
    whole = matches([[20, 10], [200, 200], [10, 10]], [[120, 10], [300, 200], [500, 500]], 3.0, -1)
    merged = merge([coarse_area, fine_area], whole, CollectionOptions())
    # (20, 10) lies within 8 x 3 px of the finer (10.5, 10) in both images; (10, 10) does so in image 0 only.
    np.testing.assert_array_equal(merged.points0, [[10.5, 10], [40, 40], [200, 200], [10, 10]])
    np.testing.assert_array_equal(merged.area_index, [1, 0, -1, -1])


@pytest.mark.parametrize("together", [7, 1024])
def test_coarse_matches_on_covered_ground_are_found_as_one_by_one(monkeypatch, together):
    monkeypatch.setattr(collection, "_TOGETHER", together)
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 100, (2, 300, 2))
    fine = replace(matches(*points[:, :150], 1.0, 0), sigmas1=rng.choice([1.0, 3.0], 150).astype(np.float32))
    coarse = matches(*(points[:, 50:250] + rng.normal(0, 4, (2, 200, 2))), 2.0, -1)
    expected = [
        any(
            max(fine.sigmas0[row], fine.sigmas1[row]) < 2.0
            and np.linalg.norm(fine.points0[row] - point0) <= 3 * 2.0
            and np.linalg.norm(fine.points1[row] - point1) <= 3 * 2.0
            for row in range(len(fine))
        )
        for point0, point1 in zip(coarse.points0, coarse.points1, strict=True)
    ]
    merged = merge([fine], coarse, CollectionOptions(covered_px=3.0, duplicate_px=0.0))
    left = merged.points0[merged.area_index == -1]
    assert 0 < sum(expected) < len(coarse)
    np.testing.assert_array_equal(left, coarse.points0[~np.array(expected)])


def test_merging_nothing_gives_nothing():
    assert len(merge([], Matches.empty(), CollectionOptions())) == 0
