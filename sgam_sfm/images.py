"""Read images, masks and label maps of a folder, in the geometry that COLMAP sees (EXIF orientation not applied)."""

from __future__ import annotations

import hashlib
import io
import os
import struct
import sys
import threading
import unicodedata
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int32, UInt8
from PIL import ExifTags, UnidentifiedImageError
from PIL import Image as PillowImage

from sgam_core.errors import InputError

_COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".ppm", ".pgm", ".pbm", ".pnm", ".tga"})
# COLMAP does not read these: listed too, so that a later step can name them in place of silently passing them over.
_OTHER_SUFFIXES = frozenset({".webp", ".gif", ".jp2", ".heic", ".heif", ".avif", ".jxl"})

# File systems allow 255; label maps are written as .<name>.png.<process>.partial.
_MAX_NAME_BYTES = 230
# Areas are found at a fixed width, at which a narrower strip is millions of pixels high.
_MAX_ASPECT = 50

# Pillow applies the orientation of TIFF files (and of no other format) when it decodes them: this undoes it.
_UPRIGHT_TO_STORED = {
    2: PillowImage.Transpose.FLIP_LEFT_RIGHT,
    3: PillowImage.Transpose.ROTATE_180,
    4: PillowImage.Transpose.FLIP_TOP_BOTTOM,
    5: PillowImage.Transpose.TRANSPOSE,
    6: PillowImage.Transpose.ROTATE_90,
    7: PillowImage.Transpose.TRANSVERSE,
    8: PillowImage.Transpose.ROTATE_270,
}
# Pillow spreads the values of grey PNGs of 2 and 4 bits over 0..255: right for images, wrong for ids.
_GREY_STEP = {"L;2": 85, "L;4": 17}
# Those of the suffixes above: Pillow knows many more, and runs an interpreter on some (EPS).
_FORMATS = ("JPEG", "PNG", "BMP", "TIFF", "PPM", "TGA", "WEBP", "GIF", "JPEG2000")
MAX_IMAGE_SIZE = 16384
"""Pixels of the longer side, beyond which an image is not decoded unless the user wants it: at most 0.8 GB of RGB."""
_MAX_BYTES_PER_PIXEL = 8  # of a file: 16 bits for each of four channels, not compressed
_MAX_METADATA = 2**26  # bytes of a file
_pillow_limit = threading.Lock()
# All that Pillow's decoders are known to raise on broken files.
_DECODE_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    zlib.error,
    PillowImage.DecompressionBombError,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageFile:
    """One image of a collection.

    name: POSIX path relative to the image folder, as in pairs.txt and in COLMAP. digest: SHA-256 of the file's bytes.
    """

    name: str
    path: Path
    width: int
    height: int
    digest: str


