"""Label maps over their images, every region with its number and name: what to ignore and what to mask is read here."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
from jaxtyping import Int32, UInt8

from sgam_sfm.pictures.canvas import limited, resized, tinted

_MIN_SHARE = 0.004  # of the picture: smaller regions have no number


def draw_labels(
    pixels: UInt8[np.ndarray, "H W 3"], labels: Int32[np.ndarray, "h w"], names: Mapping[int, str], long_side: int
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The image, shrunk to `long_side` pixels, tinted by label (0 stays clear), numbered where a region is widest."""
    size = limited((pixels.shape[1], pixels.shape[0]), long_side)
    small = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT)
    picture = PIL.Image.fromarray(tinted(resized(pixels, size), small, strength=0.4))
    draw = PIL.ImageDraw.Draw(picture)
    font = PIL.ImageFont.load_default(size=max(long_side // 50, 12))
    for label in np.unique(small[small > 0]):
        _, parts, stats, _ = cv2.connectedComponentsWithStats((small == label).astype(np.uint8))
        for part in range(1, len(stats)):
            if stats[part, cv2.CC_STAT_AREA] < _MIN_SHARE * small.size:
                continue
            region = cv2.copyMakeBorder((parts == part).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
            inside = cv2.distanceTransform(region, cv2.DIST_L2, 5)
            y, x = np.unravel_index(inside.argmax(), inside.shape)
            text = f"{label} {names.get(int(label), '')}".strip()
            draw.text((int(x), int(y)), text, "white", font, "mm", stroke_width=2, stroke_fill="black")
    return np.asarray(picture)
