"""Odd and broken images, names, pair lists and label maps, through the whole command with the real models."""

from __future__ import annotations

import codecs
import json
import os
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from sgam_sfm import cli
from sgam_sfm.colmap.reading import read_database
from tests.textures import similarity, view

DONE, ERROR, SOME_FAILED, NO_MODEL = 0, 1, 3, 4
COMPOSED, DECOMPOSED = "caf\u00e9.jpg", "cafe\u0301.jpg"
UNKNOWN_FORMAT = (
    "cannot be decoded (not an image of a known format); copy it again from its source, convert it to JPEG or PNG, or "
    "remove it"
)


def photo(index: int, size: tuple[int, int] = (160, 120), seed: int = 0) -> PIL.Image.Image:
    """Views of one plane that overlap; those of another seed show another plane."""
    pixels = view(similarity(0.6 + 0.01 * index, 1.0 * index, (1.0 * index, 0.0), (80.0, 60.0)), size, seed)
    return PIL.Image.fromarray(pixels)


def save(picture: PIL.Image.Image, path: Path, **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, **options)


def run(folder: Path, *more: str, output: str = "out") -> tuple[int, dict]:
    """The exit code and the summary of a run on folder/images."""
    code = cli.run(
        ["match", "--images", str(folder / "images"), "--output", str(folder / output), "--image-size", "320", *more]
    )
    path = folder / output / "summary.json"
    return code, json.loads(path.read_text()) if path.exists() else {}


@pytest.fixture(scope="module")
def usable(tmp_path_factory) -> Path:
    """Images that are odd but good, in one folder with broken ones."""
    folder = tmp_path_factory.mktemp("odd")
    images = folder / "images"
    plain = ["plain.jpg", "two words.jpg", COMPOSED, DECOMPOSED, "a.b.c.jpg", "UPPER.JPG", "a/b.jpg", "a-b.jpg"]
    for index, name in enumerate([*plain, "東京\u3000タワー.jpg", "#1.jpg", "[red]'x'.jpg"]):
        save(photo(index), images / name)
    save(photo(1), images / "progressive.jpg", progressive=True)
    for name, mode in (("grey.jpg", "L"), ("cmyk.jpg", "CMYK"), ("alpha.png", "RGBA"), ("palette.png", "P")):
        save(photo(2).convert(mode), images / name)
    sixteen = np.asarray(photo(3)).astype(np.uint16) * 257
    assert cv2.imwrite(str(images / "sixteen.png"), sixteen)
    assert cv2.imwrite(str(images / "sixteen.tif"), sixteen[:, :, 0])
    save(photo(4), images / "moving.png", save_all=True, append_images=[photo(9)])
    exif = PIL.Image.Exif()
    exif[0x0112] = 6
    save(photo(5), images / "turned.jpg", exif=exif)
    save(photo(0, (1, 1)), images / "one.png")
    save(photo(0, (320, 32)), images / "wide.jpg")
    save(photo(0, (32, 320)), images / "tall.jpg")
    save(PIL.Image.new("RGB", (160, 120), (90, 90, 90)), images / "flat.png")
    save(photo(0, seed=1), images / "elsewhere.jpg")
    (images / "copy.jpg").write_bytes((images / "plain.jpg").read_bytes())
    save(photo(12), folder / "store/far.jpg")
    (images / "linked.jpg").symlink_to(folder / "store/far.jpg")
    names = [path.relative_to(images).as_posix() for path in images.rglob("*.*")]
    (images / "linked").symlink_to(folder / "store")
    (images / "a/up").symlink_to("..")
    for name in [*names, "linked/far.jpg"]:
        with PIL.Image.open(images / name) as picture:
            width, height = picture.size
        ids = np.indices((height, width)).sum(0) * 3 // (width + height) + 1
        save(PIL.Image.fromarray(ids.astype(np.uint8)), folder / "labels" / f"{name}.png")
    return folder


