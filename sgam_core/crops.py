"""From a box to the crop that a point matcher sees, and back (paper, appendix, Area Size)."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float

from sgam_core.options import CropOptions
from sgam_core.types import Box, Crop, Image, WarpedCrop


def whole_crop(image: Image, options: CropOptions) -> Crop:
    """The whole image, its long side at most `image_size`."""
    window = Box(x0=0, y0=0, x1=image.width, y1=image.height)
    return _crop(image, window, options.image_size, options.max_whole_upsampling)


def area_crop(image: Image, box: Box, options: CropOptions) -> Crop:
    """A square about the box, `expand` times its long side, shifted into the image and cut where it does not fit."""
    side = options.expand * max(box.width, box.height)
    x, y = box.center
    x0, x1 = _window(x, side, image.width)
    y0, y1 = _window(y, side, image.height)
    return _crop(image, Box(x0=x0, y0=y0, x1=x1, y1=y1), options.area_size, options.max_upsampling)


def box_crop(image: Image, box: Box, long_side: int, max_upsampling: float) -> Crop:
    """The box itself, out to whole pixels of the image, its long side at most `long_side`.

    Args: max_upsampling: as in `CropOptions`.
    """
    x0, x1 = whole_pixels(box.x0, box.x1, image.width)
    y0, y1 = whole_pixels(box.y0, box.y1, image.height)
    return _crop(image, Box(x0=x0, y0=y0, x1=x1, y1=y1), long_side, max_upsampling)


def warped_alike(crop0: Crop, crop1: Crop, image1_from_image0: Float[np.ndarray, "2 3"]) -> tuple[Crop, Crop]:
    """Two crops, of which the one that shows things larger is warped so that they look as in the other one.

    Args: image1_from_image0: (2, 3), the affine map between the two images that things follow here.
    Returns: both of one size, that of the crop that stays. The other one is cut anew, where the first one lies in it.
    """
    if crop1.scale * abs(np.linalg.det(image1_from_image0[:, :2])) ** 0.5 >= crop0.scale:
        return crop0, _warped(crop1, crop0, image1_from_image0)
    return _warped(crop0, crop1, cv2.invertAffineTransform(image1_from_image0)), crop1


def _warped(crop: Crop, other: Crop, affine: Float[np.ndarray, "2 3"]) -> Crop:
    """The crop as the other one shows things. Args: affine: from the other image to this one."""
    width, height = other.size
    corners = np.array([(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)])
    corners = other.to_image(corners) @ affine[:, :2].T + affine[:, 2]
    origin = corners[0]
    axes = (corners[1:3] - origin) / np.array([[width], [height]])
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
    x0, x1 = whole_pixels(left, right, crop.image.width)
    y0, y1 = whole_pixels(top, bottom, crop.image.height)
    return WarpedCrop(
        image=crop.image,
        window=Box(x0=x0, y0=y0, x1=x1, y1=y1),
        size=other.size,
        image_from_crop=tuple(np.column_stack([*axes, origin]).ravel().tolist()),
    )


def whole_pixels(start: float, stop: float, length: int) -> tuple[int, int]:
    """The whole pixels [first, last) that [start, stop) touches, at least one, inside [0, length)."""
    first = min(max(math.floor(start), 0), length - 1)
    return first, max(min(math.ceil(stop), length), first + 1)


def _window(center: float, side: float, length: int) -> tuple[int, int]:
    """Whole pixels [start, stop) of about `side`, centred where possible, inside [0, length)."""
    extent = min(max(round(side), 1), length)
    start = min(max(math.floor(center - extent / 2), 0), length - extent)
    return start, start + extent


def _crop(image: Image, window: Box, long_side: int, max_upsampling: float) -> Crop:
    scale = min(long_side / max(window.width, window.height), max_upsampling or math.inf)
    return Crop(
        image=image,
        window=window,
        size=(max(round(window.width * scale), 1), max(round(window.height * scale), 1)),
    )
