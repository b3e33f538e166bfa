"""KITTI-360: the left rectified camera, `data_2d_raw/<drive>/image_00/data_rect/<frame>.png`.

K is the corner of P_rect_00 in calibration/perspective.txt, of images of S_rect_00 pixels; poses are rectified
camera-to-world in data_poses/<drive>/cam0_to_world.txt, a frame number and 16 numbers a line, in metres; frames without
a line have no pose. Labels are data_2d_semantics/train/<drive>/image_00/semantic/<frame>.png. K: whole numbers are
taken to be pixel centres (0.5 is added), which the documentation does not say. A list `pairs.txt` in the folder, with
names relative to it, is read where it is there; none is published.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.reading import camera_matrix, floats, rigid, text_lines
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.evaluation.projection import inverse
from sgam_sfm.pairs import read_pairs


def _detects(path: Path) -> bool:
    return (path / "calibration" / "perspective.txt").is_file() and (path / "data_poses").is_dir()


def _calibration(path: Path) -> tuple[np.ndarray, int, int]:
    found = {}
    for number, line in text_lines(path):
        key, _, rest = line.partition(":")
        if key in ("P_rect_00", "S_rect_00"):
            found[key] = floats(rest.split(), f"{path}, line {number}", "P_rect_00 (12 numbers), S_rect_00 (2)")
    if len(found.get("P_rect_00", ())) != 12 or len(found.get("S_rect_00", ())) != 2:
        raise InputError(f"{path}: no P_rect_00 of 12 numbers and S_rect_00 of 2; expected both")
    P, (width, height) = found["P_rect_00"].reshape(3, 4), found["S_rect_00"]
    return camera_matrix(P[:, :3], f"{path}, P_rect_00", origin=0.5), int(width), int(height)


def _read(path: Path, images: Path | None) -> GroundTruth:
    K, width, height = _calibration(path / "calibration" / "perspective.txt")
    views, labels = {}, {}
    for file in sorted((path / "data_poses").glob("*/cam0_to_world.txt")):
        drive = file.parent.name
        for number, line in text_lines(file):
            where = f"{file}, line {number}"
            values = floats(line.split(), where, "a frame number and a camera-to-world matrix (16 numbers)")
            if not len(values):
                continue
            if len(values) != 17:
                raise InputError(f"{where}: {len(values)} numbers; expected a frame number and a 4 x 4 matrix")
            frame = f"{int(values[0]):010d}.png"
            name = f"data_2d_raw/{drive}/image_00/data_rect/{frame}"
            if not (path / name).is_file():
                continue
            views[name] = TrueView(
                name=name,
                width=width,
                height=height,
                camera_matrix=K,
                cam_from_world=inverse(rigid(values[1:], where)),
            )
            label = path / "data_2d_semantics" / "train" / drive / "image_00" / "semantic" / frame
            if label.is_file():
                labels[name] = label
    pairs = read_pairs(path / "pairs.txt", tuple(views)).pairs if (path / "pairs.txt").is_file() else None
    return GroundTruth(source=path, format="kitti360", views=views, pairs=pairs, unit="metres", label_files=labels)


FORMAT = Format(
    name="kitti360",
    expects="KITTI-360: calibration/perspective.txt, data_poses and data_2d_raw",
    detects=_detects,
    read=_read,
    place="outdoor",
)
