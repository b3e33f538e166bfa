"""Sparse matchers: what is kept, how features are assigned, and where keypoints lie."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from sgam_core.errors import OptionError, WeightsError
from sgam_core.types import Box, Crop
from sgam_sfm.matchers.lightglue import LightGlueAssignment
from sgam_sfm.matchers.peaks import parabola, peaks
from sgam_sfm.matchers.ratio import RatioAssignment, two_nearest
from sgam_sfm.matchers.sift import sift
from sgam_sfm.matchers.sparse import Assignment, Features, SparseMatcher
from sgam_sfm.matchers.superpoint import SuperPointExtractor, SuperPointNet
from sgam_sfm.options import MatchOptions, fingerprint
from sgam_sfm.weights import DISK, DISK_LIGHTGLUE, find_all_weights
from tests.textures import view, whole

SMALL = {"descriptor_dim": 32, "n_layers": 2, "num_heads": 2}


@pytest.fixture(scope="module")
def crop():
    return whole(view(np.eye(3), (160, 128)), "texture")


@pytest.fixture
def lightglue(tmp_path):
    """Makes small LightGlues with weights that are random, but always the same."""
    from kornia.feature import LightGlue

    def make(rename=lambda name: name, batch_size: int = 1, **config) -> LightGlueAssignment:
        torch.manual_seed(0)
        config = SMALL | config
        net = LightGlue(None, **config)
        torch.save({rename(name): value for name, value in net.state_dict().items()}, tmp_path / "lightglue.pth")
        path = tmp_path / "lightglue.pth"
        return LightGlueAssignment(path, torch.device("cpu"), batch_size=batch_size, min_score=0.0, **config)

    return make


def features(count: int, seed: int, channels: int = 32) -> Features:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 2, generator=generator) * torch.tensor([160, 128])
    descriptors = normalize(torch.randn(count, channels, generator=generator), dim=1)
    frames = torch.rand(count, 2, generator=generator)
    return Features(points, descriptors, (160, 128), torch.ones(count), frames)


def windows(crop: Crop, *starts: int) -> list[Crop]:
    return [Crop(image=crop.image, window=Box(x0=x, y0=0, x1=x + 96, y1=96), size=(96, 96)) for x in starts]


def test_a_crop_is_extracted_once_until_reset(crop):
    matcher = sift()
    matcher.match([(crop, crop), (crop, crop)])
    assert matcher.pixels_extracted == 160 * 128
    matcher.reset()
    matcher.match([(crop, crop)])
    assert matcher.pixels_extracted == 2 * 160 * 128


def test_the_least_recently_used_features_are_dropped(crop):
    first, second, third = windows(crop, 0, 16, 32)
    matcher = SparseMatcher(lambda crops: [features(5, 0) for _ in crops], RatioAssignment(0.8))
    matcher.match([(first, second)])
    matcher.features.max_bytes = matcher.features.nbytes
    matcher.match([(first, third)])
    assert matcher.features.keys == [first.key, third.key]


def test_crops_of_one_size_are_extracted_together_and_pairs_assigned_at_once(crop):
    batches: list[list[tuple]] = []

    def extract(crops):
        batches.append([each.key for each in crops])
        return [features(5, 0) for _ in crops]

    def assign(pairs):
        batches.append([len(pairs)])
        rows = torch.arange(5)
        return [Assignment(rows, rows, torch.linspace(0, 1.5, 5)) for _ in pairs]

    matcher = SparseMatcher(extract, assign, batch_size=2)
    first, second, third = windows(crop, 0, 16, 32)
    found = matcher.match([(first, second), (third, crop)])
    assert batches == [[first.key, second.key], [third.key], [crop.key], [2]]
    assert [matches.scores.max() <= 1 for matches in found] == [True, True]


def test_a_mask_costs_sift_none_of_its_features(crop):
    mask = np.zeros((128, 160), bool)
    mask[:, :80] = True
    masked = whole(crop.image.pixels, "masked", mask)
    matcher = sift(max_features=20)
    matcher.match([(masked, masked)])
    found = matcher.features.of(masked)
    assert len(found) >= 20
    assert (found.points[:, 0] < 81).all()


def test_ratio_matches_by_hand():
    angles = torch.tensor([0.0, 0.1, 1.0, 2.0]), torch.tensor([0.02, 1.01, 1.5, 1.9, 3.0])
    side0, side1 = (torch.stack([angle.cos(), angle.sin()], 1) for angle in angles)
    pairs = [
        (replace(features(4, 0), descriptors=side0), replace(features(5, 0), descriptors=side1)),
        (replace(features(1, 0), descriptors=side0[:1]), replace(features(5, 0), descriptors=side1)),
    ]
    found, nothing = RatioAssignment(0.8)(pairs)
    # 0.1 is nearest to 0.02, which is nearer to 0.0. A score tells the worse of the two sides.
    assert found.rows0.tolist() == [0, 2, 3]
    assert found.rows1.tolist() == [0, 1, 3]
    chord = [2 * np.sin(np.abs(difference) / 2) for difference in (0.02, 0.08, 0.1, 0.5)]
    assert found.scores[0] == pytest.approx(1 - chord[0] / chord[1], abs=1e-3)
    assert found.scores[2] == pytest.approx(1 - chord[2] / chord[3], abs=1e-3)
    assert len(nothing.rows0) == 0
    (strict,) = RatioAssignment(0.1)(pairs[:1])
    assert strict.rows0.tolist() == [2]  # 0.01 against 0.49 and 0.91


def test_two_nearest_is_the_same_in_one_block_or_in_many(monkeypatch):
    unit0, unit1 = features(50, 0).descriptors, features(30, 1).descriptors
    whole_matrix = unit0 @ unit1.T
    monkeypatch.setattr("sgam_sfm.matchers.ratio.BLOCK_ELEMENTS", 90)  # 3 rows
    nearest, rows, columns = two_nearest(unit0, unit1)
    assert nearest.tolist() == whole_matrix.argmax(1).tolist()
    torch.testing.assert_close(rows, whole_matrix.topk(2, dim=1).values)
    torch.testing.assert_close(columns, whole_matrix.topk(2, dim=0).values.T)


def test_a_parabola_finds_the_top_between_pixels(crop):
    x, y = torch.meshgrid(torch.arange(160.0), torch.arange(128.0), indexing="xy")
    tops = [(40.3, 30.8), (100.2, 60.4), (20.2, 100.1)]
    hills = [height - 0.1 * ((x - tx) ** 2 + (y - ty) ** 2) for height, (tx, ty) in zip((3, 2, 1), tops, strict=True)]
    scores = torch.stack(hills).amax(0)
    pixels = peaks(scores, crop, 10, minimum=0)
    assert pixels.tolist() == [[40, 31], [100, 60], [20, 100]]
    found = pixels + parabola(scores, pixels)
    np.testing.assert_allclose(found, tops, atol=1e-3)
    assert peaks(scores, crop, 1, minimum=0).tolist() == [[40, 31]]
    assert peaks(scores, crop, 10, minimum=2.5).tolist() == [[40, 31]]


def test_peaks_keep_off_masks_borders_and_padding(crop):
    scores = torch.zeros(144, 176)  # padded
    for x, y in ((1, 50), (50, 126), (165, 60), (30, 40), (120, 40)):
        scores[y, x] = 1.0
    assert sorted(peaks(scores, crop, 10, minimum=0).tolist()) == [[30, 40], [120, 40]]
    mask = np.ones((128, 160), bool)
    mask[:, :80] = False
    masked = whole(crop.image.pixels, "masked", mask)
    assert peaks(scores, masked, 10, minimum=0).tolist() == [[120, 40]]


@pytest.mark.parametrize("frames", [False, True])
def test_a_batch_of_lightglue_gives_what_its_pairs_give_alone(lightglue, frames):
    assign = lightglue(batch_size=2, input_dim=32, add_scale_ori=frames)
    pairs = [(features(*a), features(*b)) for a, b in (((40, 0), (50, 1)), ((30, 2), (50, 3)), ((40, 4), (50, 5)))]
    pairs.append((features(0, 0), features(50, 1)))
    together = assign(pairs)
    for pair, found in zip(pairs, together, strict=True):
        (alone,) = assign([pair])
        assert found.rows0.tolist() == alone.rows0.tolist()
        assert found.rows1.tolist() == alone.rows1.tolist()
        torch.testing.assert_close(found.scores, alone.scores)
    assert len(together[0].rows0) > 0
    assert len(together[3].rows0) == 0


def test_files_name_layers_in_three_ways_and_hold_more(lightglue, tmp_path):
    pairs = [(features(20, 0), features(20, 1))]
    (expected,) = lightglue(input_dim=32)(pairs)

    def old(name: str) -> str:
        part = name.split(".")
        return ".".join([part[2], part[1], *part[3:]]) if part[0] == "transformers" else name

    for rename in (old, lambda name: f"matcher.{old(name)}"):
        (found,) = lightglue(rename, input_dim=32)(pairs)
        torch.testing.assert_close(found.scores, expected.scores)
    path = tmp_path / "lightglue.pth"
    state = torch.load(path, weights_only=True)
    torch.save(state | {"extractor.a": torch.zeros(1), "log_assignment.0.r": torch.zeros(1)}, path)
    LightGlueAssignment(path, torch.device("cpu"), batch_size=1, input_dim=32, **SMALL)
    torch.save(state | {"other": torch.zeros(1)}, path)
    with pytest.raises(WeightsError) as error:
        LightGlueAssignment(path, torch.device("cpu"), batch_size=1, input_dim=32, **SMALL)
    assert str(error.value) == f"'{path}' does not hold the weights of LightGlue: 1 unexpected (other)"


def test_superpoint_has_its_published_parameters_and_gives_unit_descriptors(tmp_path, crop):
    torch.manual_seed(0)
    net = SuperPointNet()
    layers = {name.partition(".")[0] for name in net.state_dict()}
    assert layers == {f"conv{stage}{half}" for stage in "1234PD" for half in "ab"}
    assert net.state_dict()["convPb.weight"].shape == (65, 256, 1, 1)
    assert sum(value.numel() for value in net.parameters()) == 1_300_865
    with torch.no_grad():
        net.convPb.weight *= 200  # so that some pixels stand out
    torch.save(net.state_dict(), tmp_path / "superpoint.pth")
    odd = Crop(image=crop.image, window=Box(x0=0, y0=0, x1=150, y1=101), size=(150, 101))
    with torch.inference_mode():
        (found,) = SuperPointExtractor(tmp_path / "superpoint.pth", 50, torch.device("cpu"))([odd])
    assert 10 < len(found) <= 50
    assert found.descriptors.shape == (len(found), 256)
    torch.testing.assert_close(found.descriptors.norm(dim=1), torch.ones(len(found)))
    assert ((found.points > 3) & (found.points < torch.tensor([148, 99]))).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_ratio": 0}, "max_ratio is 0; expected more than 0 and at most 1"),
        ({"max_features": 0}, "max_features is 0; expected at least 1"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(OptionError) as error:
        sift(**settings)
    assert str(error.value) == message


def test_weights_of_several_files_are_given_by_their_folder(tmp_path, caplog):
    with pytest.raises(WeightsError) as error:
        find_all_weights((DISK, DISK_LIGHTGLUE), tmp_path / "gone")
    assert str(error.value) == (
        f"'{tmp_path / 'gone'}' is no folder; give one that holds scm_disk-depth-save.pth and scm_disk_lightglue.pth, "
        "or omit it and run `sgam-sfm models get disk-lightglue`"
    )
    (tmp_path / "disk-depth-save.pth").write_bytes(b"mine")
    (tmp_path / "scm_disk_lightglue.pth").write_bytes(b"mine, too")
    found = find_all_weights((DISK, DISK_LIGHTGLUE), tmp_path)
    assert [path.name for path in found] == ["disk-depth-save.pth", "scm_disk_lightglue.pth"]
    assert caplog.text.count("used because the path was given explicitly") == 2
    (tmp_path / "scm_disk_lightglue.pth").unlink()
    with pytest.raises(WeightsError, match=r"^no LightGlue \(DISK\) weights at "):
        find_all_weights((DISK, DISK_LIGHTGLUE), tmp_path)


def test_accepting_a_licence_changes_no_results(tmp_path):
    options = MatchOptions(images=tmp_path, output=tmp_path / "out")
    assert fingerprint(options) == fingerprint(replace(options, accept_licence="superpoint-lightglue"))
