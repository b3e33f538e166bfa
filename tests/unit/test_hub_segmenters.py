"""Segmentation models of the hub: what they are loaded from, what images become, whose label a pixel is."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image as PillowImage

from sgam_core.errors import OptionError, SGAMError, WeightsError
from sgam_sfm import hub, registry
from sgam_sfm.images import inspect_image
from sgam_sfm.options import MatchOptions, fingerprint
from sgam_sfm.segmenters.coseg import CoSeg
from sgam_sfm.segmenters.hf import HubSegmenter
from tests.hub_models import NAMES, SEGMENTERS

COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))  # label 1, 2, 3 of `Seeing`


def picture(width: int, height: int) -> np.ndarray:
    """Red and green side by side over a blue part of two fifths of the height."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[:, : width // 2], pixels[:, width // 2 :] = COLOURS[:2]
    pixels[-(2 * height // 5) :] = COLOURS[2]
    return pixels


def true_labels(pixels: np.ndarray) -> np.ndarray:
    return pixels.argmax(axis=2) + 1


def labels_of(segmenter, pixels: np.ndarray, folder: Path) -> np.ndarray:
    PillowImage.fromarray(pixels).save(folder / "a.png")
    ((_, labels),) = segmenter.segment([inspect_image(folder, "a.png")], lambda share: None)
    assert isinstance(labels, np.ndarray), labels
    return labels


class Seeing:
    """In place of a network: a query for each colour, whose mask is where the network's input has that colour."""

    def __init__(self, stride: int, logits: bool) -> None:
        self.stride, self.logits = stride, logits

    def __call__(self, pixel_values, **others):
        masks = torch.nn.functional.avg_pool2d(pixel_values.float(), self.stride)
        if self.logits:
            return {"logits": masks}
        classes = 20 * torch.eye(3, 5).expand(len(masks), -1, -1)
        return {"class_queries_logits": classes, "masks_queries_logits": 5 * masks}


@pytest.mark.parametrize("kind", SEGMENTERS)
@pytest.mark.parametrize("size", [(300, 120), (90, 200), (100, 100), (7, 9)])
def test_labels_lie_where_the_network_saw_them(hub_model, tmp_path, kind, size):
    """Through the model's own processor, which squashes, pads or cuts into windows."""
    segmenter = HubSegmenter(name=str(hub_model(kind)))
    segmenter._net = Seeing(stride=2, logits=kind == "segformer")
    pixels = picture(*size)
    labels = labels_of(segmenter, pixels, tmp_path)
    assert labels.shape == pixels.shape[:2]
    assert (labels == true_labels(pixels)).mean() > (0.94 if min(size) > 10 else 0.7)
    inner = np.ones(labels.shape, bool)  # away from the borders of colours and of windows every pixel is right
    for axis, edge in ((1, size[0] // 2), (0, size[1] - 2 * size[1] // 5)):
        margin = 6 * max(size) // 64 + 1
        np.moveaxis(inner, axis, 0)[max(edge - margin, 0) : edge + margin] = False
    assert (labels == true_labels(pixels))[inner].all()


def test_a_large_image_gets_a_map_of_640_pixels(hub_model, tmp_path):
    segmenter = HubSegmenter(name=str(hub_model("segformer")))
    assert labels_of(segmenter, picture(1000, 500), tmp_path).shape == (320, 640)


def test_more_classes_than_are_enlarged_together(hub_model, tmp_path):
    """The 40th class wins in one half of the image, the second one in the other."""
    segmenter = HubSegmenter(name=str(hub_model("segformer")))
    scores = torch.zeros(1, 41, 8, 8)
    scores[:, 39, :, :4], scores[:, 1, :, 4:] = 1, 1
    segmenter._net = lambda pixel_values: {"logits": scores}
    labels = labels_of(segmenter, picture(80, 80), tmp_path)
    assert set(np.unique(labels[:, :36])) == {40}
    assert set(np.unique(labels[:, 44:])) == {2}


@pytest.mark.parametrize("kind", SEGMENTERS)
def test_names_come_from_the_configuration(hub_model, kind):
    labels = HubSegmenter(name=str(hub_model(kind))).label_set
    assert {label.id: label.name for label in labels.labels} == {index + 1: name for index, name in NAMES.items()}
    assert labels.ids("person,car,sky", "--ignore-labels") == (3, 4, 2)


def test_the_name_of_a_model_reaches_it_and_the_fingerprint(hub_model, tmp_path):
    folder = hub_model("segformer")
    made = registry.create("segmenter", f"hf:{folder}", device="cpu", folder=None, seed=0)
    assert made.label_set.segmenter == f"hf:{folder}"
    options = [
        MatchOptions(images=tmp_path, output=tmp_path, segmenter=name)
        for name in ("hf", f"hf:{folder}", "hf:other/one")
    ]
    assert len({fingerprint(each) for each in options}) == 3


def test_coseg_with_another_network_keeps_features_of_its_own(hub_model, tmp_path):
    PillowImage.fromarray(picture(80, 60)).save(tmp_path / "a.png")
    image = inspect_image(tmp_path, "a.png")
    shapes = []
    for kind in ("dinov2", "dinov3"):
        segmenter = CoSeg(name=str(hub_model(kind)), image_size=224, cache_folder=tmp_path / "cache")
        ((_, mean),) = segmenter.describe([image], lambda share: None)
        shapes.append(mean.shape)
        (path,) = (tmp_path / "cache").glob(f"*{segmenter._settings_key}*")
        assert np.load(path).shape == {"dinov2": (12, 16, 48), "dinov3": (10, 14, 48)}[kind]
    assert shapes == [(48,), (48,)]


def test_features_change_with_the_part_of_the_image_that_changes(hub_model):
    """Patches are on their grid: what moves from the left to the right moves there."""
    from sgam_sfm.segmenters.dino_hub import HubPatchFeatures

    features = HubPatchFeatures(str(hub_model("dinov3")), image_size=224)
    plain, dotted = np.full((112, 224, 3), 128, np.uint8), np.full((112, 224, 3), 128, np.uint8)
    dotted[80:96, 160:176] = 255
    change = np.abs(features(plain).astype(float) - features(dotted)).sum(axis=2)
    assert np.unravel_index(change.argmax(), change.shape) == (5, 10)


# --- What is wrong with a model


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("hf:", "--segmenter 'hf:' names no model; give one after the colon: a hub id or a folder"),
        ("coseg:", "--segmenter 'coseg:' names no model; give one after the colon: a hub id or a folder"),
        (
            "hf:./nowhere",
            "'hf:./nowhere': the folder './nowhere' does not exist; give one as `hf download` writes it, or a hub id",
        ),
        (
            "coseg:owner/no-such-model",
            "'coseg:owner/no-such-model' cannot be loaded (We couldn't connect to 'https://huggingface.co' to load the "
            "files, and couldn't find them in the cached files); check the hub id; without network run `hf download "
            "owner/no-such-model --local-dir FOLDER` elsewhere and give the folder in place of the id",
        ),
        ("labels:x", "--segmenter 'labels:x': 'labels' is one model; give --segmenter labels"),
        ("cosg:x", "--segmenter 'cosg:x' is unknown; did you mean 'coseg'? known: ade20k, coseg, external, hf, labels"),
    ],
)
def test_names_that_lead_to_no_model(name, expected):
    with pytest.raises(SGAMError) as error:
        registry.create("segmenter", name, folder=Path())
    assert str(error.value) == expected


def test_a_bare_hf_asks_for_a_model():
    with pytest.raises(OptionError, match=r"^'hf:' names no model"):
        registry.create("segmenter", "hf")


def test_a_model_of_another_kind(hub_model):
    with pytest.raises(OptionError) as error:
        HubSegmenter(name=str(hub_model("dinov2")))
    assert "is a Dinov2Model, which does not segment images; expected a model for semantic, instance" in str(
        error.value
    )
    with pytest.raises(OptionError) as error:
        CoSeg(name=str(hub_model("segformer")))
    assert "is a segformer; expected a vision transformer of DINOv2 or DINOv3, such as coseg:" in str(error.value)


def test_an_output_that_says_nothing_of_classes(hub_model, tmp_path):
    segmenter = HubSegmenter(name=str(hub_model("segformer")))
    segmenter._net = lambda pixel_values: {"boxes": pixel_values}
    PillowImage.fromarray(picture(20, 20)).save(tmp_path / "a.png")
    ((_, error),) = segmenter.segment([inspect_image(tmp_path, "a.png")], lambda share: None)
    assert "gives boxes; expected scores of classes or of masks, as OneFormer" in str(error)


def test_damaged_folders(hub_model, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(hub_model("segformer"), folder)
    weights = folder / "model.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(whole[: len(whole) // 2])
    expected = "expected a folder with config.json, preprocessor_config.json and model.safetensors; copy it again"
    for spoil in (lambda: None, weights.unlink, (folder / "preprocessor_config.json").unlink):
        spoil()
        with pytest.raises(WeightsError) as error:
            HubSegmenter(name=str(folder))
        assert str(error.value).startswith(f"'hf:{folder}' cannot be loaded (")
        assert str(error.value).endswith(f"; {expected}")
    (folder / "config.json").write_text("{}")
    with pytest.raises(WeightsError, match="cannot be loaded"):
        HubSegmenter(name=str(folder))


def test_weights_that_are_missing_are_not_drawn_at_random(hub_model, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(hub_model("segformer"), folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"depths": [2, 1]}))
    with pytest.raises(
        WeightsError, match=r"lacks \d+ of its weights \(segformer\..*\); give the model that its config"
    ):
        HubSegmenter(name=str(folder))


def test_transformers_that_is_not_installed_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    for name in ("hf:a/b", "coseg:a/b"):
        with pytest.raises(OptionError) as error:
            registry.create("segmenter", name)
        assert str(error.value) == f"'{name}' needs the package 'transformers'; run `pip install 'sgam-sfm[hf]'`"


def test_a_package_that_a_model_needs_beyond():
    def read(name: str, **settings: object) -> None:
        raise ImportError("ThisProcessor requires the torchvision library.\nMore lines.")

    with pytest.raises(OptionError) as error:
        hub.load(read, "owner/model", "hf:owner/model")
    assert str(error.value) == (
        "'hf:owner/model' needs a package that is not here (ThisProcessor requires the torchvision library); install it"
    )


def test_the_cache_is_asked_before_the_network():
    asked = []

    def read(name: str, local_files_only: bool = False) -> str:
        asked.append(local_files_only)
        if local_files_only:
            raise OSError("not here")
        return name

    assert hub.load(read, "owner/model", "hf:owner/model") == "owner/model"
    assert asked == [True, False]
