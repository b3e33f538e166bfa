"""What every registered segmenter must do."""

import inspect
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PillowImage

from sgam_core.errors import InputError, WeightsError
from sgam_sfm.external import WorkerCommand
from sgam_sfm.images import ImageFile, inspect_image
from sgam_sfm.segmenters.protocol import Segmenter
from tests import hub_models
from tests.paths import weights_of

HUB = [*(f"hf:{kind}" for kind in hub_models.SEGMENTERS), "coseg:dinov2", "coseg:dinov3"]
"""Segmenters with a model of the hub: a tiny one of that kind."""
SEGMENTERS = sorted({point.name for point in entry_points(group="sgam_sfm.segmenters")} - {"hf"}) + HUB
WORKER = Path(__file__).parents[1] / "workers" / "brightness_worker.py"
QUICK: dict[str, dict[str, Any]] = {
    "coseg": {"image_size": 224, "num_labels": 6},
    "external": {"worker": WorkerCommand(kind="segmenter", name="external", script=WORKER)},
}
SIZES = {"wide.png": (96, 64), "sub/tall.jpg": (40, 120), "tiny.png": (9, 7), "blank.png": (80, 80)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Images of several shapes, one blank, and a label map for each."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    for name, (width, height) in SIZES.items():
        pixels = np.full((height, width, 3), 128, np.uint8)
        if name != "blank.png":
            pixels[: height // 2] = (200, 120, 40)
            pixels[:, width // 2 :] = rng.integers(0, 255, (height, width - width // 2, 3))
        for path, array in ((folder / name, pixels), (folder / f"labels/{name}.png", pixels[:, :, 0])):
            path.parent.mkdir(parents=True, exist_ok=True)
            PillowImage.fromarray(array).save(path)
    return folder


@pytest.fixture(scope="module")
def images(folder) -> list[ImageFile]:
    return [inspect_image(folder, name) for name in SIZES]


@pytest.fixture(scope="module", params=SEGMENTERS)
def segmenter(request, folder, hub_model) -> Segmenter:
    name, _, kind = request.param.partition(":")
    (point,) = entry_points(group="sgam_sfm.segmenters", name=name)
    segmenter_class = point.load()
    options = {**QUICK.get(name, {})}
    if kind:
        options["name"] = str(hub_model(kind))
    if "folder" in inspect.signature(segmenter_class).parameters:
        options["folder"] = folder / "labels"
    if (weights := weights_of(request.param)) is not None:
        options["weights"] = weights
    try:
        return segmenter_class(**options)
    except (TypeError, WeightsError) as error:
        pytest.skip(f"'{request.param}' needs more than its defaults: {error}")


def run(segmenter: Segmenter, images: list[ImageFile]) -> list[tuple[ImageFile, Any]]:
    return list(segmenter.segment(images, lambda share: None))


def test_is_a_segmenter(segmenter):
    assert isinstance(segmenter, Segmenter)


def test_label_maps_in_order_with_the_aspect_of_the_image(segmenter, images):
    results = run(segmenter, images)
    assert [image for image, _ in results] == images
    for image, labels in results:
        assert labels.dtype == np.int32
        assert labels.min() >= 0
        rows, columns = labels.shape
        assert abs(rows - columns * image.height / image.width) <= 1


def test_work_adds_up_and_comes_in_parts(segmenter, images):
    shares: list[float] = []
    list(segmenter.segment(images, shares.append))
    assert sum(shares) == pytest.approx(len(images))
    assert len(shares) >= len(images)
    assert min(shares) >= 0


def test_repeats_to_the_bit(segmenter, images):
    for (_, labels0), (_, labels1) in zip(run(segmenter, images), run(segmenter, images), strict=True):
        np.testing.assert_array_equal(labels0, labels1)


def test_no_images(segmenter):
    assert run(segmenter, []) == []


def test_a_single_image(segmenter, images):
    ((image, labels),) = run(segmenter, images[:1])
    assert image == images[0]
    assert labels.ndim == 2


def test_an_image_that_cannot_be_read_yields_its_error(segmenter, images, folder):
    gone = ImageFile(name="gone.png", path=folder / "gone.png", width=8, height=8, digest="00")
    results = run(segmenter, [images[0], gone, images[1]])
    assert [image.name for image, _ in results] == ["wide.png", "gone.png", "sub/tall.jpg"]
    assert isinstance(results[1][1], InputError)
    assert "gone.png" in str(results[1][1])
    assert isinstance(results[0][1], np.ndarray)
    assert isinstance(results[2][1], np.ndarray)
