"""What every registered point matcher must do, whatever it is made of."""

from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sgam_core.errors import WeightsError
from sgam_core.types import Box, Crop, Matches
from sgam_sfm import models
from sgam_sfm.external import WorkerCommand
from sgam_sfm.machine import single_threads
from sgam_sfm.matchers.vismatch import VARIABLE, environment, how_to_make, python_of
from sgam_sfm.registry import available, create
from sgam_sfm.runs.matching import is_concurrent
from sgam_sfm.threads import in_order
from tests.paths import weights_of
from tests.textures import similarity, transfer, view, whole

SIZE = (320, 240)
MAX_FEATURES = 512  # of a crop, for those that take a bound: enough here, and quick
BATCHES = {"batch": 3, "batch_size": 3, "batch_pixels": 2**20}  # by whatever name a matcher takes it
SHIFT = 7.25
CARDS = {card.name: card for card in models.CARDS}
WARP = similarity(1.1, 6, (7.3, -4.6), (160, 120))


@cache
def _made(name: str, **settings: Any):
    return create("matcher", name, weights=weights_of(name), max_features=MAX_FEATURES, **settings)


WORKER = Path(__file__).parents[1] / "workers" / "sift_worker.py"


def _settings(name: str, request) -> dict[str, Any]:
    """What a matcher needs besides its defaults."""
    if name == "vismatch" and not python_of(environment()).is_file():
        pytest.skip(f"vismatch is not installed; `{how_to_make()}`, or set {VARIABLE}")
    if name not in ("vismatch", "external"):
        return {}
    python = request.getfixturevalue("other_python") if name == "external" else None
    return {"worker": WorkerCommand(kind="matcher", name=name, python=python, script=WORKER)}


@pytest.fixture(params=["vismatch:sift-nn" if name == "vismatch" else name for name in available("matcher")])
def make(request):
    """Makes one of the matchers. Crops of other content have other names, so that what it keeps serves all tests."""
    card = CARDS[request.param.partition(":")[0]]
    settings = _settings(card.name, request)
    missing = [module for module in card.modules if find_spec(module) is None]
    if missing:
        pytest.skip(f"{request.param}: {', '.join(missing)} is not installed")
    try:
        _made(request.param, **settings)
    except WeightsError as error:
        variable = "SGAM_SFM_LOFTR_WEIGHTS" if request.param == "loftr" else "SGAM_SFM_WEIGHTS"
        pytest.skip(f"{request.param}: {error}; or set {variable}")
    return partial(_made, request.param, **settings)


@pytest.fixture
def matcher(make):
    return make()


@cache
def _pixels(which: int) -> np.ndarray:
    return view(np.eye(3) if which == 0 else WARP, SIZE)


@pytest.fixture
def pair() -> tuple[Crop, Crop]:
    """A textured image and the same through `WARP`."""
    return whole(_pixels(0), "first"), whole(_pixels(1), "second")


def check(matches: Matches, crop0: Crop, crop1: Crop) -> None:
    for points, crop in ((matches.points0, crop0), (matches.points1, crop1)):
        assert points.dtype == np.float64
        assert points.shape == (len(matches), 2)
        assert np.isfinite(points).all()
        assert ((points >= 0) & (points < crop.size)).all()
    for values in (matches.scores, matches.sigmas0, matches.sigmas1):
        assert values.dtype == np.float32
        assert values.shape == (len(matches),)
        assert np.isfinite(values).all()
    assert ((matches.scores >= 0) & (matches.scores <= 1)).all()
    assert (matches.sigmas >= 1).all()


