"""ScanNet1500: the 1,500 test pairs of SuperGlue as LoFTR publishes them, and the scenes they come from.

The folder holds test.npz (name: (1500, 4) scene, scan, frame 0, frame 1; rel_pose: (1500, 12) cam1_from_cam0, optional)
and the scenes, `scene0707_00/color/15.jpg` and so on, beside it or in `scannet_test_1500` or `scans_test`. A scene has
the layout of the format `scannet`; where its intrinsics are missing, intrinsics.npz (K of 640x480 images, by scene)
serves. Names are relative to the folder of the scenes. K: as for `scannet`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth import reading
from sgam_sfm.evaluation.ground_truth.npz_objects import read_npz
from sgam_sfm.evaluation.ground_truth.scannet import read_scene
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.pairs import Pair


def _list_file(path: Path, name: str) -> Path | None:
    return reading.first_existing(*(folder / name for folder in (path, path / "assets", path / "scannet_test_1500")))


def _read(path: Path, images: Path | None) -> GroundTruth:
    if (list_file := _list_file(path, "test.npz")) is None:
        raise InputError(f"{path} has no test.npz; expected {FORMAT.expects}")
    lists = read_npz(list_file, "name", "rel_pose")
    names = lists["name"]
    if names.ndim != 2 or names.shape[1] != 4 or names.dtype.kind not in "iu":
        raise InputError(f"'{list_file}': 'name' is {names.dtype} {names.shape}; expected whole numbers (pairs, 4)")
    root = images or _scenes(path, f"scene{names[0][0]:04d}_{names[0][1]:02d}")
    pairs = [
        (f"scene{scene:04d}_{scan:02d}/color/{frame0}.jpg", f"scene{scene:04d}_{scan:02d}/color/{frame1}.jpg")
        for scene, scan, frame0, frame1 in names.tolist()
    ]
    truths = [_scene(path, root / folder, pairs) for folder in sorted({pair[0].partition("/")[0] for pair in pairs})]
    views = {name: view for truth in truths for name, view in truth.views.items()}
    if missing := sorted({name for pair in pairs for name in pair} - {*views}):
        raise InputError(f"{root} lacks {len(missing)} images of {list_file}, or their poses, such as '{missing[0]}'")
    rows = lists.get("rel_pose", np.zeros(0)).reshape(-1)
    if rows.size not in (0, 12 * len(pairs)):
        raise InputError(f"'{list_file}': {rows.size} numbers in 'rel_pose'; expected {len(pairs)} poses of 12")
    poses = [reading.rigid(row, f"'{list_file}', rel_pose {i}") for i, row in enumerate(rows.reshape(-1, 12))]
    return GroundTruth(
        source=path,
        format="scannet1500",
        views=views,
        pairs=tuple(dict.fromkeys(pairs)),
        relative_poses=dict(zip(pairs, poses, strict=False)),  # none of either where the list has none
        unit="metres",
        depth_files={name: file for truth in truths for name, file in truth.depth_files.items()},
        label_files={name: file for truth in truths for name, file in truth.label_files.items()},
    )


def _scenes(path: Path, scene: str) -> Path:
    folders = [path, path / "scannet_test_1500", path / "scans_test"]
    if (found := reading.first_existing(*(folder / scene for folder in folders))) is None:
        raise InputError(f"{path} has no scene '{scene}', nor have scannet_test_1500 and scans_test in it")
    return found.parent


def _scene(path: Path, folder: Path, pairs: list[Pair]) -> GroundTruth:
    names = sorted({name for pair in pairs for name in pair if name.startswith(f"{folder.name}/")})
    intrinsics = (folder / "intrinsic", folder / f"{folder.name}.txt")
    if reading.first_existing(*intrinsics) is not None and (folder / "pose").is_dir():
        return read_scene(folder, f"{folder.name}/color/", {Path(name).stem for name in names})
    if (file := _list_file(path, "intrinsics.npz")) is None:
        raise InputError(f"{folder} has no intrinsics, and {path} no intrinsics.npz; expected one of them")
    values = read_npz(file, folder.name)[folder.name]
    corner = values.reshape(4, 4)[:3, :3] if values.size == 16 else values
    K = reading.camera_matrix(corner, f"'{file}', {folder.name}", origin=0.5)
    views = {}
    for name in names:
        width, height = reading.image_size(folder.parent / name)
        scaled = reading.scaled(K, width / 640, height / 480)
        views[name] = TrueView(name=name, width=width, height=height, camera_matrix=scaled, cam_from_world=None)
    return GroundTruth(source=folder, format="scannet1500", views=views)


FORMAT = Format(
    name="scannet1500",
    expects="a folder with test.npz of ScanNet1500 and its scenes",
    detects=lambda path: _list_file(path, "test.npz") is not None,
    read=_read,
    place="indoor",
)
