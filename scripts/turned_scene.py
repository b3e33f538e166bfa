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
from PIL import Image


def main() -> None:
    """Cut and turn the photos, write them with their cameras."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--degrees", type=float, default=45.0, help="anticlockwise, of every other photo")
    arguments = parser.parse_args()
    folders = [arguments.out / name for name in ("images", "gt_dense_cameras")]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(sorted((arguments.scene / "gt_dense_cameras").glob("*.camera"))):
        values = np.loadtxt(path.read_text().split())
        K, camera_to_world, size = values[:9].reshape(3, 3), values[12:21].reshape(3, 3), values[24:]
        name = path.name.removesuffix(".camera")
        pixels = np.asarray(Image.open(arguments.scene / "images" / name))
        cut, turn = turned_camera(K, size, arguments.degrees if number % 2 else 0.0)
        width, height = (int(2 * center + 1) for center in cut[:2, 2])
        affine = (cut @ turn @ np.linalg.inv(K))[:2]
        turned = cv2.warpAffine(pixels, affine, (width, height), flags=cv2.INTER_CUBIC)
        Image.fromarray(turned).save(folders[0] / name, quality=98)
        rows = [*cut, np.zeros(3), *(camera_to_world @ turn.T), values[21:24], np.array([width, height])]
        lines = [" ".join(f"{value:.10g}" for value in row) for row in rows]
        (folders[1] / path.name).write_text("\n".join(lines) + "\n")
    np.savetxt(folders[0] / "K.txt", cut)  # one camera took them all


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
