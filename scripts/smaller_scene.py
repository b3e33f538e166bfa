"""A scene whose photos are smaller: as from a video or an old camera, with no resolution left to gain.

    python scripts/smaller_scene.py SCENE OUT --width 640

SCENE: a Strecha folder (images/, images/K.txt, gt_dense_cameras/). Writes another one to OUT, for `evaluate_gain.py`;
`sgam-sfm compare --hard scale=0.2` makes one of its own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from scenes import strecha_views


def main() -> None:
    """Resize the photos, write them with their cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=640, help="of the new photos, pixels")
    arguments = parser.parse_args()
    for view in strecha_views(arguments.scene):
        height, width = view.pixels.shape[:2]
        size = (arguments.width, round(height * arguments.width / width))
        sx, sy = size[0] / width, size[1] / height
        # The edges of the photo stay its edges; whole numbers are pixel centres.
        resize = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        small = cv2.resize(view.pixels, size, interpolation=cv2.INTER_AREA)
        view.seen(small, resize @ view.K).write(arguments.out)


if __name__ == "__main__":
    main()
