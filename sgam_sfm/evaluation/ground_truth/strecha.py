"""Strecha's multi-view scenes (fountain-P11, Herz-Jesus-P8, castle-P19): `gt_dense_cameras/<image>.camera`.

A file holds K (9 numbers), 0 0 0, M (9), C (3), width and height. M is camera-to-world and C the centre, in metres of
the laser scan: R = M^T, t = -R C. K: whole numbers are pixel centres (0.5 is added); the files do not say so, see
docs/datasets.md for what was measured.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.reading import camera_matrix, read_numbers, rigid
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView

_EXPECTED = "K (9 numbers), 0 0 0, camera-to-world rotation (9), centre (3), width and height"


def _folder(path: Path) -> Path:
    return path / "gt_dense_cameras" if (path / "gt_dense_cameras").is_dir() else path


def _detects(path: Path) -> bool:
    return path.is_dir() and any(_folder(path).glob("*.camera"))


def _view(file: Path) -> TrueView:
    values = read_numbers(file, 26, _EXPECTED)
    M, centre, size = values[12:21].reshape(3, 3), values[21:24], values[24:]
    if (size < 1).any() or (size % 1).any():
        raise InputError(f"{file}: the image is {size[0]:g}x{size[1]:g}; expected whole pixels")
    return TrueView(
        name=file.name.removesuffix(".camera"),
        width=int(size[0]),
        height=int(size[1]),
        camera_matrix=camera_matrix(values[:9], str(file), origin=0.5),
        cam_from_world=rigid(np.column_stack([M.T, -M.T @ centre]), str(file)),
    )


def _read(path: Path, images: Path | None) -> GroundTruth:
    views = [_view(file) for file in sorted(_folder(path).glob("*.camera"))]
    return GroundTruth(source=path, format="strecha", views={view.name: view for view in views}, unit="metres")


FORMAT = Format(
    name="strecha",
    expects="a folder `gt_dense_cameras` with a file <image>.camera for each image",
    detects=_detects,
    read=_read,
    place="outdoor",
)