def assert_equal(a: Matches, b: Matches) -> None:
    for name in ("points0", "points1", "scores"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def errors(matches: Matches) -> np.ndarray:
    return np.linalg.norm(transfer(WARP, matches.points0) - matches.points1, axis=1)


def test_known_warp_is_recovered_below_a_pixel(matcher, pair):
    (matches,) = matcher.match([pair])
    check(matches, *pair)
    assert len(matches) > 40
    assert np.median(errors(matches)) < 0.5
    assert (errors(matches) < 3).mean() > 0.9


def test_a_known_shift_comes_back_in_corner_origin(matcher, pair):
    # The texture is known between pixels, so nothing is resampled. A view of three quarters the size tells the origins
    # apart: half a pixel too much on both sides is an eighth of one there.
    moved = np.eye(3)
    moved[0, 2] = SHIFT
    shifted = whole(view(moved, SIZE), "shifted")
    (matches,) = matcher.match([(pair[0], shifted)])
    check(matches, pair[0], shifted)
    offsets = matches.points1 - matches.points0
    near = np.linalg.norm(offsets - (SHIFT, 0), axis=1) < 1
    assert near.mean() > 0.9
    assert np.abs(np.median(offsets, axis=0) - (SHIFT, 0)).max() < 0.1
    assert np.abs(offsets[near].mean(0) - (SHIFT, 0)).max() < 0.1

    small = whole(view(np.diag([0.75, 0.75, 1]), (240, 180)), "smaller")
    (matches,) = matcher.match([(pair[0], small)])
    assert len(matches) > 20
    assert np.abs(np.median(matches.points1 - 0.75 * matches.points0, axis=0)).max() < 0.1


def test_a_batch_equals_one_by_one(make, pair):
    matcher = make(**BATCHES)
    pairs = [pair, pair[::-1], (pair[0], pair[0])]
    together = matcher.match(pairs)
    for crops, batched in zip(pairs, together, strict=True):
        (alone,) = matcher.match([crops])
        assert len(alone) > 20
        assert abs(len(alone) - len(batched)) <= 0.01 * len(alone)
        joined = cKDTree(np.hstack([batched.points0, batched.points1]))
        distances, _ = joined.query(np.hstack([alone.points0, alone.points1]), p=np.inf)
        assert (distances < 1e-3).mean() >= 0.99


def test_nothing_asked_nothing_returned(matcher):
    assert matcher.match([]) == []


@pytest.mark.parametrize("level", [0, 128])
def test_blank_images(matcher, pair, level):
    blank = whole(np.full((240, 320, 3), level, np.uint8), f"blank {level}")
    other = whole(np.full((100, 200, 3), level, np.uint8), f"other {level}")
    for crops in ((blank, blank), (blank, other), (pair[0], blank)):
        check(matcher.match([crops])[0], *crops)


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (33, 17), (17, 33), (5, 300)])
def test_tiny_crops(matcher, pair, size):
    window = Box(x0=40, y0=40, x1=40 + min(size[0], 200), y1=40 + min(size[1], 180))
    tiny = Crop(image=pair[0].image, window=window, size=size)
    for crops in ((tiny, tiny), (tiny, pair[1]), (pair[1], tiny)):
        check(matcher.match([crops])[0], *crops)


def test_points_are_in_the_pixels_of_a_crop_not_of_its_image(matcher, pair):
    first = Crop(image=pair[0].image, window=Box(x0=40, y0=30, x1=280, y1=210), size=(240, 180))
    second = Crop(image=pair[1].image, window=Box(x0=10, y0=20, x1=310, y1=230), size=(300, 210))
    (matches,) = matcher.match([(first, second)])
    check(matches, first, second)
    mapped = transfer(WARP, first.to_image(matches.points0)) - second.to_image(matches.points1)
    assert len(matches) > 20
    assert np.median(np.linalg.norm(mapped, axis=1)) < 0.5


def test_no_match_under_a_mask(matcher, pair):
    rng = np.random.default_rng(5)
    masks = [np.kron(rng.random((6, 8)) < 0.7, np.ones((40, 40))).astype(bool) for _ in pair]
    masked = tuple(whole(crop.image.pixels, f"masked {i}", masks[i]) for i, crop in enumerate(pair))
    (matches,) = matcher.match([masked])
    assert len(matches) > 20
    for points, mask in ((matches.points0, masks[0]), (matches.points1, masks[1])):
        x, y = points.astype(int).T
        assert mask[y, x].all()
    nothing = whole(pair[0].image.pixels, "hidden", np.zeros(SIZE[::-1], bool))
    assert [len(m) for m in matcher.match([(nothing, pair[1]), (pair[1], nothing)])] == [0, 0]


def test_equal_input_gives_equal_bits(matcher, pair):
    (first,) = matcher.match([pair])
    (again,) = matcher.match([pair])
    assert_equal(first, again)
    if hasattr(matcher, "reset"):
        matcher.reset()
    (renewed,) = matcher.match([pair])
    assert_equal(first, renewed)


def test_a_list_is_matched_as_its_pairs_are_and_in_their_order(matcher, pair):
    blank = whole(np.full((100, 200, 3), 90, np.uint8), "gray")
    part = Crop(image=pair[0].image, window=Box(x0=60, y0=40, x1=260, y1=200), size=(200, 160))
    pairs = [(pair[0], pair[1]), (part, pair[1]), (blank, pair[0]), (pair[0], part)]
    together = matcher.match(pairs)
    assert len({len(matches) for matches in together}) == len(pairs)  # so that a wrong order would show
    for crops, matches in zip(pairs, together, strict=True):
        assert_equal(matches, matcher.match([crops])[0])


def test_threads_get_what_one_thread_gets(matcher, pair):
    if not is_concurrent(matcher):
        pytest.skip("is asked by one thread at a time")
    part = Crop(image=pair[0].image, window=Box(x0=60, y0=40, x1=260, y1=200), size=(200, 160))
    pairs = [(pair[0], pair[1]), (part, pair[1]), (pair[1], pair[0]), (pair[0], part)]
    with single_threads():
        matcher.reset()
        expected = [matcher.match([crops])[0] for crops in pairs]
        matcher.reset()
        found = list(in_order(lambda crops: matcher.match([crops])[0], pairs, threads=4))
    for one, other in zip(found, expected, strict=True):
        assert_equal(one, other)


def test_swapping_the_images_finds_the_same_warp(matcher, pair):
    (there,) = matcher.match([pair])
    (back,) = matcher.match([pair[::-1]])
    assert np.median(errors(back.swapped())) < 0.5
    assert 0.5 < len(there) / len(back) < 2