def list_images(folder: Path) -> tuple[tuple[str, ...], int]:
    """Names of the images in a folder and its sub-folders, sorted, and how many other files were passed over.

    Hidden files and folders (a leading dot) are neither listed nor counted. Links are followed; every folder is listed
    once, under its own name where it has one. A link that leads nowhere is listed, for a later step to name it.
    Raises: InputError when the folder is missing, cannot be read, or holds no image.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise InputError(f"image folder '{folder}' {what}; give the folder that holds the images")
    names: list[str] = []
    num_others = 0
    for path in _files(folder):
        if path.suffix.lower() in _COLMAP_SUFFIXES | _OTHER_SUFFIXES or _leads_nowhere(path):
            names.append(path.relative_to(folder).as_posix())
        else:
            num_others += 1
    if not names:
        raise InputError(
            f"image folder '{folder}' holds no image ({num_others} other files); expected jpg, png, tif, bmp or ppm"
        )
    return tuple(sorted(names)), num_others


def inspect_image(folder: Path, name: str, max_size: int = MAX_IMAGE_SIZE) -> ImageFile:
    """Decode an image once to know its size, that it is whole, and the digest of its content.

    Args: max_size: in pixels; an image with a longer side is refused before it is decoded.
    Raises: InputError when the file is missing, truncated, broken, too large, or of a kind that cannot be decoded, a
        strip, or its name is too long or cannot be written to a database and a log.
    """
    if printable(name) != name:
        raise InputError(
            f"image '{printable(name)}' has a character in its name that cannot be used (a control character, or bytes "
            "that are not UTF-8); rename it"
        )
    length = len(os.fsencode(Path(name).name))
    if length > _MAX_NAME_BYTES:
        raise InputError(
            f"image '{name}' has a file name of {length} bytes; expected at most {_MAX_NAME_BYTES}, since its label "
            "map gets a longer one: rename it"
        )
    path = folder / name
    if _leads_nowhere(path):
        raise InputError(
            f"image '{name}' is a link to '{path.readlink()}', where there is no file; set the link again or remove it"
        )
    if os.path.exists(path) and not os.path.isfile(path):  # a pipe would be waited for
        raise InputError(f"image '{name}' is not a regular file but a folder, pipe or device; remove it")
    try:
        if path.stat().st_size > _MAX_BYTES_PER_PIXEL * max_size**2 + _MAX_METADATA:
            raise InputError(
                f"image '{name}' is a file of {path.stat().st_size / 1e9:.1f} GB, more than any image of "
                f"--max-image-size {max_size} has; remove it, or raise --max-image-size"
            )
        data = path.read_bytes()
    except OSError as error:
        remedy = "its permissions" if isinstance(error, PermissionError) else "the name"
        raise InputError(f"image '{name}' cannot be read from '{folder}' ({_reason(error)}); check {remedy}") from error
    height, width = _rgb(_decode(data, name, max_size), name).shape[:2]
    if max(height, width) > _MAX_ASPECT * min(height, width):
        raise InputError(
            f"image '{name}' is {width}x{height} (width x height), a strip more than {_MAX_ASPECT} times as long as "
            "wide; crop it, or remove it"
        )
    return ImageFile(name=name, path=path, width=width, height=height, digest=hashlib.sha256(data).hexdigest())


def image_format(path: Path) -> str:
    """The format of an image that has been decoded, whatever its name says: JPEG, PNG, WEBP, ..."""
    return str(_decode(_read(path, "image"), path.name).info["format"])


def printable(name: str) -> str:
    """A file name with the characters escaped that cannot be written to a log or a database."""
    return "".join(repr(c)[1:-1] if unicodedata.category(c) in ("Cc", "Cs") else c for c in name)


def read_image(file: ImageFile | Path, max_size: int = MAX_IMAGE_SIZE) -> UInt8[np.ndarray, "H W 3"]:
    """The pixels of an image, RGB; grey is repeated, alpha dropped, 16 bits reduced to 8.

    Args: max_size: of an image that has not been inspected.
    Raises: InputError when the file is missing, truncated, broken, too large, or of a kind that cannot be decoded.
    """
    if isinstance(file, ImageFile):
        return _rgb(_decode(_read(file.path, "image"), file.name, max(file.width, file.height)), file.name)
    return _rgb(_decode(_read(file, "image"), file.name, max_size), file.name)


def read_mask(mask_folder: Path, image: ImageFile) -> Bool[np.ndarray, "H W"] | None:
    """The mask of an image, see `read_mask_of_any_size`.

    Raises: InputError when the mask is broken or of another size than the image.
    """
    mask = read_mask_of_any_size(mask_folder, image.name, max(image.width, image.height, MAX_IMAGE_SIZE))
    if mask is not None and mask.shape != (image.height, image.width):
        raise InputError(
            f"mask of '{image.name}' is {mask.shape[0]}x{mask.shape[1]} but the image is "
            f"{image.height}x{image.width} (height x width); make it again from this image"
        )
    return mask


def read_mask_of_any_size(mask_folder: Path, name: str, max_size: int = sys.maxsize) -> Bool[np.ndarray, "H W"] | None:
    """The mask of an image by COLMAP's convention: `<name>.png` (a PNG may keep its own name), where 0 = ignore.

    Returns: (H, W), True where matches are wanted; None when the image has no mask.
    Raises: InputError when the mask is broken, or has a side of more than `max_size` pixels.
    """
    path = mask_folder / f"{name}.png"
    if not path.exists() and name.lower().endswith(".png"):
        path = mask_folder / name
    if not path.exists():
        return None
    picture = _decode(_read(path, "mask"), str(path), max_size)
    one_channel = picture.mode in ("1", "L", "I", "F") or picture.mode.startswith("I;16")
    return np.asarray(picture if one_channel else picture.convert("L")) != 0


def read_label_map(path: Path, max_size: int = MAX_IMAGE_SIZE) -> Int32[np.ndarray, "H W"]:
    """The ids of a label map: a PNG of one channel, 8 or 16 bits; of a palette PNG the indices, not the colours.

    Args: max_size: in pixels; a map with a longer side is refused.
    Raises: InputError when the file is missing, broken or too large, or holds colours in place of ids.
    """
    picture = _decode(_read(path, "label map"), str(path), max_size)
    if not (picture.mode in ("1", "L", "P", "I") or picture.mode.startswith("I;16")):
        raise InputError(
            f"label map '{path}' has the colours of a picture (mode {picture.mode}); expected one channel of ids, "
            "8 or 16 bits or a palette; export the ids, or name the JSON of panoptic maps by --label-names"
        )
    return np.asarray(picture).astype(np.int32) // picture.info.get("grey_step", 1)


def read_segments(path: Path, max_size: int = MAX_IMAGE_SIZE) -> Int32[np.ndarray, "H W"]:
    """The segment ids of a panoptic PNG as COCO writes them: red + 256 green + 65536 blue.

    Args: max_size: in pixels; a map with a longer side is refused.
    Raises: InputError when the file is missing, broken or too large, or has no colours.
    """
    picture = _decode(_read(path, "label map"), str(path), max_size)
    if picture.mode not in ("RGB", "RGBA"):
        raise InputError(
            f"label map '{path}' has one channel (mode {picture.mode}); expected a panoptic PNG with ids as red + 256 "
            "green + 65536 blue; leave --label-names out for a map of ids"
        )
    red, green, blue = np.moveaxis(np.asarray(picture.convert("RGB")).astype(np.int32), 2, 0)
    return red + 256 * green + 65536 * blue


def _files(root: Path) -> Iterator[Path]:
    """The files of a folder and its sub-folders, without hidden ones; linked folders come after real ones."""
    folders, links = [root], list[Path]()
    seen = {*root.resolve().parents}  # a link to one of these leads back here
    while folders or links:
        folder = folders.pop() if folders else links.pop(0)
        if folder.resolve() in seen:
            continue
        seen.add(folder.resolve())
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        except OSError as error:
            raise InputError(f"folder '{folder}' cannot be read ({_reason(error)}); check its permissions") from error
        for entry in entries:
            path = folder / entry.name
            if entry.name.startswith("."):
                continue
            if not os.path.isdir(path):  # unlike pathlib's, False where access is denied
                yield path
            elif entry.is_symlink():
                links.append(path)
            else:
                folders.append(path)


def _leads_nowhere(path: Path) -> bool:
    return os.path.islink(path) and not os.path.exists(path)


def _read(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{what} '{path}' cannot be read ({_reason(error)}); check the name") from error


def _decode(data: bytes, name: str, max_size: int = MAX_IMAGE_SIZE) -> PillowImage.Image:
    """The first picture of a file; `info` keeps its format, and what its values are to be divided by to be ids."""
    if not data:
        raise InputError(f"'{name}' is empty (0 bytes); copy it again from its source, or remove it")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about broken metadata and many pixels: neither matters here
            picture = _header(data)
            if max(picture.size) > max_size:
                raise InputError(
                    f"'{name}' is {picture.width}x{picture.height} pixels (width x height) and was not decoded; make "
                    f"it smaller, or raise --max-image-size, which is {max_size}"
                )
            kind = picture.format
            grey_step = _GREY_STEP.get(_raw_mode(picture), 1)
            orientation = picture.getexif().get(ExifTags.Base.Orientation) if kind == "TIFF" else None
            picture.load()
    except MemoryError as error:
        raise InputError(f"'{name}' does not fit into memory; make it smaller, or lower --max-image-size") from error
    except _DECODE_ERRORS as error:
        if any(mark in data[:1024].lower() for mark in (b"<!doctype html", b"<html")):
            raise InputError(
                f"'{name}' is a web page and not an image, so its download failed; download it again, or remove it"
            ) from error
        raise InputError(
            f"'{name}' cannot be decoded ({_reason(error)}); copy it again from its source, convert it to JPEG or PNG, "
            "or remove it"
        ) from error
    if orientation in _UPRIGHT_TO_STORED:
        picture = picture.transpose(_UPRIGHT_TO_STORED[orientation])
    picture.info |= {"grey_step": grey_step, "format": kind}
    return picture


def _header(data: bytes) -> PillowImage.Image:
    """A picture that is not decoded yet, of any size: ours is the limit, and Pillow's has no other place."""
    with _pillow_limit:
        limit, PillowImage.MAX_IMAGE_PIXELS = PillowImage.MAX_IMAGE_PIXELS, None
        try:
            return PillowImage.open(io.BytesIO(data), formats=_FORMATS)
        finally:
            PillowImage.MAX_IMAGE_PIXELS = limit


