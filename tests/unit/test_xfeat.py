from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgam_core.errors import OptionError, WeightsError
from sgam_core.types import Box, Crop
from sgam_sfm.matchers import xfeat
from sgam_sfm.matchers.subpixel import aligned
from sgam_sfm.matchers.xfeat import XFeatStar, _mutual_nearest
from tests.textures import similarity, transfer, view, whole


@pytest.fixture(scope="module")
def matcher():
    return XFeatStar(photometric=False)


@pytest.fixture(scope="module")
def crop():
    return whole(view(np.eye(3), (160, 128)), "texture")


def test_patches_are_those_of_the_crops_whether_they_were_kept_or_not(monkeypatch):
    first = Crop(
        image=whole(view(np.eye(3), (320, 256)), "large").image, window=Box(x0=8, y0=0, x1=312, y1=256), size=(152, 128)
    )
    second = whole(view(similarity(0.5, 3.0, (1.2, 0.7), (80.0, 64.0)), (160, 128)), "small")
    matcher = XFeatStar()
    (found,) = matcher.match([(first, second)])
    monkeypatch.setattr(xfeat, "aligned", lambda crop0, crop1, matches, _: aligned(crop0, crop1, matches))
    (again,) = matcher.match([(first, second)])
    assert len(found) > 20
    for name in ("points0", "points1", "scores"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))


@pytest.mark.parametrize(
    ("size", "scale", "bound"), [((333, 251), 1.0, 0.03), ((251, 317), 1.2, 0.1), ((317, 245), 0.8, 0.1)]
)
def test_coordinates_are_unbiased_at_odd_sizes_and_changes_of_scale(matcher, monkeypatch, size, scale, bound):
    # Shifts that sample the phases of the 8-pixel cells, and both turns. Between scales the network is less exact:
    # there its error depends on how the cells of the two sides lie.
    matcher.reset()
    first = whole(view(np.eye(3), size), "first")
    errors: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for i, (degrees, shift) in enumerate([(4, (2.2, 5.9)), (-4, (5.1, -2.3)), (4, (-3.4, -6.8)), (-4, (-6.7, 3.6))]):
        warp = similarity(scale, degrees, shift, (size[0] / 2, size[1] / 2))
        pair = first, whole(view(warp, size), f"warped {i}")
        for photometric, found in errors.items():
            monkeypatch.setattr(matcher, "photometric", photometric)
            (matches,) = matcher.match([pair])
            found.append(transfer(warp, matches.points0) - matches.points1)
    assert np.abs(np.median(np.concatenate(errors[False]), axis=0)).max() < bound
    assert np.abs(np.median(np.concatenate(errors[True]), axis=0)).max() < 0.02


@pytest.mark.parametrize(("size", "scale"), [((333, 251), 1.0), ((251, 317), 1.1)])
def test_crops_that_are_alike_are_seen_at_one_scale_and_matched_as_exactly(matcher, size, scale):
    warp = similarity(scale, 5, (2.2, 5.9), (size[0] / 2, size[1] / 2))
    pair = whole(view(np.eye(3), size), "first"), whole(view(warp, size), "second")
    alike = replace(pair[0], alike=True), replace(pair[1], alike=True)
    matches, fewer = matcher.match([pair, alike])
    steps = [len(matcher.features.of(crop).steps.unique(dim=0)) for crop in (*pair, *alike)]
    assert steps == [2, 2, 1, 1]
    errors = [
        np.linalg.norm(transfer(warp, found.points0) - found.points1, axis=1).clip(max=3) for found in (matches, fewer)
    ]
    assert len(fewer) > 0.8 * len(matches)
    assert errors[1].mean() < 1.1 * errors[0].mean()


def test_offsets_in_bfloat16_are_those_in_full_precision(monkeypatch):
    warp = similarity(1.0, 5, (2.2, 5.9), (160, 120))
    pair = whole(view(np.eye(3), (320, 240)), "first"), whole(view(warp, (320, 240)), "second")
    found = []
    for bfloat16 in (False, True):
        monkeypatch.setattr(xfeat, "multiplies_bfloat16", lambda _, known=bfloat16: known)
        found += XFeatStar(photometric=False).match([pair])
    full, half = (
        {tuple(np.round(points0 / 4)): points1 for points0, points1 in zip(each.points0, each.points1, strict=True)}
        for each in found
    )
    both = full.keys() & half.keys()
    assert len(both) > 0.8 * len(full)
    apart = np.array([np.linalg.norm(full[place] - half[place]) for place in both])
    assert np.median(apart) < 0.05
    assert np.quantile(apart, 0.9) < 0.2


def test_alignment_makes_matches_three_times_as_precise(matcher, monkeypatch):
    size, warp = (320, 240), similarity(1.1, 6, (3.3, -4.6), (160, 120))
    pair = whole(view(np.eye(3), size), "first"), whole(view(warp, size), "second")
    spread = {}
    for photometric in (False, True):
        monkeypatch.setattr(matcher, "photometric", photometric)
        (matches,) = matcher.match([pair])
        spread[photometric] = np.median(np.linalg.norm(transfer(warp, matches.points0) - matches.points1, axis=1))
    assert spread[True] < spread[False] / 3
    assert spread[True] < 0.15


