"""Efficient LoFTR with random weights: the networks as transformers runs them, and our matching of known features."""

import shutil

import numpy as np
import pytest
import torch

from sgam_core.errors import OptionError, SGAMError, WeightsError
from sgam_core.types import Box, Crop, Matches
from sgam_sfm import registry
from sgam_sfm.matchers import efficient_loftr
from sgam_sfm.matchers.efficient_loftr import CELL, EfficientLoFTR, frame_size
from tests.textures import similarity, view, whole

WARP = similarity(1.1, 6, (7.3, -4.6), (110, 75))


@pytest.fixture(scope="module")
def folder(hub_model):
    return hub_model("efficient-loftr")


@pytest.fixture(scope="module")
def matcher(folder):
    """Every mutual best pair of cells is a match."""
    return EfficientLoFTR(weights=folder)


@pytest.fixture(scope="module")
def pair():
    return whole(view(np.eye(3), (220, 150)), "first"), whole(view(WARP, (200, 180)), "second")


def assert_equal(a: Matches, b: Matches) -> None:
    for name in ("points0", "points1", "scores"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def check(matches: Matches, crop0: Crop, crop1: Crop) -> None:
    for points, crop in ((matches.points0, crop0), (matches.points1, crop1)):
        assert np.isfinite(points).all()
        assert ((points >= 0) & (points < crop.size)).all()
    assert ((matches.scores >= 0) & (matches.scores <= 1)).all()


# --- The networks


def test_features_are_those_that_transformers_computes(matcher):
    """Of two images of one size, the only case that transformers takes."""
    frames = torch.rand(2, 1, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        coarse, fine = matcher._features(frames[:1], frames[1:])
        maps = matcher._net.efficientloftr(frames[None].expand(1, 2, 3, 64, 96)).feature_maps
        windows = matcher._net.refinement_layer(maps[0] / matcher.config.hidden_size**0.5, maps[1:])
    for side in (0, 1):
        expected = maps[0][0, side] / matcher.config.hidden_size**0.5
        torch.testing.assert_close(coarse[side][0], expected, atol=1e-5, rtol=1e-4)
    cells = torch.tensor([[0, 0], [5, 3], [11, 7]])
    index = cells[:, 1] * 12 + cells[:, 0]
    padded = torch.nn.functional.pad(fine[1][0], (1, 1, 1, 1))
    for found, expected in (
        (efficient_loftr._windows(fine[0][0], cells, 8), windows[0][0, index]),
        (efficient_loftr._windows(padded, cells, 10), windows[1][0, index]),
    ):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


def test_crops_are_resized_to_multiples_of_32(matcher):
    crop = whole(view(np.eye(3), (100, 60)), "odd")
    assert frame_size(crop) == (128, 64)
    frames = matcher._frames([crop])
    assert frames.shape == (1, 1, 64, 128)
    assert 0 <= frames.min() < 0.2
    assert 0.8 < frames.max() <= 1
    assert frame_size(whole(np.zeros((33, 32, 3), np.uint8), "a")) == (32, 64)


# --- The matching of features that are known


def shifted(matcher: EfficientLoFTR, shift: tuple[int, int], monkeypatch) -> None:
    """Features of a random scene, seen in the second image `shift` pixels of the frame further right and down."""
    rng = torch.Generator().manual_seed(5)
    first, second = (
        scale * torch.nn.functional.normalize(torch.randn(channels, 400, 400, generator=rng), dim=0)
        for scale, channels in ((14, 16), (60, 8))
    )
    scene = torch.cat([first, second])
    cells = torch.nn.functional.normalize(torch.randn(32, 50, 50, generator=rng), dim=0)

    def features(frames0, frames1):
        coarse, fine = [], []
        for frames, (dx, dy) in ((frames0, (0, 0)), (frames1, shift)):
            high, wide = frames.shape[2:]
            left, top = 80 - dx, 80 - dy
            # Cells are square to the scene: a shift of less than half a cell leaves them where they are.
            x, y = (10 - round(d / CELL) for d in (dx, dy))
            coarse.append(cells[None, :, y : y + high // CELL, x : x + wide // CELL].expand(len(frames), -1, -1, -1))
            fine.append(scene[None, :, top : top + high, left : left + wide].expand(len(frames), -1, -1, -1))
        return coarse, fine

    monkeypatch.setattr(matcher, "_features", features)


@pytest.mark.parametrize("shift", [(0, 0), (16, -8), (3, 1), (11, -9), (-18, 2)])
def test_a_known_shift_comes_back(folder, monkeypatch, shift):
    matcher = EfficientLoFTR(weights=folder, min_confidence=0.2)
    shifted(matcher, shift, monkeypatch)
    crops = whole(np.zeros((128, 160, 3), np.uint8), "a"), whole(np.zeros((128, 160, 3), np.uint8), "b")
    (matches,) = matcher.match([crops])
    assert len(matches) > 60
    # The expectation over nine neighbours is exact when only the middle one is likely.
    moved = matches.points1 - matches.points0
    assert np.abs(np.median(moved, axis=0) - shift).max() < 0.001
    assert (np.abs(moved - shift) < 0.1).all(axis=1).mean() > 0.9


def test_points_are_scaled_back_from_the_frame_to_the_crop_with_its_corner_origin(folder, monkeypatch):
    matcher = EfficientLoFTR(weights=folder, min_confidence=0.2)
    shifted(matcher, (0, 0), monkeypatch)
    sizes = [(160, 128), (150, 120)]
    found = []
    for width, height in sizes:
        crop = whole(np.zeros((height, width, 3), np.uint8), f"{width}")
        assert frame_size(crop) == (160, 128)
        found.append(matcher.match([(crop, crop)])[0])
    np.testing.assert_allclose(found[1].points0, found[0].points0 * (150 / 160, 120 / 128), atol=1e-9)
    np.testing.assert_allclose(found[1].points1, found[0].points1 * (150 / 160, 120 / 128), atol=1e-9)


def test_cells_at_the_border_and_unlikely_ones_do_not_match(folder, monkeypatch):
    crops = whole(np.zeros((128, 160, 3), np.uint8), "a"), whole(np.zeros((128, 160, 3), np.uint8), "b")
    counts = {}
    for confidence in (0.0, 0.2, 0.999999):
        matcher = EfficientLoFTR(weights=folder, min_confidence=confidence)
        shifted(matcher, (0, 0), monkeypatch)
        (matches,) = matcher.match([crops])
        counts[confidence] = len(matches)
        cells = np.floor((matches.points0 + 4) / CELL)
        assert cells.min(initial=2) >= 2
        assert (cells <= (160 // CELL - 2, 128 // CELL - 2)).all()
    assert counts[0.0] == (160 // CELL - 4) * (128 // CELL - 4)
    assert counts[0.0] >= counts[0.2] > counts[0.999999]
    tiny = whole(np.zeros((32, 32, 3), np.uint8), "tiny")
    assert len(EfficientLoFTR(weights=folder, min_confidence=0).match([(tiny, tiny)])[0]) == 0


# --- The whole


def test_a_list_is_matched_as_its_pairs_are_and_in_their_order(matcher, pair):
    part = Crop(image=pair[0].image, window=Box(x0=20, y0=10, x1=180, y1=140), size=(128, 104))
    pairs = [pair, (part, pair[1]), pair[::-1], (pair[0], pair[0])]
    together = matcher.match(pairs)
    assert len({len(matches) for matches in together}) > 2
    for crops, matches in zip(pairs, together, strict=True):
        check(matches, *crops)
        assert len(matches) > 0
        assert_equal(matches, matcher.match([crops])[0])


def test_batches_equal_one_by_one(folder, pair):
    batched = EfficientLoFTR(weights=folder, batch_pixels=2**20)
    alone = EfficientLoFTR(weights=folder)
    other = whole(view(np.eye(3), (200, 180), seed=1), "other")
    pairs = [pair, (pair[0], other), pair]
    for together, single in zip(batched.match(pairs), alone.match(pairs), strict=True):
        assert len(single) > 5
        assert abs(len(single) - len(together)) <= 0.02 * len(single)
        near = np.abs(together.points0[:, None] - single.points0).max(2).min(1)
        assert (near < 1e-3).mean() > 0.95


def test_no_match_under_a_mask(matcher, pair):
    rng = np.random.default_rng(5)
    masks = [rng.random((crop.size[1], crop.size[0])) < 0.5 for crop in pair]
    masked = tuple(whole(crop.image.pixels, f"masked {i}", masks[i]) for i, crop in enumerate(pair))
    (free,), (matches,) = matcher.match([pair]), matcher.match([masked])
    assert 0 < len(matches) < len(free)
    for points, mask in ((matches.points0, masks[0]), (matches.points1, masks[1])):
        x, y = points.astype(int).T
        assert mask[y, x].all()
    hidden = whole(pair[0].image.pixels, "hidden", np.zeros((150, 220), bool))
    assert len(matcher.match([(hidden, pair[1])])[0]) == 0


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (33, 17), (5, 300)])
def test_tiny_and_blank_crops(matcher, pair, size):
    tiny = Crop(image=pair[0].image, window=Box(x0=0, y0=0, x1=min(size[0], 220), y1=min(size[1], 150)), size=size)
    blank = whole(np.full((64, 96, 3), 128, np.uint8), "blank")
    for crops in ((tiny, tiny), (tiny, pair[1]), (pair[1], tiny), (blank, blank), (blank, pair[0])):
        check(matcher.match([crops])[0], *crops)
    assert matcher.match([]) == []


# --- What is wrong


def test_weights_as_a_folder_and_as_the_file_in_it(folder, matcher, pair):
    again = registry.create("matcher", "efficient-loftr", weights=folder / "model.safetensors", device="cpu", seed=3)
    assert_equal(again.match([pair])[0], matcher.match([pair])[0])


def test_weights_that_are_none(folder, tmp_path, hub_model):
    for name, expected in (
        (
            "gone",
            f"'efficient-loftr --weights {tmp_path}/gone': the folder '{tmp_path}/gone' does not exist; give one as",
        ),
        ("other.pth", "expected model.safetensors with config.json beside it, or their folder"),
        ("bare/model.safetensors", "cannot be loaded ("),
    ):
        path = tmp_path / name
        if path.suffix:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"")
        with pytest.raises(WeightsError) as error:
            EfficientLoFTR(weights=path)
        assert expected in str(error.value)
    with pytest.raises(
        OptionError, match=r"is a segformer; expected Efficient LoFTR, as zju-community/efficientloftr$"
    ):
        EfficientLoFTR(weights=hub_model("segformer"))
    copy = shutil.copytree(folder, tmp_path / "copy")
    config = (copy / "config.json").read_text().replace('"num_attention_layers": 2', '"num_attention_layers": 3')
    (copy / "config.json").write_text(config)
    with pytest.raises(WeightsError, match=r"lacks \d+ of its weights"):
        EfficientLoFTR(weights=copy)


def test_without_weights_and_network_the_message_says_how_to_get_them():
    with pytest.raises(WeightsError) as error:
        EfficientLoFTR()
    assert str(error.value).startswith("'efficient-loftr' cannot be loaded (We couldn't connect to")
    assert "run `hf download zju-community/efficientloftr --local-dir FOLDER` elsewhere" in str(error.value)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"min_confidence": 1.0}, "min_confidence is 1.0; expected at least 0 and less than 1"),
        ({"batch_pixels": -1}, "batch_pixels is -1; expected at least 0"),
    ],
)
def test_options_out_of_range(folder, options, expected):
    with pytest.raises(SGAMError) as error:
        EfficientLoFTR(weights=folder, **options)
    assert str(error.value) == expected


def test_too_large_a_pair_says_what_to_lower(folder, pair, monkeypatch):
    matcher = EfficientLoFTR(weights=folder)

    def full(*_):
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: not enough memory")

    monkeypatch.setattr(matcher, "_features", full)
    with pytest.raises(OptionError) as error:
        matcher.match([pair])
    assert str(error.value) == (
        "efficient-loftr: 1 pair(s) of crops of 220x150 and 200x180 pixels do not fit into memory; lower --image-size "
        "for whole images, --area-size for areas"
    )
