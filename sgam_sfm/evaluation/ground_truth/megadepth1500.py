"""MegaDepth1500: LoFTR's test pairs of scenes 0015 and 0022.

The folder holds the pair lists `0015_0.1_0.3.npz` ... (here or in `megadepth_test_1500_scene_info`, with
megadepth_test_1500.txt for their order) and `Undistorted_SfM`, whose images they name. A list has image_paths,
depth_paths, intrinsics (3, 3) and poses (4, 4) world-to-camera by image, and pair_infos ((i, j), overlap, matches).
K: from COLMAP, corner origin, of the undistorted image at its own size. The unit is that of each scene's model.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.npz_objects import read_npz
from sgam_sfm.evaluation.ground_truth.reading import DepthFile, camera_matrix, image_size, rigid, text_lines
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.pairs import Pair

_LISTS = "[0-9][0-9][0-9][0-9]_*.npz"


def _folder(path: Path) -> Path | None:
    folders = (path, path / "megadepth_test_1500_scene_info", path / "scene_info")
    return next((folder for folder in folders if any(folder.glob(_LISTS))), None)


def _lists(folder: Path) -> list[Path]:
    order = folder / "megadepth_test_1500.txt"
    if order.is_file():
        return [folder / line for _, line in text_lines(order) if line]
    return sorted(folder.glob(_LISTS))


def _read(path: Path, images: Path | None) -> GroundTruth:
    if (folder := _folder(path)) is None:
        raise InputError(f"{path} has no list such as 0015_0.1_0.3.npz; expected {FORMAT.expects}")
    views: dict[str, TrueView] = {}
    depths: dict[str, DepthFile] = {}
    pairs: dict[Pair, None] = {}
    for file in _lists(folder):
        data = read_npz(file, "pair_infos", "image_paths", "intrinsics", "poses", "depth_paths")
        if missing := {"image_paths", "intrinsics", "poses"} - {*data}:
            raise InputError(f"'{file}' has no array '{min(missing)}'; expected image_paths, intrinsics and poses")
        try:
            rows = [(int(info[0][0]), int(info[0][1])) for info in data["pair_infos"]]
        except (TypeError, ValueError, IndexError) as error:
            raise InputError(f"'{file}': pair_infos are not rows of ((i, j), overlap, matches)") from error
        for i, j in rows:
            name0, name1 = (_add(index, data, file, images or path, views, depths) for index in (i, j))
            pairs[name0, name1] = None
    return GroundTruth(
        source=path, format="megadepth1500", views=views, pairs=tuple(pairs), depth_files=depths, unit="unknown"
    )


def _add(
    index: int,
    data: dict[str, Any],
    file: Path,
    root: Path,
    views: dict[str, TrueView],
    depths: dict[str, DepthFile],
) -> str:
    """The name of an image of the list, which is added where it is new."""
    where = f"'{file}', image {index}"
    if not 0 <= index < len(data["image_paths"]):
        raise InputError(f"{where}: the list has {len(data['image_paths'])} images")
    name = str(data["image_paths"][index])
    if name not in views:
        width, height = image_size(root / name, where)
        views[name] = TrueView(
            name=name,
            width=width,
            height=height,
            camera_matrix=camera_matrix(data["intrinsics"][index], where),
            cam_from_world=rigid(data["poses"][index], where),
        )
        if "depth_paths" in data and (depth := root / str(data["depth_paths"][index])).is_file():
            depths[name] = DepthFile(path=depth)
    return name


FORMAT = Format(
    name="megadepth1500",
    expects="a folder with LoFTR's lists 0015_0.1_0.3.npz ... and Undistorted_SfM",
    detects=lambda path: _folder(path) is not None,
    read=_read,
    place="outdoor",
)