@pytest.fixture(scope="module")
def broken(usable: Path) -> dict[str, str]:
    """Broken images beside the good ones, and what is to be said of each."""
    images = usable / "images"
    (images / "zero.jpg").write_bytes(b"")
    (images / "page.jpg").write_text("<!DOCTYPE html><html>Not found</html>")
    (images / "text.png").write_text("not an image")
    save(photo(0), images / "cut.png")
    (images / "cut.png").write_bytes((images / "cut.png").read_bytes()[:-900])
    save(photo(0), images / "modern.webp")
    save(photo(0), images / "moving.gif", save_all=True, append_images=[photo(9)])
    save(photo(0), images / "really.jpg", format="WEBP")
    (images / "gone.jpg").symlink_to("moved/gone.jpg")
    (images / os.fsdecode(b"latin\xe9.jpg")).write_bytes((images / "plain.jpg").read_bytes())
    (images / "notes.txt").write_text("a file that is no image")
    colmap = "COLMAP cannot read this file; save the image as JPEG or PNG"
    return {
        "zero.jpg": "'zero.jpg' is empty (0 bytes); copy it again from its source, or remove it",
        "page.jpg": "'page.jpg' is a web page and not an image, so its download failed; "
        "download it again, or remove it",
        "text.png": f"'text.png' {UNKNOWN_FORMAT}",
        "cut.png": f"'cut.png' {UNKNOWN_FORMAT}".replace("not an image of a known format", "image file is truncated"),
        "modern.webp": f"'modern.webp' (WEBP): {colmap}",
        "moving.gif": f"'moving.gif' (GIF): {colmap}",
        "really.jpg": f"'really.jpg' (WEBP): {colmap}",
        "gone.jpg": (
            "image 'gone.jpg' is a link to 'moved/gone.jpg', where there is no file; set the link again or remove it"
        ),
        "latin\\udce9.jpg": (
            "image 'latin\\udce9.jpg' has a character in its name that cannot be used (a control character, or bytes "
            "that are not UTF-8); rename it"
        ),
    }


def test_an_odd_collection(usable, broken, capsys):
    maps = (usable / "labels").rglob("*.png")  # one for every good image
    names = sorted(path.relative_to(usable / "labels").as_posix().removesuffix(".png") for path in maps)
    assert {COMPOSED, DECOMPOSED, "a/b.jpg", "a-b.jpg", "linked/far.jpg", "東京\u3000タワー.jpg"} < {*names}
    others = [name for name in names if name not in ("plain.jpg", "#1.jpg")]
    lines = ["# pairs", "", *(f"plain.jpg\t{name}" for name in others), "#1.jpg\tplain.jpg", "plain.jpg\t#1.jpg"]
    lines += ["plain.jpg a\\b.jpg", "./plain.jpg plain.jpg", "a/b.jpg plain.jpg", "plain.jpg zero.jpg", ""]
    (usable / "pairs.txt").write_bytes(codecs.BOM_UTF8 + "\r\n".join(lines).encode())
    (usable / "out").mkdir()
    (usable / "out/matches.h5").write_bytes(b"of an earlier run")

    options = ("--pairs", str(usable / "pairs.txt"), "--labels", str(usable / "labels"), "--no-mapping")
    code, summary = run(usable, *options)
    assert code == SOME_FAILED
    assert summary["images"]["failed"] == broken
    assert summary["images"]["used"] == len(names)
    assert summary["images"]["other_files"] == 1
    pairs = summary["pairs"]
    assert [pairs[key] for key in ("listed", "of_unusable_images", "repeated", "reversed", "self")] == [
        len(names) - 1, 1, 1, 1, 1,
    ]  # fmt: skip
    assert pairs["matched"] == len(names) - 1
    assert not pairs["failed"]
    assert not summary["labels"]["failed"]

    content = read_database(usable / "out/database.db")
    assert sorted(content["images"]) == names
    sizes = {
        name: (camera["width"], camera["height"])
        for name, image in content["images"].items()
        for camera in [content["cameras"][image["camera_id"]]]
    }
    odd = {"one.png": (1, 1), "wide.jpg": (320, 32), "tall.jpg": (32, 320)}
    assert sizes == dict.fromkeys(names, (160, 120)) | odd  # `turned.jpg` too: as stored
    matched = {name for pair, indices in content["matches"].items() if len(indices) > 30 for name in pair}
    assert matched >= {*names} - {*odd, "flat.png", "elsewhere.jpg", "#1.jpg"}
    verified = {name for pair in content["two_view_geometries"] for name in pair}
    assert not verified & {"one.png", "flat.png"}

    log = (usable / "out/log.txt").read_text(encoding="utf-8")
    assert "4 images have the same content as another, such as 'copy.jpg' and 'plain.jpg'" in log
    assert "matches.h5 is left out: images 'a-b.jpg' and 'a/b.jpg' are both 'a-b.jpg' in hloc's matches file" in log
    assert (usable / "out/keypoints.h5").exists()
    assert not (usable / "out/matches.h5").exists()
    assert "Traceback" not in log + capsys.readouterr().err