def _raw_mode(picture: PillowImage.Image) -> str:
    """How a PNG stores its pixels, known only until it is decoded."""
    tiles = getattr(picture, "tile", [])
    return str(tiles[0].args) if picture.format == "PNG" and tiles else ""


def _rgb(picture: PillowImage.Image, name: str) -> UInt8[np.ndarray, "H W 3"]:
    if picture.mode == "I" or picture.mode.startswith("I;16"):
        grey = np.asarray(picture).astype(np.int64)
        if grey.min() >= 0 and grey.max() <= 65535:
            return np.repeat(((grey + 128) // 257).astype(np.uint8)[:, :, None], 3, axis=2)
    if picture.mode in ("I", "F"):
        raise InputError(f"'{name}' has 32-bit pixels; expected 8 or 16 bits a channel: convert it to PNG")
    if picture.mode in ("P", "PA"):
        picture = picture.convert("RGBA")
    try:
        return np.array(picture if picture.mode == "RGB" else picture.convert("RGB"))  # which copies any picture
    except ValueError as error:
        raise InputError(f"'{name}' has the colour mode {picture.mode}; convert it to RGB, as JPEG or PNG") from error


def _reason(error: BaseException) -> str:
    """One line for an exception of a library, without addresses of objects or paths named elsewhere."""
    if isinstance(error, UnidentifiedImageError):
        return "not an image of a known format"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__
