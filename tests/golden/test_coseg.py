"""CoSeg on drawn images (exact properties) and on real ones (recorded bounds)."""

import shutil
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from sgam_core.errors import InputError, OptionError, WeightsError
from sgam_sfm.images import ImageFile, inspect_image
from sgam_sfm.segmenters.coseg import CoSeg

Labels = np.ndarray


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    """Three views of a house of flat colours and noise, each shifted and lit otherwise."""
    folder = tmp_path_factory.mktemp("drawn")
    rng = np.random.default_rng(0)
    for number in range(3):
        pixels = np.full((150, 200, 3), (120, 170, 230), np.uint8)
        pixels[110:] = (70, 120, 60)
        x = 30 + 25 * number
        pixels[40:120, x : x + 90] = (170, 90, 60)
        pixels[70:120, x + 35 : x + 60] = (50, 40, 30)
        noise = rng.integers(-15 - 5 * number, 16, pixels.shape)
        PillowImage.fromarray(np.clip(pixels + noise, 0, 255).astype(np.uint8)).save(folder / f"{number}.png")
    return folder


def inspect_all(folder: Path) -> list[ImageFile]:
    return [inspect_image(folder, path.relative_to(folder).as_posix()) for path in sorted(folder.rglob("*.png"))]


def run(segmenter: CoSeg, images: list[ImageFile]) -> dict[str, Labels]:
    return {image.name: labels for image, labels in segmenter.segment(images, lambda share: None)}


@pytest.fixture(scope="module")
def quick() -> CoSeg:
    return CoSeg(image_size=224)


def test_order_and_names_do_not_matter(quick, drawn, tmp_path):
    renamed = {"0.png": "z/front.png", "1.png": "a.png", "2.png": "m/x.png"}
    for old, new in renamed.items():
        (tmp_path / new).parent.mkdir(exist_ok=True)
        shutil.copy(drawn / old, tmp_path / new)
    expected = run(quick, inspect_all(drawn))
    labels = run(quick, inspect_all(tmp_path))
    for old, new in renamed.items():
        np.testing.assert_array_equal(labels[new], expected[old])


def test_the_number_of_threads_and_equal_images_do_not_matter(drawn, tmp_path):
    for number in range(6):
        shutil.copy(drawn / f"{number % 3}.png", tmp_path / f"{number}.png")
    images = inspect_all(tmp_path)
    alone, together = (run(CoSeg(image_size=224, threads=threads), images) for threads in (1, 4))
    for name, labels in alone.items():
        np.testing.assert_array_equal(together[name], labels)


def test_a_cache_changes_nothing_and_is_used(quick, drawn, tmp_path, monkeypatch):
    expected = run(quick, inspect_all(drawn))
    monkeypatch.setattr(quick, "_cache_folder", tmp_path / "cache")
    first = run(quick, inspect_all(drawn))
    assert len(list((tmp_path / "cache").iterdir())) == 3
    monkeypatch.setattr(quick, "_patch_features", None)
    second = run(quick, inspect_all(drawn))
    for name, labels in expected.items():
        np.testing.assert_array_equal(first[name], labels)
        np.testing.assert_array_equal(second[name], labels)


def test_a_cache_of_other_settings_is_not_used(quick, drawn, tmp_path, monkeypatch):
    images = inspect_all(drawn)[:1]
    monkeypatch.setattr(quick, "_cache_folder", tmp_path)
    run(quick, images)
    run(CoSeg(image_size=238, cache_folder=tmp_path), images)
    assert len(list(tmp_path.iterdir())) == 2


def test_the_descriptor_is_the_mean_of_the_features_that_labels_need_too(quick, drawn, tmp_path, monkeypatch):
    images = inspect_all(drawn)
    monkeypatch.setattr(quick, "_cache_folder", tmp_path)
    run(quick, images)
    monkeypatch.setattr(quick, "_patch_features", None)
    gone = ImageFile(name="gone.png", path=drawn / "gone.png", width=8, height=8, digest="ff")
    shares: list[float] = []
    described = {file.name: made for file, made in quick.describe([*images[:2], gone], shares.append)}
    features = np.load(next(tmp_path.glob(f"{images[1].digest}-*.npy"))).astype(np.float64)
    np.testing.assert_allclose(described["1.png"], features.reshape(-1, 384).mean(axis=0), atol=1e-5)
    assert not np.allclose(described["0.png"], described["1.png"], atol=1e-4)
    assert isinstance(described["gone.png"], InputError)
    assert shares == [1, 1, 1]


def test_damaged_cache_is_computed_again(quick, drawn, tmp_path, monkeypatch, caplog):
    images = inspect_all(drawn)[:1]
    monkeypatch.setattr(quick, "_cache_folder", tmp_path)
    expected = run(quick, images)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:500])
    np.testing.assert_array_equal(run(quick, images)["0.png"], expected["0.png"])
    assert "are damaged" in caplog.text


def test_number_of_labels_is_chosen_or_given(quick, drawn):
    run(quick, inspect_all(drawn))
    assert quick.num_labels_chosen in quick.stability
    assert all(0 < agreement <= 1 for agreement in quick.stability.values())
    given = CoSeg(image_size=224, num_labels=3)
    labels = run(given, inspect_all(drawn))
    assert given.num_labels_chosen == 3
    assert set(np.unique(np.concatenate([each.ravel() for each in labels.values()]))) == {1, 2, 3}


