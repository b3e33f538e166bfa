"""Drawn pairs: what is drawn where, in which colour."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sgam_core.errors import InputError
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches, PairResult
from sgam_sfm.pictures import distinct_colour, draw_areas, write_png

GREY = np.full((120, 160, 3), 128, np.uint8)
BOX0, BOX1 = Box(x0=20, y0=30, x1=80, y1=90), Box(x0=40, y0=30, x1=100, y1=90)


def result_with(state=AreaState.KEPT, matches=None):
    areas = (AreaMatch(area0=Area(box=BOX0, kind="object"), area1=Area(box=BOX1, kind="object"), distance=0.1),)
    return PairResult(
        matches=matches or Matches.empty(),
        areas=tuple(replace(area, state=state) for area in areas),
        two_view=None,
        coverage0=0.25,
        coverage1=0.5,
        whole_scale0=1.0,
        whole_scale1=1.0,
    )


def pixels_of(picture, colour):
    return np.argwhere(np.all(picture == np.array(colour), axis=2))[:, ::-1]


def test_images_stand_side_by_side_under_a_caption():
    picture = draw_areas(GREY, GREY[:60], result_with(), max_width=1000)
    caption = picture.shape[0] - 120
    assert picture.shape == (120 + caption, 160 + 6 + 160, 3)  # never enlarged
    assert caption > 20
    narrow = draw_areas(GREY, GREY, result_with(), max_width=206)
    assert narrow.shape[1] == 206
    assert narrow.shape[0] - caption == 75


def test_areas_are_drawn_where_they_are_in_the_colour_of_their_match():
    picture = draw_areas(GREY, GREY, result_with())
    caption = picture.shape[0] - 120
    found = pixels_of(picture, distinct_colour(0)) - [0, caption]
    left, right = found[found[:, 0] < 160], found[found[:, 0] > 166] - [166, 0]
    np.testing.assert_allclose(left.min(axis=0), [20, 30], atol=2)
    np.testing.assert_allclose(left.max(axis=0), [80, 90], atol=2)
    np.testing.assert_allclose(right.min(axis=0), [40, 30], atol=2)
    np.testing.assert_allclose(right.max(axis=0), [100, 90], atol=2)


def test_only_kept_areas_have_whole_sides():
    drawn = {
        state: len(pixels_of(draw_areas(GREY, GREY, result_with(state)), distinct_colour(0))) for state in AreaState
    }
    assert drawn[AreaState.KEPT] == max(drawn.values())
    assert len(set(drawn.values())) == len(AreaState)  # every state looks different


def test_points_are_drawn_in_both_images():
    points = np.array([[50.5, 60.5]])
    matches = Matches(
        points0=points, points1=np.array([[70.5, 60.5]]), scores=np.ones(1), area_index=np.zeros(1, np.int32)
    )
    picture = draw_areas(GREY, GREY, result_with(matches=matches))
    caption = picture.shape[0] - 120
    assert tuple(picture[caption + 60, 50]) == distinct_colour(0)
    assert tuple(picture[caption + 60, 166 + 70]) == distinct_colour(0)


def test_labels_tint_all_but_void():
    labels = np.zeros((60, 80), np.int32)  # half as large as the image
    labels[:, 40:] = 7
    empty = replace(result_with(), areas=())
    plain = draw_areas(GREY, GREY, empty)
    picture = draw_areas(GREY, GREY, empty, labels0=labels)
    changed = np.any(picture != plain, axis=2)[-120:]
    assert not changed[:, :78].any()
    assert changed[:, 82:160].all()
    assert not changed[:, 166:].any()


def test_a_result_without_areas_says_so(tmp_path: Path):
    empty = replace(result_with(), areas=(), fallback="no areas")
    picture = draw_areas(GREY, GREY, empty, title="a.jpg - b.jpg")
    write_png(tmp_path / "pair.png", picture)
    read = cv2.imread(str(tmp_path / "pair.png"))[..., ::-1]
    np.testing.assert_array_equal(read, picture)


def test_a_missing_folder_is_named(tmp_path: Path):
    path = tmp_path / "missing" / "pair.png"
    with pytest.raises(InputError) as error:
        write_png(path, GREY)
    expected = f"cannot write picture '{path}' (No such file or directory); expected a folder that exists"
    assert str(error.value) == expected
