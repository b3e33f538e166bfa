"""Scenes with ground truth, as options of `sgam-sfm`; the scripts beside this file share them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np


def scene_options(scene: Path) -> list[str]:
    """Photos, true cameras and ground truth of a Strecha or ScanNet scene.

    Args: scene: a folder with images/K.txt and gt_dense_cameras, or with color/, pose/ and intrinsics.
    """
    if not (scene / "gt_dense_cameras").is_dir():
        return ["--images", str(scene / "color"), "--ground-truth", str(scene)]
    K = np.loadtxt(scene / "images" / "K.txt").reshape(3, 3)
    params = ",".join(str(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    camera = ["--camera-model", "PINHOLE", "--camera-params", params, "--camera-mode", "single"]
    return ["--images", str(scene / "images"), "--ground-truth", str(scene / "gt_dense_cameras"), *camera]


def split_options(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments of a script before `--`, and those after it, which it passes on to `sgam-sfm`."""
    at = arguments.index("--") if "--" in arguments else len(arguments)
    return list(arguments[:at]), list(arguments[at + 1 :])
