import json
import os
import stat
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from sgam_core.errors import OptionError, SGAMError, WeightsError
from sgam_core.types import Box, Crop, Matches
from sgam_sfm.matchers import loftr
from sgam_sfm.matchers.loftr import CONFIG, LoFTR, Network
from sgam_sfm.weights import LOFTR_INDOOR
from tests.textures import similarity, transfer, view, whole

SCRIPT = Path(__file__).parents[2] / "scripts" / "compare_loftr.sh"
REAL = os.environ.get("SGAM_SFM_LOFTR_WEIGHTS")


@pytest.fixture(scope="module")
def state():
    """The parameters of a network that has learned nothing."""
    torch.manual_seed(3)
    return Network(None, CONFIG).state_dict()


@pytest.fixture(scope="module")
def checkpoint(state, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "random.ckpt"
    torch.save({"state_dict": state}, path)
    return path


@pytest.fixture(scope="module")
def matcher(checkpoint):
    """Every mutual best pair of cells is a match."""
    return LoFTR(weights=checkpoint, min_confidence=0)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """An empty torch-hub cache, and no other."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    checkpoints = tmp_path / "torch" / "hub" / "checkpoints"
    checkpoints.mkdir(parents=True)
    return checkpoints


def assert_equal(a: Matches, b: Matches) -> None:
    for name in ("points0", "points1", "scores"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


# --- The adapter, with what the network says put into its own two matching stages


class Told:
    """Puts chosen matches into a network: each pair of images is known by the grey level of its first one.

    matches: by grey level, rows of (column 0, row 0, column 1, row 1, offset x, offset y, confidence); the offset, in
    pixels, is what the fine stage adds in the second image.
    """

    def __init__(self, monkeypatch, net, matches):
        self.net, self.matches, self.batches = net, matches, []
        monkeypatch.setattr(net.coarse_matching, "forward", self.coarse)
        monkeypatch.setattr(net.fine_matching, "forward", self.fine)
        self.hook = net.register_forward_pre_hook(self.see)

    def see(self, net, arguments):
        (data,) = arguments
        assert set(data) == {"image0", "image1"}
        self.images = data
        self.levels = [round(255 * level) for level in data["image0"][:, 0, 0, 0].tolist()]
        self.batches.append(self.levels)

    def coarse(self, feat0, feat1, data, mask_c0=None, mask_c1=None):
        columns = [data[f"hw{side}_c"][1] for side in (0, 1)]
        likelihood = torch.zeros(len(feat0), feat0.shape[1], feat1.shape[1])
        self.offsets = []
        for i, level in enumerate(self.levels):
            rows = sorted(self.matches[level], key=lambda row: row[1] * columns[0] + row[0])
            for x0, y0, x1, y1, *offset, confidence in rows:
                likelihood[i, y0 * columns[0] + x0, y1 * columns[1] + x1] = confidence
                self.offsets.append(offset)
        data["conf_matrix"] = likelihood
        data.update(self.net.coarse_matching.get_coarse_match(likelihood, data))

    def fine(self, feat0, feat1, data):
        module = self.net.fine_matching
        module.M, module.W, module.WW, module.C, module.scale = len(feat0), 5, 25, feat0.shape[-1], 2
        module.get_fine_match(torch.tensor(self.offsets).reshape(-1, 2) / 4, data)


@pytest.fixture
def tell(monkeypatch, checkpoint):
    """Makes a matcher that finds chosen matches."""
    hooks = []

    def make(matches, **settings):
        matcher = LoFTR(weights=checkpoint, **settings)
        told = Told(monkeypatch, matcher._net, matches)
        hooks.append(told.hook)
        return matcher, told

    yield make
    for hook in hooks:
        hook.remove()


def flat(level: int, size: tuple[int, int], mask=None) -> Crop:
    return whole(np.full((size[1], size[0], 3), level, np.uint8), f"flat {level} {size}", mask)


def test_cells_become_the_corners_of_their_pixels_at_other_sizes_on_each_side(tell):
    matcher, _ = tell({200: [(2, 3, 6, 13, 1.25, -3.5, 0.5), (10, 8, 2, 2, 0.0, 4.0, 0.75)]})
    (matches,) = matcher.match([(flat(200, (100, 84)), flat(90, (70, 121)))])
    # columns and rows times 8, in both images, and nothing else: (0, 0) is the corner of the first pixel
    np.testing.assert_array_equal(matches.points0, [[16, 24], [80, 64]])
    np.testing.assert_array_equal(matches.points1, [[48 + 1.25, 104 - 3.5], [16, 16 + 4]])
    np.testing.assert_array_equal(matches.scores, np.float32([0.5, 0.75]))
    np.testing.assert_array_equal(matches.sigmas0, [1, 1])


def test_crops_are_padded_with_black_to_whole_cells(tell):
    matcher, told = tell({200: []})
    matcher.match([(flat(200, (100, 84)), flat(90, (70, 121)))])
    for side, (level, (width, height), padded) in enumerate([(200, (100, 84), (104, 88)), (90, (70, 121), (72, 128))]):
        frame = told.images[f"image{side}"]
        assert frame.shape == (1, 1, *padded[::-1])
        assert (frame[..., :height, :width] == np.float32(level) / np.float32(255)).all()
        assert (frame[..., height:, :] == 0).all()
        assert (frame[..., width:] == 0).all()
        assert 8 * (padded[0] // 8 - 1) < width  # no coarse cell sits on the padding: it needs no mask
        assert 8 * (padded[1] // 8 - 1) < height


def test_gray_is_luma(tell):
    matcher, told = tell({76: []})
    red = np.zeros((48, 48, 3), np.uint8)
    red[..., 0] = 255
    matcher.match([(whole(red, "red"), whole(red, "red"))])
    assert told.levels == [76]


@pytest.mark.parametrize(("batch_pixels", "batches"), [(0, [1, 1, 1, 1]), (40_000, [2, 1, 1]), (10**9, [3, 1])])
def test_batches_of_equal_padded_size_keep_pairs_and_order_apart(tell, batch_pixels, batches):
    sizes = {10: (100, 84), 20: (96, 80), 30: (104, 88), 40: (97, 81)}  # all but the second padded to 104 x 88
    told_matches = {
        level: [(2 + j, 2, 4, 3 + j, 0.5 * j, 0.25, 0.5 + level / 100) for j in range(level // 10)] for level in sizes
    }
    matcher, told = tell(told_matches, batch_pixels=batch_pixels)
    found = matcher.match([(flat(level, size), flat(90, (120, 80))) for level, size in sizes.items()])
    assert sorted(map(len, told.batches), reverse=True) == batches
    for level, matches in zip(sizes, found, strict=True):
        j = np.arange(level // 10)
        np.testing.assert_array_equal(matches.points0, np.stack([16 + 8 * j, np.full(len(j), 16)], -1))
        np.testing.assert_array_equal(matches.points1, np.stack([32 + 0.5 * j, 24 + 8 * j + 0.25], -1))
        np.testing.assert_array_equal(matches.scores, np.full(len(j), 0.5 + level / 100, np.float32))


def test_points_outside_the_crop_and_under_its_mask_are_dropped(tell):
    cells = [(2, 2, 2, 2, 0.0, 0.0, 0.5), (5, 2, 5, 2, 0.0, 0.0, 0.5), (4, 4, 6, 4, 23.5, 0.0, 0.5)]
    matcher, _ = tell({200: [*cells, (3, 5, 3, 5, 0.0, 0.0, 0.5)]})
    size = (70, 70)
    (matches,) = matcher.match([(flat(200, size), flat(90, size))])
    assert len(matches) == 3  # 48 + 23.5 lies in the padding
    mask0, mask1 = np.ones((2, 70, 70), bool)
    mask0[16, 16] = False
    mask1[40, 24] = False
    (matches,) = matcher.match([(flat(200, size, mask0), flat(90, size, mask1))])
    np.testing.assert_array_equal(matches.points0, [[40, 16]])


def test_points_are_in_the_pixels_of_a_crop_not_of_its_image(tell):
    image = flat(200, (300, 300)).image
    crop = Crop(image=image, window=Box(x0=100, y0=40, x1=280, y1=220), size=(90, 90))
    matcher, _ = tell({200: [(3, 4, 5, 6, 1.5, 0.5, 0.5)]})
    (matches,) = matcher.match([(crop, crop)])
    np.testing.assert_array_equal(crop.to_image(matches.points0), [[100 + 2 * 24, 40 + 2 * 32]])
    np.testing.assert_array_equal(crop.to_image(matches.points1), [[100 + 2 * 41.5, 40 + 2 * 48.5]])


def test_only_matches_above_min_confidence(tell):
    cells = {200: [(2, 2, 2, 2, 0.0, 0.0, 0.15), (3, 2, 3, 2, 0.0, 0.0, 0.25), (4, 2, 4, 2, 0.0, 0.0, 0.45)]}
    pair = flat(200, (64, 64)), flat(90, (64, 64))
    counts = []
    for settings in ({}, {"min_confidence": 0.0}, {"min_confidence": 0.4}):
        matcher, _ = tell(cells, **settings)
        counts.append(len(matcher.match([pair])[0]))
    assert counts == [2, 3, 1]
    assert CONFIG["match_coarse"]["thr"] == 0.2  # kornia's own is not touched


def test_nan_is_no_match(tell):
    matcher, _ = tell({200: [(2, 2, 2, 2, float("nan"), 0.0, 0.5), (3, 2, 3, 2, 0.0, 0.0, 0.5)]})
    assert len(matcher.match([(flat(200, (64, 64)), flat(90, (64, 64)))])[0]) == 1


# --- A network with random weights, end to end


def layouts(state):
    named = {f"matcher.{key}": value for key, value in state.items()}
    return {"kornia": {"state_dict": state}, "plain": state, "official": {"state_dict": named}, "official plain": named}


@pytest.mark.parametrize("layout", ["plain", "official", "official plain"])
def test_every_layout_of_a_checkpoint_gives_the_same_matches(matcher, state, tmp_path, layout):
    path = tmp_path / "other.ckpt"
    torch.save(layouts(state)[layout], path)
    pair = whole(view(np.eye(3), (101, 75)), "first"), whole(view(np.eye(3), (90, 130), 1), "second")
    (expected,) = matcher.match([pair])
    (found,) = LoFTR(weights=path, min_confidence=0).match([pair])
    assert_equal(found, expected)
    assert len(found) > 0
    for points, crop in ((found.points0, pair[0]), (found.points1, pair[1])):
        assert points.dtype == np.float64
        assert points.shape == (len(found), 2)
        assert ((points >= 0) & (points < crop.size)).all()
    assert found.scores.dtype == np.float32
    assert ((found.scores > 0) & (found.scores <= 1)).all()


def test_a_list_equals_its_pairs_and_again(matcher):
    pixels = view(np.eye(3), (160, 128))
    windows = [Box(x0=x, y0=0, x1=x + 96, y1=96) for x in (0, 16, 32)]
    image = whole(pixels, "texture").image
    crops = [Crop(image=image, window=window, size=(96, 96)) for window in windows]
    pairs = [(crops[0], crops[1]), (whole(pixels, "texture"), crops[2]), (crops[1], crops[2]), (crops[1], crops[0])]
    together = matcher.match(pairs)
    for crops_of_pair, matches in zip(pairs, together, strict=True):
        assert_equal(matches, matcher.match([crops_of_pair])[0])
    assert len({len(matches) for matches in together}) > 1
    assert matcher.match([]) == []


def test_a_batch_finds_what_its_pairs_find_alone(matcher, checkpoint):
    image = whole(view(np.eye(3), (160, 128)), "texture").image
    crops = [Crop(image=image, window=Box(x0=x, y0=0, x1=x + 96, y1=96), size=(96, 96)) for x in (0, 16, 32)]
    pairs = [(crops[0], crops[1]), (crops[1], crops[2]), (crops[2], crops[0])]
    batched = LoFTR(weights=checkpoint, min_confidence=0, batch_pixels=10**6).match(pairs)
    for alone, together in zip(matcher.match(pairs), batched, strict=True):
        # rounding may decide which of two equally likely cells of a network without training wins
        near = np.abs(alone.points1[:, None] - together.points1).max(-1) < 0.01
        same = near & (alone.points0[:, None] == together.points0).all(-1)
        assert same.any(1).mean() > 0.9


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (16, 16), (16, 300), (5, 300), (32, 32)])
def test_tiny_crops_have_no_matches(matcher, size):
    tiny, other = flat(100, size), whole(view(np.eye(3), (64, 64)), "other")
    pairs = [(tiny, tiny), (tiny, other), (other, tiny)]
    assert [len(matches) for matches in matcher.match(pairs)] == [0, 0, 0]
    assert [len(matches) for matches in matcher.match([(other, tiny), (other, other)])] != [0, 0]


@pytest.mark.parametrize("size", [(33, 33), (33, 300), (40, 34)])
def test_the_smallest_crops_that_can_match(matcher, size):
    crop = whole(view(np.eye(3), size), "small")
    (matches,) = matcher.match([(crop, crop)])
    assert ((matches.points0 >= 16) & (matches.points0 < np.array(size) - 16)).all()


def test_half_precision_is_for_the_backbone_alone(checkpoint):
    net = LoFTR(weights=checkpoint)._net
    images = torch.from_numpy(view(np.eye(3), (64, 48))[None, None, ..., 0]).float() / 255
    with torch.inference_mode():
        full, half = net.backbone(images), loftr._Half(net.backbone)(images)
    for a, b in zip(full, half, strict=True):
        assert b.dtype == torch.float32
        assert not torch.equal(a, b)
        torch.testing.assert_close(a, b, atol=0.02 * float(a.abs().max()), rtol=0)


# --- Which weights


@pytest.mark.parametrize(
    ("name", "corrected"),
    [
        ("loftr_outdoor.ckpt", False),
        ("mine.ckpt", False),
        ("indoor_ds.ckpt", False),
        ("loftr_indoor_ds_new.ckpt", True),
        ("indoor_new.pt", True),
    ],
)
def test_the_positional_encoding_follows_the_name_of_the_file(checkpoint, tmp_path, name, corrected):
    path = tmp_path / name
    path.symlink_to(checkpoint)
    assert LoFTR(weights=path)._net.pos_encoding.temp_bug_fix is corrected
    assert LoFTR(weights=path, corrected_encoding=not corrected)._net.pos_encoding.temp_bug_fix is not corrected
    assert CONFIG["coarse"]["temp_bug_fix"] is False


def test_pretrained_sets_by_name(hub, checkpoint):
    (hub / "loftr_outdoor.ckpt").symlink_to(checkpoint)
    (hub / "loftr_indoor_ds_new.ckpt").symlink_to(checkpoint)
    found = [LoFTR(weights=name)._net for name in (None, Path("outdoor"), Path("indoor_new"))]
    assert [net.pos_encoding.temp_bug_fix for net in found] == [False, False, True]
    assert not any(net.training for net in found)


def test_a_file_comes_before_a_pretrained_set_of_its_name(hub, checkpoint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("outdoor").symlink_to(checkpoint)
    LoFTR(weights=Path("outdoor"))


def message_of(weights) -> str:
    with pytest.raises(WeightsError) as error:
        LoFTR(weights=weights)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("weights", [None, Path("outdoor")])
def test_missing_weights_say_what_was_tried_and_what_mends_it(hub, weights):
    assert message_of(weights) == (
        f"no LoFTR (outdoor) weights; tried '{hub / 'loftr_outdoor.ckpt'}'; run `sgam-sfm models get loftr`, or give "
        "the path of https://huggingface.co/kornia/loftr/resolve/main/loftr_outdoor.ckpt with --weights FILE"
    )


def test_missing_indoor_weights(hub):
    assert message_of(Path("indoor_new")) == (
        f"no LoFTR (indoor_new) weights; tried '{hub / 'loftr_indoor_ds_new.ckpt'}'; run `{LOFTR_INDOOR.command}`, or "
        "give the path of https://huggingface.co/kornia/loftr/resolve/main/loftr_indoor_ds_new.ckpt with --weights FILE"
    )


def test_a_name_or_path_that_is_nothing(hub):
    assert message_of(Path("outdor")) == (
        "no LoFTR weights at 'outdor'; give --weights a checkpoint file, or outdoor or indoor_new"
    )


def test_a_checkpoint_of_something_else_names_the_first_keys(state, tmp_path):
    path = tmp_path / "other.ckpt"
    torch.save({"state_dict": {"encoder.weight": torch.zeros(2), "encoder.bias": torch.zeros(2)}}, path)
    first = list(state)[:3]
    assert message_of(path) == (
        f"'{path}' does not hold the weights of LoFTR: {len(state)} missing ({', '.join(first)}); "
        "2 unexpected (encoder.weight, encoder.bias)"
    )


def test_one_missing_one_unexpected_one_of_another_shape(state, tmp_path):
    changed = dict(state)
    del changed["backbone.bn1.bias"]
    changed |= {"head.weight": torch.zeros(1), "backbone.conv1.weight": torch.zeros(3), "loftr_fine": 7}
    torch.save(changed, tmp_path / "a.ckpt")
    assert message_of(tmp_path / "a.ckpt") == (
        f"'{tmp_path / 'a.ckpt'}' does not hold the weights of LoFTR: 1 missing (backbone.bn1.bias); 2 unexpected "
        "(head.weight, loftr_fine); 1 of another shape (backbone.conv1.weight)"
    )


@pytest.mark.parametrize("content", [torch.zeros(3), {"state_dict": torch.zeros(3)}, [1, 2]])
def test_a_file_of_tensors_without_a_state_dict(tmp_path, content):
    path = tmp_path / "a.ckpt"
    torch.save(content, path)
    assert message_of(path) == f"'{path}' holds no state dict of LoFTR but a {type(content).__name__}"


class Callback:
    """What training checkpoints hold beside tensors; made only when a file is unpickled."""

    made = False

    def __setstate__(self, state):
        type(self).made = True


@pytest.mark.parametrize("content", ["training", b"", b"not a model", b"PK\x03\x04 half a file"])
def test_a_file_that_is_damaged_or_would_run_code_is_never_unpickled(state, tmp_path, content):
    path = tmp_path / "a.ckpt"
    if content == "training":
        callback = Callback()
        callback.at = 1
        torch.save({"state_dict": state, "callbacks": callback}, path)
    else:
        path.write_bytes(content)
    assert message_of(path) == (
        f"'{path}' cannot be loaded as LoFTR weights: it is damaged, or holds more than tensors, as checkpoints of a "
        "training do; get it again, or save its state dict alone where it was made"
    )
    assert not Callback.made


# --- Options and memory


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"min_confidence": 1.0}, "min_confidence is 1.0; expected at least 0 and less than 1"),
        ({"min_confidence": -0.1}, "min_confidence is -0.1; expected at least 0 and less than 1"),
        ({"batch_pixels": -1}, "batch_pixels is -1; expected at least 0"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(OptionError) as error:
        LoFTR(**settings)
    assert str(error.value) == message


def test_a_device_that_is_not_there(checkpoint):
    with pytest.raises(OptionError, match=r"^device 'cuda:99' cannot be used .*; try 'cpu', or 'cuda' with a GPU$"):
        LoFTR(weights=checkpoint, device="cuda:99")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB"),
        RuntimeError("[enforce fail] . DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."),
        RuntimeError("CUDA error: out of memory"),
    ],
)
def test_too_little_memory_names_the_sizes_and_the_options_to_lower(matcher, monkeypatch, error):
    def fail(data):
        raise error

    monkeypatch.setattr(matcher._net, "forward", fail)
    with pytest.raises(SGAMError) as raised:
        matcher.match([(flat(1, (100, 84)), flat(2, (70, 121)))])
    assert str(raised.value) == (
        "loftr: 1 pair(s) of crops of 100x84 and 70x121 pixels do not fit into memory; lower --image-size for whole "
        "images, --area-size for areas"
    )


def test_memory_that_torch_itself_refuses(matcher, monkeypatch):
    monkeypatch.setattr(matcher._net, "forward", lambda data: torch.empty(2**55))
    with pytest.raises(OptionError, match="do not fit into memory"):
        matcher.match([(flat(1, (64, 64)), flat(2, (64, 64)))])


def test_other_failures_are_not_taken_for_it(matcher, monkeypatch):
    def fail(data):
        raise RuntimeError("sizes differ")

    monkeypatch.setattr(matcher._net, "forward", fail)
    with pytest.raises(RuntimeError, match=r"^sizes differ$"):
        matcher.match([(flat(1, (64, 64)), flat(2, (64, 64)))])


# --- The real weights


@pytest.mark.skipif(REAL is None, reason="set SGAM_SFM_LOFTR_WEIGHTS to a checkpoint of LoFTR")
def test_a_shift_of_a_fraction_of_a_pixel_comes_back():
    matcher = LoFTR(weights=Path(REAL))
    warp = similarity(1, 0, (7.25, 0), (0, 0))
    first, second = whole(view(np.eye(3), (320, 240)), "first"), whole(view(warp, (320, 240)), "second")
    (matches,) = matcher.match([(first, second)])
    assert len(matches) > 200
    errors = matches.points1 - transfer(warp, matches.points0)
    assert np.abs(np.median(errors, axis=0)).max() < 0.2
    assert (np.linalg.norm(errors, axis=1) < 1.5).mean() > 0.9


# --- The script


def run_script(folder: Path, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [SCRIPT, folder / "images", folder / "out", "--device", "cpu"],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_comparison_says_in_one_line_how_to_get_the_weights(hub, tmp_path, monkeypatch):
    monkeypatch.delenv("SGAM_SFM_LOFTR_WEIGHTS", raising=False)
    done = run_script(tmp_path)
    assert done.returncode == 1
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert "run `sgam-sfm models get loftr`" in line
    assert "SGAM_SFM_LOFTR_WEIGHTS" in line


def test_the_comparison_puts_both_runs_side_by_side(checkpoint, tmp_path):
    summary = {
        "images": {"used": 11},
        "pairs": {"inliers": 800},
        "keypoints": {"matches": 900},
        "models": [{"registered": 10, "points": 700}],
        "seconds": {"Reading images": 1.2, "Matching pairs": 61.1},
    }
    (tmp_path / "with.json").write_text(json.dumps(summary))
    (tmp_path / "without.json").write_text(json.dumps(summary | {"models": []}))
    command = tmp_path / "bin" / "sgam-sfm"
    command.parent.mkdir()
    command.write_text(
        '#!/bin/sh\necho "$*" >> "$CALLS"\nmkdir -p "$5"\ncase "$*" in\n'
        f'*"--area-matcher sgam"*) cp "{tmp_path}/with.json" "$5/summary.json" ;;\n'
        f'*) cp "{tmp_path}/without.json" "$5/summary.json"; exit 4 ;;\nesac\n'
    )
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    environment = {
        "PATH": f"{command.parent}:{os.environ['PATH']}",
        "CALLS": str(tmp_path / "calls"),
        "SGAM_SFM_LOFTR_WEIGHTS": str(checkpoint),
    }
    done = run_script(tmp_path, **environment)
    assert done.returncode == 0, done.stderr
    assert [line.split() for line in done.stdout.splitlines()] == [
        ["loftr", "sgam", "none"],
        ["registered", "10/11", "0/11"],
        ["points", "700", "0"],
        ["matches", "900", "900"],
        ["inliers", "800", "800"],
        ["seconds", "62", "62"],
    ]
    calls = (tmp_path / "calls").read_text().splitlines()
    assert calls == [
        f"match --images {tmp_path}/images --output {tmp_path}/out/{areas} --matcher loftr --weights {checkpoint} "
        f"--area-matcher {areas} --device cpu"
        for areas in ("sgam", "none")
    ]
