import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core import AreaMatcher, Box, Image, Matches, TileAreaMatcher, match_described
from sgam_core.errors import OptionError
from sgam_core.options import CropOptions, SGAMOptions, TileOptions, changed
from sgam_core.tiles import grid
from tests.two_views import HEIGHT, WIDTH, two_views


def blank(name: str, width: int, height: int, **more) -> Image:
    return Image(name=name, pixels=np.zeros((height, width, 3), np.uint8), **more)


def edges(width: int, height: int, **options) -> tuple[list, list]:
    """(x0, x1) of every column and (y0, y1) of every row of the grid, whose tiles are their product."""
    tiles = grid(width, height, TileOptions(**options))
    columns, rows = sorted({(t.x0, t.x1) for t in tiles}), sorted({(t.y0, t.y1) for t in tiles})
    assert [(t.x0, t.x1, t.y0, t.y1) for t in tiles] == [(*column, *row) for row in rows for column in columns]
    return columns, rows


def joining(*groups) -> Matches:
    """Matches between points: (count, point0, point1) a group."""
    counts, points0, points1 = (np.array(column) for column in zip(*groups, strict=True))
    return Matches(
        points0=np.repeat(points0, counts, axis=0).astype(float),
        points1=np.repeat(points1, counts, axis=0).astype(float),
        scores=np.ones(counts.sum()),
    )


def propose(matches: Matches, sizes=((300, 200), (300, 200)), **options):
    matcher = TileAreaMatcher(options=TileOptions(**({"verify": False} | options)))
    d0, d1 = (matcher.describe(blank(name, *size), None) for name, size in zip("ab", sizes, strict=True))
    putative = matcher.match(d0, d1, lambda: matches)
    tiles0, tiles1 = d0.tiles, d1.tiles
    return putative, [(tiles0.index(m.area0.box), tiles1.index(m.area1.box)) for m in putative.confident]


def test_tiles_are_squares_of_a_share_of_the_long_side_evenly_spaced():
    # side 120, at least 12 px of overlap: (300 - 120) / 108 = 1.7, so two steps of 90 px; (200 - 120) / 108: one.
    columns, rows = [(0, 120), (90, 210), (180, 300)], [(0, 120), (80, 200)]
    assert edges(300, 200) == (columns, rows)
    assert edges(200, 300) == (rows, columns)
    assert edges(3000, 2000)[0] == [(0, 1200), (900, 2100), (1800, 3000)]


def test_tiles_touch_without_overlap_and_one_may_be_the_whole_image():
    touching = edges(1000, 500, side_share=0.25, overlap_share=0)
    assert touching == ([(0, 250), (250, 500), (500, 750), (750, 1000)], [(0, 250), (250, 500)])
    assert edges(300, 200, side_share=1) == ([(0, 300)], [(0, 200)])


def test_tiles_are_cut_to_an_image_that_is_narrower():
    assert edges(1000, 100) == ([(0, 400), (300, 700), (600, 1000)], [(0, 100)])
    assert edges(1, 1) == ([(0, 1)], [(0, 1)])


def test_tiles_that_enough_matches_join_are_pairs_strongest_first():
    # Tiles are numbered row by row: 0 1 2 above 3 4 5; all points lie in one tile only.
    matches = joining((9, (20, 150), (150, 150)), (10, (150, 20), (20, 20)), (11, (20, 20), (290, 190)))
    putative, pairs = propose(matches)
    assert pairs == [(0, 5), (1, 0)]
    assert [m.distance for m in putative.confident] == [pytest.approx(1 - 11 / 30), pytest.approx(1 - 10 / 30)]
    assert {m.area0.kind for m in putative.confident} == {"tile"}
    assert putative.notes == ()
    assert propose(matches, min_matches=9)[1] == [(0, 5), (1, 0), (3, 4)]


def test_a_limit_takes_the_strongest_and_is_reported():
    matches = joining((9, (20, 150), (150, 150)), (10, (150, 20), (20, 20)), (11, (20, 20), (290, 190)))
    putative, pairs = propose(matches, min_matches=1, max_pairs=1)
    assert pairs == [(0, 5)]
    assert putative.notes == ("2 tile pairs beyond max_pairs",)
    assert len(propose(matches, min_matches=0, max_pairs=0)[1]) == 3


def test_of_overlapping_tiles_the_one_with_its_matches_in_the_middle_comes_first():
    # x = 115 lies in columns 0 and 1, 55 and 35 px from their centres.
    assert propose(joining((10, (115, 20), (20, 20))))[1] == [(1, 0), (0, 0)]
    assert propose(joining((10, (20, 20), (115, 20))))[1] == [(0, 1), (0, 0)]


def test_of_equals_that_a_limit_would_part_none_is_taken():
    mirrored = joining((10, (20, 20), (280, 20)), (10, (280, 20), (20, 20)))
    assert propose(mirrored, max_pairs=1)[1] == []
    assert propose(mirrored, max_pairs=2)[1] == [(0, 2), (2, 0)]


def test_images_of_different_sizes_have_their_own_tiles():
    assert propose(joining((10, (20, 20), (1900, 2900))), sizes=((300, 200), (2000, 3000)))[1] == [(0, 5)]


