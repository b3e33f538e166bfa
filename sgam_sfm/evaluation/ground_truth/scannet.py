"""A scene of ScanNet, exported to folders: color, pose, intrinsic (or <scene>.txt), and depth and labels where present.

pose/<frame>.txt is camera-to-world in metres (frames whose tracking was lost hold -inf and are left out); depth is in
1/1000 m. K: whole numbers are pixel centres (0.5 is added), by which ScanNet's own principal points of colour and depth
are related. The colour K is of 1296x968 images and is scaled to smaller ones; colour and depth cameras are registered,
so the depth map shows the image at another resolution. Names are those of the files in `color`.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth import reading
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.evaluation.projection import inverse

logger = logging.getLogger(__name__)

COLOUR_SIZE = (1296, 968)
_KEYS = ("m_calibrationColorIntrinsic", "m_colorWidth", "m_colorHeight", "m_depthShift")


def read_scene(folder: Path, prefix: str = "", stems: set[str] | None = None) -> GroundTruth:
    """One scene. prefix: put before the names. stems: the frames that are wanted, None for all."""
    files = sorted(file for file in folder.glob("color/*") if file.suffix.lower() in (".jpg", ".png", ".jpeg"))
    K, k_size, shift = _intrinsics(folder)
    views, depths, labels, lost = {}, {}, {}, 0
    for file in files:
        pose_file = folder / "pose" / f"{file.stem}.txt"
        if (stems is not None and file.stem not in stems) or not pose_file.exists():
            continue
        world_from_cam = reading.read_numbers(pose_file, 16, "a camera-to-world matrix of 4 x 4", finite=False)
        if np.isneginf(world_from_cam).any():
            lost += 1
            continue
        name, (width, height) = prefix + file.name, reading.image_size(file)
        # intrinsic_color.txt does not say its image size: that of the principal point's middle is its own.
        own = k_size is None and abs(2 * K[0, 2] / width - 1) < 0.1
        k_width, k_height = (width, height) if own else k_size or COLOUR_SIZE
        views[name] = TrueView(
            name=name,
            width=width,
            height=height,
            camera_matrix=reading.scaled(K, width / k_width, height / k_height),
            cam_from_world=inverse(reading.rigid(world_from_cam, str(pose_file))),
        )
        if found := reading.first_existing(*(folder / "depth" / f"{file.stem}{suffix}" for suffix in (".png", ".pgm"))):
            depths[name] = reading.DepthFile(path=found, scale=1 / shift)
        if found := reading.first_existing(*(folder / kind / f"{file.stem}.png" for kind in ("label-filt", "label"))):
            labels[name] = found
    if lost:
        logger.warning("%s: %d frames without a pose (tracking was lost) are left out", folder, lost)
    return GroundTruth(
        source=folder, format="scannet", views=views, unit="metres", depth_files=depths, label_files=labels
    )


def _intrinsics(folder: Path) -> tuple[np.ndarray, tuple[int, int] | None, float]:
    """K with corner origin, the image size it belongs to where the file says so, and depth values per metre."""
    path = folder / "intrinsic" / "intrinsic_color.txt"
    if path.exists():
        values = reading.read_numbers(path, 16, "a 4 x 4 matrix with K in its corner")
        return reading.camera_matrix(values.reshape(4, 4)[:3, :3], str(path), origin=0.5), None, 1000.0
    path = folder / f"{folder.resolve().name}.txt"
    if not path.exists():
        raise InputError(f"{folder} has neither intrinsic/intrinsic_color.txt nor {path.name}; expected one of them")
    pairs = ((n, *line.partition("=")[::2]) for n, line in reading.text_lines(path))
    found = {
        key.strip(): reading.floats(value.split(), f"{path}, line {n}", "numbers")
        for n, key, value in pairs
        if key.strip() in _KEYS
    }
    if missing := [key for key in _KEYS[:3] if key not in found] or [key for key in _KEYS[:1] if len(found[key]) != 16]:
        raise InputError(f"{path}: no usable {missing[0]}; expected {_KEYS[0]} (16 numbers), {_KEYS[1]} and {_KEYS[2]}")
    K = reading.camera_matrix(found[_KEYS[0]].reshape(4, 4)[:3, :3], str(path), origin=0.5)
    return K, (int(found[_KEYS[1]][0]), int(found[_KEYS[2]][0])), float(found.get(_KEYS[3], np.array([1000.0]))[0])


FORMAT = Format(
    name="scannet",
    expects="a ScanNet scene: folders `color` and `pose`, and `intrinsic` or <scene>.txt",
    detects=lambda path: (path / "color").is_dir() and (path / "pose").is_dir(),
    read=lambda path, images: read_scene(path),
    place="indoor",
)
