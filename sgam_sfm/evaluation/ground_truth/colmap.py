"""A COLMAP model, text or binary: cameras and images; points and rigs are not read.

Poses are world-to-camera in the model's own unit, K has corner origin already. Pinhole models and those that OpenCV's
distortion covers are understood; fisheye lenses are not.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sgam_core.errors import InputError
from sgam_sfm.evaluation import colmap_model
from sgam_sfm.evaluation.colmap_model import CAMERA_MODELS, Camera, Image
from sgam_sfm.evaluation.ground_truth.reading import camera_matrix, rigid
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView


def _folder(path: Path) -> Path | None:
    for folder in (path, path / "sparse" / "0", path / "sparse", path / "0"):
        if any(
            all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")) for suffix in (".bin", ".txt")
        ):
            return folder
    return None


def _camera(path: Path, camera: Camera) -> tuple[int, int, np.ndarray, tuple[float, ...]]:
    name, width, height, params = camera
    found = next((model for model in CAMERA_MODELS.values() if model[0] == name), None)
    if found is None:
        raise colmap_model.unsupported(path, name)
    _, focals, distortions = found
    if len(params) != focals + 2 + distortions:
        raise InputError(f"{path}: {len(params)} parameters of {name}; expected {focals + 2 + distortions}")
    cx, cy, *rest = params[focals:]
    K = camera_matrix(np.array([params[0], 0, cx, 0, params[focals - 1], cy, 0, 0, 1]), str(path))
    return width, height, K, tuple(map(float, [*rest, 0, 0, 0][: max(4, distortions)])) if any(rest) else ()


def _view(image: Image, cameras: dict[int, tuple[int, int, np.ndarray, tuple[float, ...]]]) -> TrueView:
    where, name, camera_id, numbers = image
    if camera_id not in cameras:
        raise InputError(f"{where}: camera {camera_id} of '{name}' is not among the cameras")
    if not abs(np.linalg.norm(numbers[:4]) - 1) <= 1e-3:  # NaN too
        raise InputError(
            f"{where}: the quaternion of '{name}' has length {np.linalg.norm(numbers[:4]):.4g}; expected 1"
        )
    width, height, K, distortion = cameras[camera_id]
    R = Rotation.from_quat(numbers[[1, 2, 3, 0]]).as_matrix()
    pose = rigid(np.column_stack([R, numbers[4:]]), where)
    return TrueView(name=name, width=width, height=height, camera_matrix=K, cam_from_world=pose, distortion=distortion)


def _read(path: Path, images: Path | None) -> GroundTruth:
    folder = _folder(path)
    if folder is None:
        raise InputError(f"{path} has no COLMAP model; expected {FORMAT.expects}")
    try:
        if (folder / "images.bin").is_file():
            file, source = folder / "images.bin", folder / "cameras.bin"
            cameras = dict(colmap_model.binary_cameras(source, source.read_bytes()))
            found = list(colmap_model.binary_images(file, file.read_bytes()))
        else:
            source, file = folder / "cameras.txt", folder / "images.txt"
            cameras, found = dict(colmap_model.text_cameras(source)), list(colmap_model.text_images(file))
    except (struct.error, ValueError, OSError) as error:
        raise InputError(f"the COLMAP model in {folder} is cut short or broken ({error})") from error
    pinholes = {camera_id: _camera(source, camera) for camera_id, camera in cameras.items()}
    views = [_view(image, pinholes) for image in found]
    return GroundTruth(source=path, format="colmap", views={view.name: view for view in views})


FORMAT = Format(
    name="colmap",
    expects="a folder with a COLMAP model, cameras and images as .bin or .txt (also in sparse/ or sparse/0/)",
    detects=lambda path: _folder(path) is not None,
    read=_read,
)