def test_matches_that_contradict_the_pairs_geometry_are_not_counted():
    matches, size = two_views(300, noise=0.3, outliers=0.5, seed=1).matches, (WIDTH, HEIGHT)
    everything = propose(matches, (size, size), min_matches=3, max_pairs=0)[1]
    agreeing = propose(matches, (size, size), min_matches=3, max_pairs=0, verify=True)[1]
    assert (0, 5) in everything
    assert set(agreeing) < set(everything)
    assert {(k, k) for k in range(6)} <= set(agreeing)
    assert not {(0, 5), (5, 0), (2, 3), (3, 2)} & set(agreeing)


def test_few_matches_are_counted_without_a_geometry():
    assert propose(joining((12, (20, 20), (290, 190))), verify=True)[1] == [(0, 5)]


@pytest.mark.parametrize("change", [{"side_share": 0.01}, {"side_share": 1.5}, {"overlap_share": 1.0}])
def test_options_that_make_no_grid_are_refused(change):
    (name,) = change
    with pytest.raises(OptionError, match=rf"{name} is .*; expected a number from"):
        TileOptions(**change)


def test_the_crop_is_the_tile_with_its_mask():
    mask = np.zeros((200, 300), bool)
    mask[:, 150:] = True
    crop = TileAreaMatcher().crop(blank("a", 300, 200, mask=mask), Box(x0=90, y0=80, x1=210, y1=200), CropOptions())
    assert crop.window == Box(x0=90, y0=80, x1=210, y1=200)
    assert crop.size == (120, 120)
    np.testing.assert_array_equal(crop.mask(), mask[80:200, 90:210])
    options = CropOptions(area_size=60)
    assert TileAreaMatcher().crop(blank("a", 300, 200), Box(x0=0, y0=0, x1=120, y1=80), options).size == (60, 40)


class Fixed:
    """A point matcher that knows the matches of the whole images, and gives every crop those inside it."""

    def __init__(self, matches: Matches) -> None:
        self.matches, self.windows = matches, []

    def match(self, pairs):
        self.windows += [(crop0.window, crop1.window) for crop0, crop1 in pairs]
        return [self._inside(*pair) for pair in pairs]

    def _inside(self, crop0, crop1) -> Matches:
        m = self.matches.select(crop0.window.contains(self.matches.points0))
        m = m.select(crop1.window.contains(m.points1))
        points0, points1 = (
            p @ c.crop_from_image[:, :2].T + c.crop_from_image[:, 2]
            for p, c in ((m.points0, crop0), (m.points1, crop1))
        )
        return Matches(points0=points0, points1=points1, scores=m.scores)


def run(matches: Matches):
    matcher, points = TileAreaMatcher(), Fixed(matches)
    images = blank("a", WIDTH, HEIGHT), blank("b", WIDTH, HEIGHT)
    described = [matcher.describe(image, None) for image in images]
    options = changed(SGAMOptions(), crop__max_crop_pixels=4_000_000)  # for all tiles
    return match_described(*images, *described, matcher, points, options), points


def test_tiles_go_through_all_stages_and_the_matcher_sees_the_tiles_themselves():
    result, points = run(two_views(2000, noise=0.3, outliers=0.1, seed=1).matches)
    kept = [area for area in result.areas if area.state == "kept"]
    assert not result.fallback
    assert len(kept) >= 6
    assert (result.matches.area_index >= 0).sum() > 1000
    assert points.windows[1:] == [(area.area0.box, area.area1.box) for area in result.areas]


def test_images_without_matches_fall_back_to_whole_images():
    result, points = run(Matches.empty())
    assert (result.fallback, result.areas, len(points.windows)) == ("no area match", (), 1)


sizes = st.tuples(st.integers(1, 1500), st.integers(1, 1500))


@settings(deadline=None)
@given(sizes, sizes, st.floats(0.05, 1), st.floats(0, 0.9), st.integers(0, 6), st.integers(0, 60), st.booleans())
def test_tiles_lie_inside_and_swapping_the_images_swaps_them(size0, size1, side, overlap, limit, count, verify):
    options = TileOptions(side_share=side, overlap_share=overlap, min_matches=2, max_pairs=limit, verify=verify)
    tiles = grid(*size0, options)
    assert all(0 <= t.x0 < t.x1 <= size0[0] and 0 <= t.y0 < t.y1 <= size0[1] for t in tiles)
    rng = np.random.default_rng(count)
    points0, points1 = (rng.uniform(0, 1, (count, 2)) * size for size in (size0, size1))
    assert all(any(t.contains(point[None])[0] for t in tiles) for point in points0)
    matches = Matches(points0=points0, points1=points1, scores=np.ones(count))
    matcher = TileAreaMatcher(options=options)
    assert isinstance(matcher, AreaMatcher)
    d0, d1 = matcher.describe(blank("a", *size0), None), matcher.describe(blank("b", *size1), None)
    forth, back = matcher.match(d0, d1, lambda: matches), matcher.match(d1, d0, matches.swapped)
    assert forth == matcher.match(d0, d1, lambda: matches)
    assert {(m.area0, m.area1, m.distance) for m in forth.confident} == {
        (m.area1, m.area0, m.distance) for m in back.confident
    }