def test_a_collection_in_which_nothing_matches(tmp_path, capsys):
    rng = np.random.default_rng(0)
    for index in range(2):
        noise = PIL.Image.fromarray(rng.integers(0, 256, (120, 160, 3), np.uint8))
        save(noise, tmp_path / f"images/noise{index}.png")
        save(PIL.Image.new("RGB", (160, 120), (80 * index, 90, 90)), tmp_path / f"images/flat{index}.png")
    code, summary = run(tmp_path, "--area-matcher", "none")
    assert code == NO_MODEL
    assert summary["models"] == []
    assert summary["pairs"]["matched"] == 6
    assert summary["pairs"]["failed"] == {}
    assert summary["pairs"]["verified"] == 0
    assert "larger --image-size" in summary["no_model"]
    assert summary["no_model"] in " ".join(capsys.readouterr().err.split())


def test_odd_label_maps(tmp_path):
    blocks = np.arange(500, dtype=np.uint16).reshape(20, 25) * 131
    maps = {
        "void": np.zeros((120, 160), np.uint8),
        "one": np.full((120, 160), 7, np.uint8),
        "many": np.kron(blocks, np.ones((6, 7), np.uint16))[:, :160],
        "two": np.indices((120, 160), np.uint8)[1] // 80 + 1,
    }
    for index, (name, ids) in enumerate(maps.items()):
        save(photo(index), tmp_path / f"images/{name}.jpg")
        save(PIL.Image.fromarray(ids), tmp_path / f"labels/{name}.jpg.png")
    code, summary = run(tmp_path, "--labels", str(tmp_path / "labels"), "--no-mapping")
    assert code == DONE
    assert summary["pairs"]["matched"] == summary["pairs"]["verified"] == 6
    assert summary["pairs"]["failed"] == summary["labels"]["failed"] == {}


def test_a_label_map_of_ids_of_single_objects(tmp_path):
    for index, name in enumerate(("a.jpg", "b.jpg")):
        ids = np.arange(1, 60_001, dtype=np.uint16).reshape(200, 300) if index else np.ones((200, 300), np.uint8)
        save(photo(index, (300, 200)), tmp_path / "images" / name)
        save(PIL.Image.fromarray(ids), tmp_path / f"labels/{name}.png")
    code, summary = run(tmp_path, "--labels", str(tmp_path / "labels"), "--no-mapping")
    assert code == SOME_FAILED
    assert list(summary["labels"]["failed"]) == ["b.jpg"]
    assert "60000 different ids" in summary["labels"]["failed"]["b.jpg"]
    assert summary["pairs"]["verified"] == 1


def test_no_image_can_be_used(tmp_path, capsys):
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / "images").mkdir(exist_ok=True)
        (tmp_path / "images" / name).write_bytes(b"")
    (tmp_path / "cameras.txt").write_text("* PINHOLE 160 120 200 200 80 60\n")
    assert run(tmp_path, "--cameras", str(tmp_path / "cameras.txt")) == (ERROR, {})
    assert (
        f"error: none of the 2 images in '{tmp_path / 'images'}' can be used: 'a.jpg' is empty (0 bytes); copy it "
        "again from its source, or remove it"
    ) in capsys.readouterr().err.splitlines()


@pytest.mark.parametrize("spoilt", [False, True])
def test_one_image_makes_no_pair(tmp_path, capsys, spoilt):
    save(photo(0), tmp_path / "images/a.jpg")
    more: tuple[str, ...] = ()
    if spoilt:
        (tmp_path / "images/b.jpg").write_bytes(b"")
        (tmp_path / "pairs.txt").write_text("a.jpg b.jpg\n")
        more = ("--pairs", str(tmp_path / "pairs.txt"))
    assert run(tmp_path, *more) == (ERROR, {})
    used, why = ("1 of 2", "each listed pair names another one") if spoilt else ("1 of 1", "a pair needs two")
    expected = f"error: no pair to match: {used} images in '{tmp_path / 'images'}' can be used, and {why}"
    assert expected in capsys.readouterr().err.splitlines()
