"""MatterPort3D: the undistorted images, `<house>/undistorted_color_images/<image>.jpg`.

`<house>/undistorted_camera_parameters/<house>.conf` has a line `intrinsics_matrix` before the lines `scan <depth image>
<colour image> <camera-to-world, 16 numbers>` that it holds for, in metres. Its cameras look along -z with y up and its
pixels count from the bottom left: poses are turned by half a turn about x, and cy becomes height - cy. K: taken as
counted from the corner of the image, which the documentation does not say. Depth is in 1/4000 m. A list `pairs.txt` in
the folder, with names relative to it, is read where it is there; none is published.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth import reading
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.evaluation.projection import inverse
from sgam_sfm.pairs import read_pairs

_PER_METRE = 4000
_LAYOUTS = ("", "*/", "*/*/", "*/*/*/")  # the folder may be of a house, of the houses, or v1 above scans


def _conf_files(path: Path) -> list[Path]:
    patterns = (f"{layout}undistorted_camera_parameters/*.conf" for layout in _LAYOUTS)
    return next((found for pattern in patterns if (found := sorted(path.glob(pattern)))), [])


def _read_house(root: Path, file: Path, views: dict[str, TrueView], depths: dict[str, reading.DepthFile]) -> None:
    house = file.parents[1]
    K: np.ndarray | None = None
    height: int | None = None
    width = 0
    for number, line in reading.text_lines(file):
        where, tokens = f"{file}, line {number}", line.split()
        if tokens[:1] == ["intrinsics_matrix"]:
            values = reading.floats(tokens[1:], where, "intrinsics_matrix fx 0 cx 0 fy cy 0 0 1")
            if len(values) != 9:
                raise InputError(f"{where}: {len(values)} numbers; expected intrinsics_matrix fx 0 cx 0 fy cy 0 0 1")
            K = reading.camera_matrix(values, where)
        elif tokens[:1] == ["scan"]:
            if K is None or len(tokens) != 19:
                raise InputError(f"{where}: expected intrinsics_matrix before, and scan <depth> <colour> <16 numbers>")
            image = house / "undistorted_color_images" / tokens[2]
            if not image.is_file():
                continue
            if height is None:  # all images of the data set have one size
                width, height = reading.image_size(image)
            world_from_cam = reading.rigid(reading.floats(tokens[3:], where, "a camera-to-world matrix"), where)
            flipped = np.array([[1, 0, 0], [0, -1, height], [0, 0, 1]]) @ K @ np.diag([1.0, -1.0, 1.0])
            name = image.relative_to(root).as_posix()
            views[name] = TrueView(
                name=name,
                width=width,
                height=height,
                camera_matrix=flipped,
                cam_from_world=np.diag([1.0, -1.0, -1.0]) @ inverse(world_from_cam),
            )
            if (depth := house / "undistorted_depth_images" / tokens[1]).is_file():
                depths[name] = reading.DepthFile(path=depth, scale=1 / _PER_METRE)


def _read(path: Path, images: Path | None) -> GroundTruth:
    views: dict[str, TrueView] = {}
    depths: dict[str, reading.DepthFile] = {}
    for file in _conf_files(path):
        _read_house(path, file, views, depths)
    pairs = read_pairs(path / "pairs.txt", tuple(views)).pairs if (path / "pairs.txt").is_file() else None
    return GroundTruth(source=path, format="matterport3d", views=views, pairs=pairs, unit="metres", depth_files=depths)


FORMAT = Format(
    name="matterport3d",
    expects="MatterPort3D houses: <house>/undistorted_camera_parameters/<house>.conf and undistorted_color_images",
    detects=lambda path: path.is_dir() and bool(_conf_files(path)),
    read=_read,
    place="indoor",
)
