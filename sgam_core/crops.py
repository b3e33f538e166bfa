"""From a box to the crop that a point matcher sees, and back (paper, appendix, Area Size)."""

from __future__ import annotations

import math

from sgam_core.options import CropOptions
from sgam_core.types import Box, Crop, Image


def whole_crop(image: Image, options: CropOptions) -> Crop:
    """The whole image, its long side at most `image_size`."""
    return _crop(image, Box(x0=0, y0=0, x1=image.width, y1=image.height), options.image_size, upsample=False)


def area_crop(image: Image, box: Box, options: CropOptions) -> Crop:
    """A square about the box, `expand` times its long side, shifted into the image and cut where it does not fit."""
    side = options.expand * max(box.width, box.height)
    x, y = box.center
    x0, x1 = _window(x, side, image.width)
    y0, y1 = _window(y, side, image.height)
    return _crop(image, Box(x0=x0, y0=y0, x1=x1, y1=y1), options.area_size, upsample=options.upsample)


def box_crop(image: Image, box: Box, long_side: int, *, upsample: bool) -> Crop:
    """The box itself, out to whole pixels of the image, its long side at most `long_side` (with upsample: exactly)."""
    x0, x1 = whole_pixels(box.x0, box.x1, image.width)
    y0, y1 = whole_pixels(box.y0, box.y1, image.height)
    return _crop(image, Box(x0=x0, y0=y0, x1=x1, y1=y1), long_side, upsample=upsample)


def whole_pixels(start: float, stop: float, length: int) -> tuple[int, int]:
    """The whole pixels [first, last) that [start, stop) touches, at least one, inside [0, length)."""
    first = min(max(math.floor(start), 0), length - 1)
    return first, max(min(math.ceil(stop), length), first + 1)


def _window(center: float, side: float, length: int) -> tuple[int, int]:
    """Whole pixels [start, stop) of about `side`, centred where possible, inside [0, length)."""
    extent = min(max(round(side), 1), length)
    start = min(max(math.floor(center - extent / 2), 0), length - extent)
    return start, start + extent


def _crop(image: Image, window: Box, long_side: int, *, upsample: bool) -> Crop:
    scale = long_side / max(window.width, window.height)
    if not upsample:
        scale = min(scale, 1.0)
    return Crop(
        image=image,
        window=window,
        size=(max(round(window.width * scale), 1), max(round(window.height * scale), 1)),
    )