def test_a_crop_is_extracted_once_until_reset(matcher, crop):
    matcher.reset()
    before = matcher.pixels_extracted
    matcher.match([(crop, crop), (crop, crop)])
    assert matcher.pixels_extracted - before == 160 * 128
    matcher.reset()
    matcher.match([(crop, crop)])
    assert matcher.pixels_extracted - before == 2 * 160 * 128


def test_the_cache_is_bounded_and_drops_the_least_recently_used(crop):
    windows = [Box(x0=x, y0=0, x1=x + 96, y1=96) for x in (0, 16, 32)]
    first, second, third = (Crop(image=crop.image, window=window, size=(96, 96)) for window in windows)
    matcher = XFeatStar()
    matcher.match([(first, second)])
    matcher.features.max_bytes = matcher.features.nbytes
    matcher.match([(first, third)])
    assert matcher.features.keys == [first.key, third.key]


def test_only_what_is_extracted_alone_is_repeatable():
    assert XFeatStar().repeatable
    assert not XFeatStar(batch_size=2).repeatable


def test_a_batch_gives_what_its_crops_give_alone(crop):
    windows = [Box(x0=x, y0=0, x1=x + 96, y1=96) for x in (0, 16, 32)]
    crops = [Crop(image=crop.image, window=window, size=(96, 96)) for window in windows]
    matcher = XFeatStar(batch_size=2)
    for alone, together in zip(crops, matcher._extract(crops), strict=True):
        (features,) = matcher._extract([alone])
        torch.testing.assert_close(features.centers, together.centers)
        torch.testing.assert_close(features.descriptors, together.descriptors, atol=1e-4, rtol=1e-4)


def test_features_under_a_mask_are_not_extracted(matcher, crop):
    mask = np.zeros((128, 160), bool)
    mask[:, :80] = True
    (features,) = matcher._extract([whole(crop.image.pixels, "masked", mask)])
    assert len(features.centers) > 0
    assert (features.centers[:, 0] < 80).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 60), st.integers(0, 60), st.integers(0, 2**32 - 1), st.booleans())
def test_mutual_nearest_agrees_with_the_full_matrix(count0, count1, seed, repeated):
    rng = np.random.default_rng(seed)
    unit0, unit1 = (rng.normal(size=(count, 8)).astype(np.float32) for count in (count0, count1))
    if repeated and count1 > 1:
        unit1[1] = unit1[0]
    rows0, rows1, cosines = _mutual_nearest(torch.from_numpy(unit0), torch.from_numpy(unit1), 0.2)
    unit0, unit1 = (unit / np.linalg.norm(unit, axis=1, keepdims=True) for unit in (unit0, unit1))
    full = unit0 @ unit1.T
    for row0, row1, cosine in zip(rows0.tolist(), rows1.tolist(), cosines.tolist(), strict=True):
        assert full[row0].max() == pytest.approx(full[row0, row1], abs=1e-6)
        assert full[:, row1].max() == pytest.approx(full[row0, row1], abs=1e-6)
        assert cosine == pytest.approx(full[row0, row1], abs=1e-6)
    assert len(set(rows0.tolist())) == len(set(rows1.tolist())) == len(rows0)
    mutual = (full == full.max(1, keepdims=True)) & (full == full.max(0)) & (full > 0.2) if full.size else full
    assert repeated or len(rows0) == mutual.sum()


def test_mutual_nearest_is_the_same_in_one_block_or_in_many(monkeypatch):
    unit0, unit1 = torch.randn(2, 3000, 64, generator=torch.Generator().manual_seed(0))
    rows0, rows1, _ = _mutual_nearest(unit0, unit1, -1)  # 9 blocks
    similarity = torch.nn.functional.normalize(unit0, dim=1) @ torch.nn.functional.normalize(unit1, dim=1).T
    expected = torch.nonzero(similarity.argmax(0)[similarity.argmax(1)] == torch.arange(3000))[:, 0]
    assert rows0.tolist() == expected.tolist()
    assert rows1.tolist() == similarity.argmax(1)[expected].tolist()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"coarse_share": 1.0}, "coarse_share is 1.0; expected at least 0 and less than 1"),
        ({"features_per_megapixel": 0}, "features_per_megapixel is 0; expected at least 1"),
        ({"scales": (0.0, 1.3)}, "scales are (0.0, 1.3) and alike_scale is 1.15; expected positive factors"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(OptionError) as error:
        XFeatStar(**settings)
    assert str(error.value) == message


@pytest.mark.parametrize("device", ["toaster", "cuda:99"])
def test_a_device_that_is_not_there(device):
    with pytest.raises(OptionError, match=f"^device '{device}' cannot be used .*; try 'cpu', or 'cuda' with a GPU$"):
        XFeatStar(device=device)


def test_a_file_that_is_no_xfeat_model(tmp_path):
    torch.save({"other.weight": torch.zeros(3)}, tmp_path / "other.pt")
    (tmp_path / "text.pt").write_text("not a model")
    torch.save([torch.zeros(3)], tmp_path / "list.pt")
    for name, words in (
        ("other.pt", "does not hold the weights of XFeat: "),
        ("text.pt", "cannot be loaded as XFeat weights: it is damaged, or holds more than"),
        ("list.pt", "holds no state dict of XFeat but a list"),
    ):
        with pytest.raises(WeightsError) as error:
            XFeatStar(weights=tmp_path / name)
        assert str(error.value).startswith(f"'{tmp_path / name}' {words}")
        assert "\n" not in str(error.value)
