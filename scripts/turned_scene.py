"""A scene whose every other photo was taken with the camera turned about its axis.

    python scripts/turned_scene.py SCENE OUT --degrees 45

SCENE: a Strecha folder (images/, images/K.txt, gt_dense_cameras/). Writes another one to OUT, for `evaluate_gain.py` or
`sgam-sfm compare`. All photos are cut to the largest size that whatever angle leaves, about half as wide and high, so
that scenes of several angles show the same things.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from scenes import strecha_views


def main() -> None:
    """Cut and turn the photos, write them with their cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--degrees", type=float, default=45.0, help="anticlockwise, of every other photo")
    arguments = parser.parse_args()
    for number, view in enumerate(strecha_views(arguments.scene)):
        size = np.array(view.pixels.shape[1::-1])
        cut, turn = turned_camera(view.K, size, arguments.degrees if number % 2 else 0.0)
        width, height = (int(2 * center + 1) for center in cut[:2, 2])
        affine = (cut @ turn @ np.linalg.inv(view.K))[:2]
        turned = cv2.warpAffine(view.pixels, affine, (width, height), flags=cv2.INTER_CUBIC)
        view.seen(turned, cut, turn).write(arguments.out)


def turned_camera(K: np.ndarray, size: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The camera matrix of a cut photo, whole numbers are pixel centres, and its rotation from the camera before.

    The cut is centred on the principal point, about which the photo is turned anticlockwise. It has the photo's aspect,
    and its corners are as far from there as the photo's nearest edge is.
    """
    radius = min(*K[:2, 2], *(size - 1 - K[:2, 2])) * 0.99  # the two focal lengths differ a little
    half = np.floor(radius * size / np.linalg.norm(size))
    cut = np.array([[K[0, 0], 0.0, half[0]], [0.0, K[1, 1], half[1]], [0.0, 0.0, 1.0]])
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return cut, np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])


if __name__ == "__main__":
    main()