def test_a_collection_of_which_nothing_can_be_read(quick, drawn):
    gone = ImageFile(name="gone.png", path=drawn / "gone.png", width=8, height=8, digest="ff")
    results = run(quick, [gone])
    assert isinstance(results["gone.png"], InputError)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_labels": 1}, "num_labels is 1; expected 2 to 255, or none to choose it"),
        ({"image_size": 100}, "image_size is 100; expected at least 224 pixels"),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(OptionError) as error:
        CoSeg(**options)
    assert str(error.value) == message


def test_weights_that_are_no_model(tmp_path):
    path = tmp_path / "model.onnx"
    path.write_bytes(b"not a model")
    with pytest.raises(WeightsError) as error:
        CoSeg(weights=path)
    assert str(error.value) == f"'{path}' cannot be read as an ONNX model; give a DINOv2 in ONNX form"


FRAMES = ("000000", "000035", "000070", "000105")


@pytest.fixture(scope="module")
def real() -> CoSeg:
    return CoSeg(image_size=448)


@pytest.mark.golden
def test_labels_agree_between_real_views(real, data):
    """A pixel and the pixel of another frame that sees the same 3D point get the same label.

    Recorded with the defaults at 448 pixels and seed 0, onnxruntime 1.31, x86-64: 84 %, where independent labels of the
    same shares would agree on 10 %.
    """
    folder = data / "scannet/scene0007_00"
    images = [inspect_image(folder / "color", f"scene0007_00_{frame}.jpg") for frame in FRAMES]
    labels = list(run(real, images).values())
    agreements, chances = [], []
    for (frame0, labels0), (frame1, labels1) in pairwise(zip(FRAMES, labels, strict=True)):
        ids0, ids1 = corresponding_labels(folder, frame0, frame1, labels0, labels1)
        assert len(ids0) > 1000
        agreements.append(np.mean(ids0 == ids1))
        shares0, shares1 = (np.bincount(ids, minlength=256) / len(ids) for ids in (ids0, ids1))
        chances.append(shares0 @ shares1)
    assert np.mean(agreements) > 0.78
    assert np.mean(chances) < 0.15


@pytest.mark.golden
def test_regions_of_a_facade_have_the_size_of_areas(real, data):
    """Regions of 1 to 30 % of the image are what areas are made of.

    Recorded with the defaults at 448 pixels and seed 0, onnxruntime 1.31, x86-64: 18 to 23 such regions cover
    97 to 98 % of each image.
    """
    folder = data / "strecha/Herz-Jesus-P8/images"
    images = [inspect_image(folder, f"{number:04}.jpg") for number in (2, 4, 6)]
    for labels in run(real, images).values():
        shares = np.array([share for label in np.unique(labels) for share in region_shares(labels == label)])
        useful = (shares >= 0.01) & (shares <= 0.3)
        assert shares[useful].sum() > 0.85
        assert useful.sum() >= 10


def region_shares(mask: np.ndarray) -> np.ndarray:
    """Area of each connected region, as a share of the image."""
    _, _, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return statistics[1:, cv2.CC_STAT_AREA] / mask.size


def corresponding_labels(
    folder: Path, frame0: str, frame1: str, labels0: Labels, labels1: Labels
) -> tuple[Labels, Labels]:
    """Labels of the depth pixels of frame 0 and of where frame 1 sees the same points, unless its depth differs."""
    depth0, depth1 = (
        cv2.imread(str(folder / f"depth/scene0007_00_{frame}.pgm"), cv2.IMREAD_UNCHANGED) / 1000
        for frame in (frame0, frame1)
    )
    world_from_camera0, world_from_camera1 = (
        np.loadtxt(folder / f"pose/scene0007_00_{frame}.txt") for frame in (frame0, frame1)
    )
    camera_matrix = np.array([[577.871, 0, 320.0], [0, 577.871, 240.0], [0, 0, 1]])  # depth, corner origin
    y, x = (index.ravel() for index in np.mgrid[2:480:4, 2:640:4])
    z = depth0[y, x]
    y, x, z = y[z > 0], x[z > 0], z[z > 0]
    points0 = np.linalg.inv(camera_matrix) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))]) * z
    camera1_from_camera0 = np.linalg.inv(world_from_camera1) @ world_from_camera0
    points1 = camera1_from_camera0[:3, :3] @ points0 + camera1_from_camera0[:3, 3:]
    u, v, _ = camera_matrix @ points1 / points1[2]
    inside = (points1[2] > 0) & (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
    x, y, u, v, z = x[inside], y[inside], u[inside], v[inside], points1[2][inside]
    seen = np.abs(depth1[v.astype(int), u.astype(int)] - z) < 0.05 * z
    return look_up(labels0, x[seen] + 0.5, y[seen] + 0.5), look_up(labels1, u[seen], v[seen])


def look_up(labels: Labels, x: np.ndarray, y: np.ndarray) -> Labels:
    """Labels at pixels of a 640 x 480 frame."""
    rows, columns = labels.shape
    return labels[(y * rows / 480).astype(int), (x * columns / 640).astype(int)]
