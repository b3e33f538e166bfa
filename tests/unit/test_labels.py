from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage

from sgam_core.errors import InputError
from sgam_sfm.images import ImageFile
from sgam_sfm.segmenters.labels import LabelFolder

IDS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 300


def image_file(name: str, width: int = 4, height: int = 3) -> ImageFile:
    return ImageFile(name=name, path=Path("images") / name, width=width, height=height, digest="0")


def save(folder: Path, name: str, ids: np.ndarray = IDS) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    PillowImage.fromarray(ids).save(folder / name)


def only_result(folder: Path, image: ImageFile) -> object:
    ((yielded, labels),) = LabelFolder(folder).segment([image], lambda share: None)
    assert yielded == image
    return labels


@pytest.mark.parametrize("name", ["a.jpg", "sub/a.jpg", "sub/a.b.jpg"])
@pytest.mark.parametrize("with_suffix", [True, False])
def test_labels_of_an_image(tmp_path, name, with_suffix):
    save(tmp_path, f"{name}.png" if with_suffix else name.replace(".jpg", ".png"))
    labels = only_result(tmp_path, image_file(name))
    assert isinstance(labels, np.ndarray)
    assert labels.dtype == np.int32
    np.testing.assert_array_equal(labels, IDS)


def test_labels_of_an_image_without_suffix_and_of_a_png(tmp_path):
    save(tmp_path, "a.png")
    assert isinstance(only_result(tmp_path, image_file("a.png")), np.ndarray)


def test_two_label_maps(tmp_path):
    save(tmp_path, "sub/a.png")
    save(tmp_path, "sub/a.jpg.png")
    error = only_result(tmp_path, image_file("sub/a.jpg"))
    assert isinstance(error, InputError)
    assert str(error) == "two label maps for 'sub/a.jpg': 'sub/a.jpg.png' and 'sub/a.png'; keep one of them"


def test_no_label_map(tmp_path):
    error = only_result(tmp_path, image_file("sub/a.jpg"))
    assert isinstance(error, InputError)
    assert str(error) == f"no labels for 'sub/a.jpg'; expected 'sub/a.jpg.png' or 'sub/a.png' in '{tmp_path}'"


def test_another_size(tmp_path):
    save(tmp_path, "a.jpg.png")
    error = only_result(tmp_path, image_file("a.jpg", width=8, height=6))
    assert isinstance(error, InputError)
    assert str(error) == (
        "labels for 'a.jpg' are 3x4 but the image is 6x8 (height x width); export them again at the image's size, "
        "or pass --resize-labels"
    )


def test_maps_of_a_run_have_a_size_of_their_own(tmp_path):
    save(tmp_path, "a.png")
    (tmp_path / "labels.json").write_text('{"made_from": "0123"}')
    assert only_result(tmp_path, image_file("a.jpg", 8, 6)).shape == (6, 8)


def test_one_failure_leaves_the_others(tmp_path):
    save(tmp_path, "a.png")
    save(tmp_path, "c.png")
    (tmp_path / "d.png").write_bytes(b"broken")
    shares: list[float] = []
    results = {
        image.name: labels
        for image, labels in LabelFolder(tmp_path).segment(
            [image_file(f"{stem}.jpg") for stem in "abcd"], shares.append
        )
    }
    assert list(results) == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert [isinstance(labels, InputError) for labels in results.values()] == [False, True, False, True]
    assert sum(shares) == 4


def test_missing_folder(tmp_path):
    with pytest.raises(InputError) as error:
        LabelFolder(tmp_path / "labels")
    assert str(error.value) == (
        f"--labels '{tmp_path}/labels' does not exist; give the folder that holds <image name>.png"
    )


@pytest.mark.parametrize(
    ("shape", "fits"), [((968, 1296), True), ((240, 320), True), ((640, 480), False), ((480, 480), False)]
)
def test_maps_of_another_size_are_resized_where_they_have_the_aspect_of_their_image(tmp_path, shape, fits):
    save(tmp_path, "a.png", np.ones(shape, np.uint8))
    image = image_file("a.jpg", 640, 480)
    ((_, labels),) = LabelFolder(tmp_path, resize=True).segment([image], lambda share: None)
    if fits:
        assert labels.shape == (480, 640)
    else:
        assert str(labels).startswith(f"labels for 'a.jpg' are {shape[0]}x{shape[1]} but the image is 480x640")
        assert "of another aspect" in str(labels)
