import numpy as np
import pytest

from sgam_core.types import Crop
from sgam_sfm.matchers.coarse_loftr import _CENTERS, CoarseLoFTR, _expected, _mutual_best, _view
from tests.paths import WEIGHTS, weights_of
from tests.textures import similarity, transfer, view, whole


@pytest.fixture(scope="module")
def matcher():
    path = weights_of("coarse-loftr")
    if path is None:
        pytest.skip(f"no coarse LoFTR in '{WEIGHTS}'; set SGAM_SFM_WEIGHTS")
    return CoarseLoFTR(weights=path, threads=1)


@pytest.mark.parametrize(
    ("size", "scale", "degrees"), [((333, 251), 1.0, 0), ((401, 301), 1.2, 8), ((301, 401), 0.9, -8)]
)
def test_matches_are_precise_far_below_the_grid(matcher, size, scale, degrees):
    warp = similarity(scale, degrees, (7.3, -4.6), (size[0] / 2, size[1] / 2))
    pair = whole(view(np.eye(3), size), "first"), whole(view(warp, size), "second")
    (matches,) = matcher.match([pair])
    errors = transfer(warp, matches.points0) - matches.points1
    assert len(matches) > 30
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.15
    assert np.abs(np.median(errors, axis=0)).max() < 0.05


def test_padding_and_masked_cells_are_not_wanted():
    pixels = view(np.eye(3), (160, 240))  # portrait: 320 of 640 columns
    mask = np.ones((240, 160), bool)
    mask[120:] = False
    wanted = _view(whole(pixels, "a", mask)).wanted.reshape(30, 40)
    assert wanted[:15, :20].all()
    assert wanted.sum() == 15 * 20


def test_anchors_lie_in_their_cells_in_the_pixels_of_the_crop():
    seen = _view(whole(view(np.eye(3), (320, 240)), "a"))
    assert seen.scale.tolist() == [2, 2]
    assert seen.frame.shape == (480, 640)
    assert np.abs(seen.anchors * 2 - _CENTERS).max() <= 8
    assert ((seen.anchors >= 0) & (seen.anchors < (320, 240))).all()


def test_expectation_over_the_neighbouring_cells():
    likelihood = np.zeros((1200, 1200), np.float32)
    likelihood[0, [85, 86, 125]] = [0.5, 0.25, 0.25]  # cell (5, 2), its right and its lower neighbour
    likelihood[0, 700] = 0.9  # too far to matter
    likelihood[1, 0] = 0.3  # a corner of the grid
    np.testing.assert_allclose(
        _expected(likelihood, np.array([0, 1]), np.array([85, 0])), [[84.5, 36.5], [0.5, 0.5]], atol=1e-5
    )


def test_mutual_best_cells_above_the_minimum():
    likelihood = np.array([[0.9, 0.1, 0], [0.8, 0.3, 0.2], [0, 0.05, 0.06]], np.float32)
    assert [cells.tolist() for cells in _mutual_best(likelihood, 0.1)] == [[0], [0]]
    assert [cells.tolist() for cells in _mutual_best(likelihood, 0.05)] == [[0], [0]]


def test_crop_larger_than_the_frame_keeps_its_own_pixels_for_the_refinement():
    crop = whole(view(np.eye(3), (64, 48)), "a")
    enlarged = Crop(image=crop.image, window=crop.window, size=(960, 720))
    seen = _view(enlarged)
    assert seen.gray.shape == (720, 960)
    np.testing.assert_allclose(seen.scale, 2 / 3)
