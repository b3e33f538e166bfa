"""The Image Matching Benchmark's scenes (phototourism), and OANet's of YFCC100M: an h5 file an image with K, R, T.

`calibration/calibration_<image>.h5` and `images/<image>.jpg`; OANet numbers its calibrations and lists both sides, line
by line, in images.txt and calibration.txt. R, T are world-to-camera in an unknown unit. K of the benchmark comes from
COLMAP and has corner origin; OANet's (with `imsize`) counts from the middle of the image, from where it is moved.
Depth (`depth_maps/<image>.h5`) is read where it is there.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth import reading
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView

_SHAPES = {"K": 9, "R": 9, "T": 3}


def _detects(path: Path) -> bool:
    return (path / "images").is_dir() and any((path / "calibration").glob("*.h5"))


def read_view(file: Path, image: Path, name: str) -> TrueView:
    """An image of either kind; raises InputError when the file is not complete."""
    values = reading.read_h5(file, "K", "R", "T", "imsize")
    for key, count in _SHAPES.items():
        if values.get(key, np.zeros(0)).size != count:
            raise InputError(f"'{file}' has no '{key}' of {count} numbers; expected K (3, 3), R (3, 3) and T (3)")
    size = values["imsize"].ravel() if values.get("imsize", np.zeros(0)).size == 2 else reading.image_size(image)
    width, height = map(int, size)
    K = reading.camera_matrix(values["K"], str(file))
    if abs(K[0, 2]) < width / 4 and abs(K[1, 2]) < height / 4:  # counted from the middle: no camera is built like that
        K[:2, 2] += [width / 2, height / 2]
    pose = reading.rigid(np.column_stack([values["R"].reshape(3, 3), values["T"].ravel()]), str(file))
    return TrueView(name=name, width=width, height=height, camera_matrix=K, cam_from_world=pose)


def _files(path: Path, images: Path) -> list[tuple[Path, Path]]:
    """Calibration and image, for each image."""
    lists = (path / "calibration.txt", path / "images.txt")
    if all(file.is_file() for file in lists):
        left, right = ([path / line for _, line in reading.text_lines(file) if line] for file in lists)
        if len(left) != len(right):
            raise InputError(f"{lists[0]} has {len(left)} lines and {lists[1].name} {len(right)}; expected as many")
        return list(zip(left, right, strict=True))
    found = []
    for file in sorted((path / "calibration").glob("*.h5")):
        stem = file.stem.removeprefix("calibration_")
        if image := reading.first_existing(
            *(images / f"{stem}{suffix}" for suffix in (".jpg", ".png", ".jpeg", ".JPG"))
        ):
            found.append((file, image))
    return found


def _read(path: Path, images: Path | None) -> GroundTruth:
    folder = images or path / "images"
    views, depths = {}, {}
    for file, image in _files(path, folder):
        view = read_view(file, image, image.name)
        views[view.name] = view
        if (depth := path / "depth_maps" / f"{image.stem}.h5").exists():
            depths[view.name] = reading.DepthFile(path=depth)
    return GroundTruth(source=path, format="image-matching-benchmark", views=views, depth_files=depths)


FORMAT = Format(
    name="image-matching-benchmark",
    expects="a scene with `images` and `calibration/calibration_<image>.h5` (K, R, T)",
    detects=_detects,
    read=_read,
    place="outdoor",
)
