import hashlib
import os
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image as PillowImage

from sgam_core.errors import InputError
from sgam_sfm.images import (
    ImageFile,
    image_format,
    inspect_image,
    list_images,
    printable,
    read_image,
    read_label_map,
    read_mask,
)


def save(path: Path, array: np.ndarray, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    PillowImage.fromarray(array).save(path, **options)
    return path


@pytest.fixture
def colours() -> np.ndarray:
    """20 high, 40 wide, red in the upper left quarter."""
    pixels = np.zeros((20, 40, 3), np.uint8)
    pixels[:10, :20, 0] = 255
    return pixels


def test_list_is_sorted_posix_and_counts_the_others(tmp_path, colours):
    for name in ("b.JPG", "sub/a.png", "a b.jpeg", "sub/deep/c.tif", "B.jpg"):
        save(tmp_path / name, colours)
    (tmp_path / "photo.webp").write_bytes(b"")
    for name in ("notes.txt", "sub/Thumbs.db", ".hidden.jpg", "._b.JPG"):
        (tmp_path / name).write_bytes(b"x")
    save(tmp_path / ".thumbnails/b.jpg", colours)
    names, num_others = list_images(tmp_path)
    assert names == ("B.jpg", "a b.jpeg", "b.JPG", "photo.webp", "sub/a.png", "sub/deep/c.tif")
    assert num_others == 2


def test_links_are_followed_and_every_folder_is_listed_once(tmp_path, colours):
    save(tmp_path / "elsewhere/deep/c.png", colours)
    images = tmp_path / "images"
    save(images / "z/a.png", colours)
    (images / "b.png").symlink_to("z/a.png")
    (images / "linked").symlink_to(tmp_path / "elsewhere")
    (images / "a").symlink_to("z")  # sorts before the folder, whose own name counts
    (images / "z/up").symlink_to("..")
    (images / "z/above").symlink_to(tmp_path)
    (tmp_path / "elsewhere/back").symlink_to(images)
    assert list_images(images) == (("b.png", "linked/deep/c.png", "z/a.png"), 0)
    assert inspect_image(images, "linked/deep/c.png").width == 40


def test_links_that_lead_nowhere_are_listed_to_be_named(tmp_path, colours):
    save(tmp_path / "a.png", colours)
    (tmp_path / "gone.png").symlink_to("moved/a.png")
    (tmp_path / "day2").symlink_to("../day2")
    (tmp_path / "round.png").symlink_to("round.png")
    assert list_images(tmp_path) == (("a.png", "day2", "gone.png", "round.png"), 0)
    for name, target in (("gone.png", "moved/a.png"), ("day2", "../day2"), ("round.png", "round.png")):
        with pytest.raises(InputError) as error:
            inspect_image(tmp_path, name)
        assert str(error.value) == (
            f"image '{name}' is a link to '{target}', where there is no file; set the link again or remove it"
        )


def test_list_of_a_missing_folder(tmp_path):
    with pytest.raises(InputError) as error:
        list_images(tmp_path / "nowhere")
    assert (
        str(error.value) == f"image folder '{tmp_path}/nowhere' does not exist; give the folder that holds the images"
    )


def test_list_of_a_file(tmp_path, colours):
    path = save(tmp_path / "a.png", colours)
    with pytest.raises(InputError, match="is a file; give the folder"):
        list_images(path)


def test_list_of_a_folder_without_images(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError) as error:
        list_images(tmp_path)
    assert str(error.value) == (
        f"image folder '{tmp_path}' holds no image (1 other files); expected jpg, png, tif, bmp or ppm"
    )


def test_inspect_knows_size_and_digest(tmp_path, colours):
    path = save(tmp_path / "sub/a.png", colours)
    image = inspect_image(tmp_path, "sub/a.png")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert image == ImageFile(name="sub/a.png", path=path, width=40, height=20, digest=digest)


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_not_applied(tmp_path, colours, suffix, orientation):
    exif = PillowImage.Exif()
    exif[0x0112] = orientation
    path = save(tmp_path / f"a.{suffix}", colours, exif=exif)
    image = inspect_image(tmp_path, path.name)
    assert (image.width, image.height) == (40, 20)
    assert np.abs(read_image(image).astype(int) - colours).mean() < 5


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "bmp"])
def test_truncated_file(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    path = save(tmp_path / f"a.{suffix}", noise)
    path.write_bytes(path.read_bytes()[:-3000])
    with pytest.raises(InputError, match=rf"^'a\.{suffix}' cannot be decoded \(.+\); copy it again from its source"):
        inspect_image(tmp_path, path.name)


@pytest.mark.parametrize("content", [b"not an image", b"\x89PNG\r\n\x1a\n" + bytes(40)])
def test_broken_file(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.png")
    assert str(error.value) == (
        "'a.png' cannot be decoded (not an image of a known format); copy it again from its source, "
        "convert it to JPEG or PNG, or remove it"
    )


def test_empty_file(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.jpg")
    assert str(error.value) == "'a.jpg' is empty (0 bytes); copy it again from its source, or remove it"


@pytest.mark.parametrize("content", ["<!DOCTYPE html>\n<p>404", "\ufeff\n<!-- x --><HTML><p>Sign in"])
def test_web_page_in_place_of_an_image(tmp_path, content):
    (tmp_path / "a.jpg").write_text(content, encoding="utf-8")
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.jpg")
    assert str(error.value) == (
        "'a.jpg' is a web page and not an image, so its download failed; download it again, or remove it"
    )


def test_a_longer_side_than_wanted(tmp_path, monkeypatch):
    PillowImage.new("1", (3000, 1000)).save(tmp_path / "a.png")
    monkeypatch.setattr(PillowImage, "MAX_IMAGE_PIXELS", 1_000_000)  # ours is the limit, and theirs is left alone
    file = inspect_image(tmp_path, "a.png", 3000)
    assert read_image(file).shape == (1000, 3000, 3)
    assert PillowImage.MAX_IMAGE_PIXELS == 1_000_000
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.png", 2999)
    assert str(error.value) == (
        "'a.png' is 3000x1000 pixels (width x height) and was not decoded; make it smaller, or raise --max-image-size, "
        "which is 2999"
    )


def test_a_decompression_bomb_is_not_decoded(tmp_path):
    """A PNG that claims 20,000 x 20,000 pixels, and 100 GB that are a hole in a file."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 20_000, 20_000, 1, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(png)
    with pytest.raises(InputError, match=r"'bomb.png' is 20000x20000 pixels .* raise --max-image-size, which is 16384"):
        inspect_image(tmp_path, "bomb.png")
    with (tmp_path / "hole.jpg").open("wb") as file:
        file.truncate(10**11)
    with pytest.raises(InputError, match=r"image 'hole.jpg' is a file of 100.0 GB, more than any image of --max-image"):
        inspect_image(tmp_path, "hole.jpg")


def test_broken_metadata_is_passed_over_without_a_warning(tmp_path, colours):
    exif = b"Exif\0\0II*\0\x08\0\0\0\x05\0\x0f\x01"
    path = save(tmp_path / "a.jpg", colours, exif=exif)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert inspect_image(tmp_path, path.name).width == 40
        assert read_image(path).shape == (20, 40, 3)
    assert caught == []


def test_formats_that_are_no_photos_are_not_tried(tmp_path, colours):
    """Pillow would run Ghostscript."""
    save(tmp_path / "a.eps", colours)
    (tmp_path / "a.eps").rename(tmp_path / "a.jpg")
    with pytest.raises(InputError, match=r"^'a\.jpg' cannot be decoded \(not an image of a known format\)"):
        inspect_image(tmp_path, "a.jpg")


@pytest.mark.parametrize("size", [(2, 101), (101, 2)])
def test_strips_are_refused(tmp_path, size):
    PillowImage.new("L", size).save(tmp_path / "a.png")
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.png")
    assert str(error.value) == (
        f"image 'a.png' is {size[0]}x{size[1]} (width x height), a strip more than 50 times as long as wide; crop it, "
        "or remove it"
    )
    PillowImage.new("L", (2, 100)).save(tmp_path / "a.png")
    assert inspect_image(tmp_path, "a.png").height == 100


def test_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.jpg")
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.jpg")
    assert str(error.value) == "image 'a.jpg' is not a regular file but a folder, pipe or device; remove it"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_image_that_may_not_be_read(tmp_path, colours):
    save(tmp_path / "a.png", colours).chmod(0)
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.png")
    assert str(error.value) == (
        f"image 'a.png' cannot be read from '{tmp_path}' (Permission denied); check its permissions"
    )


@pytest.mark.parametrize(("raw", "shown"), [(b"caf\xe9.png", "caf\\udce9.png"), (b"two\nlines.png", "two\\nlines.png")])
def test_names_that_no_log_or_database_can_hold(tmp_path, colours, raw, shown):
    name = os.fsdecode(raw)
    save(tmp_path / "a.png", colours).rename(tmp_path / name)
    assert list_images(tmp_path) == ((name,), 0)
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, name)
    assert str(error.value) == (
        f"image '{shown}' has a character in its name that cannot be used (a control character, or bytes that are not "
        "UTF-8); rename it"
    )


def test_names_too_long_for_a_label_map(tmp_path, colours):
    save(tmp_path / "folder" / ("é" * 113 + ".png"), colours)
    assert inspect_image(tmp_path, "folder/" + "é" * 113 + ".png").width == 40
    name = "é" * 114 + ".png"
    save(tmp_path / name, colours)
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, name)
    assert str(error.value) == (
        f"image '{name}' has a file name of 232 bytes; expected at most 230, since its label map gets a longer one: "
        "rename it"
    )


def test_printable_keeps_every_script():
    name = "東京\u3000タワー 'x' cafe\u0301 🙂 \\n.jpg"
    assert printable(name) == name


def test_missing_image(tmp_path):
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.png")
    assert str(error.value) == (
        f"image 'a.png' cannot be read from '{tmp_path}' (No such file or directory); check the name"
    )


def test_pixels_of_every_kind_become_rgb(tmp_path):
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    expected = np.repeat(grey[:, :, None], 3, axis=2)
    palette = PillowImage.fromarray(grey)
    palette = palette.convert("P")
    alpha = np.dstack([expected, np.full_like(grey, 7)])
    variants = {
        "grey.png": PillowImage.fromarray(grey),
        "sixteen.png": PillowImage.fromarray(grey.astype(np.uint16) * 257),
        "sixteen.tif": PillowImage.fromarray(grey.astype(np.uint16) * 257),
        "palette.png": palette,
        "alpha.png": PillowImage.fromarray(alpha),
        "grey-alpha.png": PillowImage.fromarray(alpha).convert("LA"),
        "cmyk.tif": PillowImage.fromarray(expected).convert("CMYK"),
        "rgb.ppm": PillowImage.fromarray(expected),
        "grey.pgm": PillowImage.fromarray(grey),
    }
    for name, picture in variants.items():
        picture.save(tmp_path / name)
        pixels = read_image(tmp_path / name)
        assert pixels.dtype == np.uint8
        np.testing.assert_array_equal(pixels, expected, err_msg=name)


def _sixteen_bit(pixels: np.ndarray) -> np.ndarray:
    return pixels.astype(np.uint16) * 257


@pytest.mark.parametrize(
    "kind",
    [
        *("progressive.jpg", "cmyk.jpg", "grey.jpg", "turned.jpg", "turned.png", "turned.tif", "sixteen.png"),
        *("sixteen.tif", "grey16.png", "grey16.tif", "alpha.png", "moving.png", "pages.tif", "one.png", "one.jpg"),
        "png.jpg",
    ],
)
def test_geometry_and_pixels_are_those_of_colmap(tmp_path, kind):
    pixels = np.random.default_rng(0).integers(0, 255, (20, 40, 3)).astype(np.uint8)
    picture, path = PillowImage.fromarray(pixels), tmp_path / kind
    frames = {"save_all": True, "append_images": [PillowImage.new("RGB", (40, 20), (200, 0, 0))]}
    exif = PillowImage.Exif()
    exif[0x0112] = 6
    match path.stem:
        case "progressive":
            picture.save(path, progressive=True)
        case "cmyk" | "grey" | "alpha":
            picture.convert({"cmyk": "CMYK", "grey": "L", "alpha": "RGBA"}[path.stem]).save(path)
        case "turned":
            picture.save(path, exif=exif)
        case "sixteen":
            assert cv2.imwrite(str(path), _sixteen_bit(pixels))
        case "grey16":
            assert cv2.imwrite(str(path), _sixteen_bit(pixels[:, :, 0]))
        case "moving" | "pages":
            picture.save(path, **frames)
        case "one":
            picture.crop((0, 0, 1, 1)).save(path)
        case "png":
            picture.save(path, format="PNG")
    seen = pycolmap.Bitmap.read(path, True).to_array()
    np.testing.assert_allclose(read_image(path), seen, atol=2, err_msg="COLMAP reads other pixels")
    assert inspect_image(tmp_path, kind).width == seen.shape[1]


@pytest.mark.parametrize("kind", ["GIF", "WEBP", "JPEG2000"])
def test_the_format_of_a_file_does_not_follow_from_its_name(tmp_path, colours, kind):
    save(tmp_path / "a.jpg", colours, format=kind)
    assert image_format(tmp_path / "a.jpg") == kind


def test_black_and_white(tmp_path):
    save(tmp_path / "a.png", np.eye(8, dtype=bool))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[:, :, 1], np.eye(8, dtype=np.uint8) * 255)


def test_float_pixels_are_refused(tmp_path):
    save(tmp_path / "a.tif", np.ones((4, 4), np.float32))
    with pytest.raises(InputError) as error:
        inspect_image(tmp_path, "a.tif")
    assert str(error.value) == "'a.tif' has 32-bit pixels; expected 8 or 16 bits a channel: convert it to PNG"


def image_file(name: str, width: int, height: int) -> ImageFile:
    return ImageFile(name=name, path=Path(name), width=width, height=height, digest="0")


def test_mask_follows_the_convention_of_colmap(tmp_path):
    wanted = np.zeros((3, 4), np.uint8)
    wanted[1, 2], wanted[0, 0] = 255, 1
    save(tmp_path / "sub/a.jpg.png", wanted)
    mask = read_mask(tmp_path, image_file("sub/a.jpg", 4, 3))
    assert mask is not None
    np.testing.assert_array_equal(mask, wanted > 0)
    assert read_mask(tmp_path, image_file("b.jpg", 4, 3)) is None


def test_mask_of_a_png_may_keep_its_name(tmp_path):
    save(tmp_path / "a.png", np.ones((3, 4), np.uint8))
    mask = read_mask(tmp_path, image_file("a.png", 4, 3))
    assert mask is not None
    assert mask.all()


def test_mask_in_colour(tmp_path, colours):
    save(tmp_path / "a.jpg.png", colours)
    mask = read_mask(tmp_path, image_file("a.jpg", 40, 20))
    assert mask is not None
    np.testing.assert_array_equal(mask, colours[:, :, 0] > 0)


def test_mask_of_another_size(tmp_path):
    save(tmp_path / "a.jpg.png", np.ones((3, 4), np.uint8))
    with pytest.raises(InputError) as error:
        read_mask(tmp_path, image_file("a.jpg", 8, 6))
    assert str(error.value) == (
        "mask of 'a.jpg' is 3x4 but the image is 6x8 (height x width); make it again from this image"
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_label_map_keeps_ids(tmp_path, dtype):
    ids = np.array([[0, 1, 2], [3, 40, np.iinfo(dtype).max]], dtype)
    labels = read_label_map(save(tmp_path / "a.png", ids))
    assert labels.dtype == np.int32
    np.testing.assert_array_equal(labels, ids)


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_label_map_of_a_palette_gives_indices(tmp_path, bits):
    indices = np.arange(12, dtype=np.uint8).reshape(3, 4) & ((1 << bits) - 1)
    picture = PillowImage.fromarray(indices)
    picture.putpalette([200, 0, 0, 0, 200, 0, 0, 0, 200] * 85)
    assert picture.mode == "P"
    picture.save(tmp_path / "a.png", bits=bits)
    np.testing.assert_array_equal(read_label_map(tmp_path / "a.png"), indices)


@pytest.mark.parametrize("bits", [2, 4])
def test_label_map_of_few_bits_keeps_ids(tmp_path, bits):
    """Written by hand: Pillow does not write grey PNGs of 2 or 4 bits."""
    ids = np.arange(16, dtype=np.uint8).reshape(4, 4) & ((1 << bits) - 1)
    path = tmp_path / "a.png"
    packed = _png_of_few_bits(ids, bits)
    path.write_bytes(packed)
    step = 255 // ((1 << bits) - 1)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), ids * step)
    np.testing.assert_array_equal(read_label_map(path), ids)


def _png_of_few_bits(ids: np.ndarray, bits: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    shifts = np.arange(bits)[::-1]
    rows = [b"\0" + np.packbits((row[:, None] >> shifts & 1).astype(np.uint8)).tobytes() for row in ids]
    header = struct.pack(">IIBBBBB", ids.shape[1], ids.shape[0], bits, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"".join(rows))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def test_label_map_in_colour_is_refused(tmp_path, colours):
    path = save(tmp_path / "a.png", colours)
    with pytest.raises(InputError) as error:
        read_label_map(path)
    assert str(error.value) == (
        f"label map '{path}' has the colours of a picture (mode RGB); expected one channel of ids, "
        "8 or 16 bits or a palette; export the ids, or name the JSON of panoptic maps by --label-names"
    )


def test_label_map_missing(tmp_path):
    with pytest.raises(InputError, match=r"label map '.*a\.png' cannot be read \(No such file or directory\)"):
        read_label_map(tmp_path / "a.png")
