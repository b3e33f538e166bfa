"""Readers of ground truth on tiny folders of each layout, written from one known scene in each format's convention."""

from __future__ import annotations

import logging
import os
import pickle
import zipfile
from pathlib import Path

import h5py
import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

from sgam_core.errors import InputError, OptionError
from sgam_sfm.evaluation.ground_truth import FORMATS, GroundTruth, TrueView, read_ground_truth
from sgam_sfm.evaluation.ground_truth.camera_table import HEADER
from sgam_sfm.evaluation.presets import PRESETS, frame_pairs
from sgam_sfm.evaluation.projection import inverse, relative_pose
from sgam_sfm.room.rendering import View
from sgam_sfm.scene import write_ground_truth

SIZE = (64, 48)
K = np.array([[60.0, 0, 33], [0, 61, 23], [0, 0, 1]])  # corner origin
CENTRE_0 = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # whole numbers are pixel centres
FLIP = np.diag([1.0, -1, -1])


def pose(*rotvec: float, t: tuple[float, float, float]) -> np.ndarray:
    return np.column_stack([Rotation.from_rotvec(rotvec, degrees=True).as_matrix(), t])


POSES = (pose(5, -20, 3, t=(0.1, 0.2, 2.0)), pose(-7, 15, 170, t=(1.0, -0.5, 3.0)))
RELATIVE = relative_pose(*POSES)


def square(p: np.ndarray) -> np.ndarray:
    return np.vstack([p, [0, 0, 0, 1]])


def words(values: np.ndarray) -> str:
    return " ".join(f"{value:.9f}" for value in np.ravel(values))


def image(path: Path, size: tuple[int, int] = SIZE) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    PIL.Image.new("RGB", size).save(path)


def depth_png(path: Path, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    PIL.Image.fromarray(np.full((24, 32), value, np.uint16)).save(path)


def write(path: Path, content: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def h5(path: Path, **values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for key, value in values.items():
            file[key] = value


def check(truth: GroundTruth, names: tuple[str, str], camera: np.ndarray = K, poses=POSES) -> None:
    assert tuple(sorted(truth.views)) == tuple(sorted(names))
    for name, p in zip(names, poses, strict=True):
        view = truth.views[name]
        assert view.name == name
        assert (view.width, view.height) == SIZE
        np.testing.assert_allclose(view.camera_matrix, camera, atol=1e-6)
        if p is None:
            assert view.cam_from_world is None
        else:
            assert view.cam_from_world is not None
            np.testing.assert_allclose(view.cam_from_world, p, atol=1e-6)
    found = truth.relative_pose(*names)
    assert found is not None
    np.testing.assert_allclose(found, RELATIVE, atol=1e-5)
    back = truth.relative_pose(*names[::-1])
    assert back is not None
    np.testing.assert_allclose(back, inverse(RELATIVE), atol=1e-5)


# --- strecha ---------------------------------------------------------------------------------------------------------


def strecha(folder: Path) -> Path:
    for index, p in enumerate(POSES):
        M, C = p[:, :3].T, inverse(p)[:, 3]
        numbers = [words(CENTRE_0), "0 0 0", words(M), words(C), f"{SIZE[0]} {SIZE[1]}"]
        write(folder / "gt_dense_cameras" / f"{index:04d}.jpg.camera", "\n".join(numbers) + "\n")
    return folder


def test_strecha(tmp_path):
    truth = read_ground_truth(strecha(tmp_path))
    assert (truth.format, truth.unit, truth.pairs) == ("strecha", "metres", None)
    check(truth, ("0000.jpg", "0001.jpg"))
    check(read_ground_truth(tmp_path / "gt_dense_cameras"), ("0000.jpg", "0001.jpg"))
    assert truth.depth("0000.jpg") is None
    assert truth.labels("0000.jpg") is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("64 48", "64", "25 numbers; expected 26: K (9 numbers), 0 0 0, camera-to-world rotation"),
        ("64 48", "64 x", "line 5: 'x' is not a number; expected K (9 numbers)"),
        ("64 48", "64 48.5", "the image is 64x48.5; expected whole pixels"),
        ("60.000000000", "nan", "line 1: nan among the numbers"),
        ("60.000000000", "0", "expected fx s cx / 0 fy cy / 0 0 1 with positive focal lengths"),
    ],
)
def test_wrong_strecha_files_are_refused_with_file_and_what_was_expected(tmp_path, old, new, message):
    strecha(tmp_path)
    path = tmp_path / "gt_dense_cameras" / "0001.jpg.camera"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_ground_truth(tmp_path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


def test_a_matrix_that_is_no_rotation_is_refused(tmp_path):
    strecha(tmp_path)
    path = tmp_path / "gt_dense_cameras" / "0000.jpg.camera"
    M = POSES[0][:, :3].T
    path.write_text(path.read_text().replace(words(M), words(1.01 * M)))
    with pytest.raises(InputError) as error:
        read_ground_truth(tmp_path)
    assert str(error.value) == (
        f"{path}: the pose has no rotation matrix (determinant 1.03); expected orthonormal columns and determinant 1"
    )


# --- scannet ---------------------------------------------------------------------------------------------------------

BIG = np.diag([1296 / 64, 968 / 48, 1]) @ K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def scannet(folder: Path, frames: tuple[str, str] = ("0", "15"), intrinsics: str = "folder") -> Path:
    for frame, p in zip(frames, POSES, strict=True):
        image(folder / "color" / f"{frame}.jpg")
        write(folder / "pose" / f"{frame}.txt", words(square(inverse(p))))
    if intrinsics == "folder":
        write(folder / "intrinsic" / "intrinsic_color.txt", words(np.block([[BIG, np.zeros((3, 1))], [0, 0, 0, 1]])))
    elif intrinsics == "info":
        matrix = words(np.block([[BIG, np.zeros((3, 1))], [0, 0, 0, 1]]))
        lines = ["m_colorWidth = 1296", "m_colorHeight = 968", "m_depthShift = 500", "m_sensorName = StructureSensor"]
        write(folder / f"{folder.name}.txt", "\n".join([*lines, f"m_calibrationColorIntrinsic = {matrix}"]))
    return folder


@pytest.mark.parametrize("intrinsics", ["folder", "info"])
def test_scannet_scales_its_intrinsics_to_the_images(tmp_path, intrinsics):
    folder = scannet(tmp_path / "scene0000_00", intrinsics=intrinsics)
    depth_png(folder / "depth" / "0.png", 2500)
    write(folder / "label-filt" / "0.png", "")
    write(folder / "label" / "15.png", "")
    truth = read_ground_truth(folder)
    check(truth, ("0.jpg", "15.jpg"))
    depth = truth.depth("0.jpg")
    assert depth is not None
    np.testing.assert_allclose(depth, np.full((24, 32), 2.5 if intrinsics == "folder" else 5.0))
    assert truth.depth("15.jpg") is None
    assert [truth.labels(name) for name in ("0.jpg", "15.jpg")] == [
        folder / "label-filt" / "0.png",
        folder / "label" / "15.png",
    ]


def test_scannet_intrinsics_of_the_images_own_size_are_left_as_they_are(tmp_path):
    folder = scannet(tmp_path / "scene", intrinsics="none")
    own = np.block([[CENTRE_0, np.zeros((3, 1))], [0, 0, 0, 1]])
    write(folder / "intrinsic" / "intrinsic_color.txt", words(own))
    check(read_ground_truth(folder), ("0.jpg", "15.jpg"))


def test_scannet_frames_without_tracking_are_left_out_and_counted(tmp_path, caplog):
    folder = scannet(tmp_path / "scene")
    image(folder / "color" / "20.jpg")
    image(folder / "color" / "30.jpg")  # has no pose file at all
    write(folder / "pose" / "20.txt", " ".join(["-inf"] * 16))
    with caplog.at_level(logging.WARNING):
        check(read_ground_truth(folder), ("0.jpg", "15.jpg"))
    assert "1 frames without a pose (tracking was lost) are left out" in caplog.text


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("pose/0.txt", "1 0 0", "3 numbers; expected 16: a camera-to-world matrix of 4 x 4"),
        ("pose/0.txt", "nan " * 16, "the pose has NaN or infinity"),
        ("pose/0.txt", words(np.diag([1.0, 1, 1, 2])), "the last row of the pose is [0.0, 0.0, 0.0, 2.0]"),
        ("pose/0.txt", words(np.diag([1.0, 1, -1, 1])), "no rotation matrix (determinant -1)"),
        ("intrinsic/intrinsic_color.txt", words(np.zeros(16)), "positive focal lengths"),
        ("color/0.jpg", "no image", "cannot be read (not an image of a known format); its size is needed"),
    ],
)
def test_wrong_scannet_files(tmp_path, file, content, message):
    folder = scannet(tmp_path / "scene")
    write(folder / file, content)
    with pytest.raises(InputError) as error:
        read_ground_truth(folder)
    assert str(folder / file) in str(error.value)
    assert message in str(error.value)


def test_scannet_without_usable_intrinsics(tmp_path):
    folder = scannet(tmp_path / "scene", intrinsics="none")
    with pytest.raises(InputError, match=r"neither intrinsic/intrinsic_color.txt nor scene.txt"):
        read_ground_truth(folder)
    write(folder / "scene.txt", "m_colorWidth = 1296\n")
    with pytest.raises(InputError, match="no usable m_calibrationColorIntrinsic"):
        read_ground_truth(folder)


def test_broken_depth_is_refused_when_it_is_read(tmp_path):
    folder = scannet(tmp_path / "scene")
    write(folder / "depth" / "0.png", "no image")
    truth = read_ground_truth(folder)
    with pytest.raises(InputError, match=r"depth map '.*0\.png' cannot be used"):
        truth.depth("0.jpg")


# --- pair lists ------------------------------------------------------------------------------------------------------


def pair_line(name0: str, name1: str, rot: str = "0 0") -> str:
    return f"{name0} {name1} {rot} {words(CENTRE_0)} {words(CENTRE_0)} {words(square(RELATIVE))}\n"


def test_pair_list(tmp_path):
    image(tmp_path / "images" / "a.jpg")
    image(tmp_path / "images" / "b.jpg")
    path = write(tmp_path / "pairs_with_gt.txt", pair_line("a.jpg", "b.jpg", "0 3"))
    truth = read_ground_truth(path, images=tmp_path / "images")
    assert truth.format == "pair-list"
    assert truth.pairs == (("a.jpg", "b.jpg"),)
    check(truth, ("a.jpg", "b.jpg"), poses=(None, None))
    assert truth.relative_pose("a.jpg", "c.jpg") is None
    assert truth.relative_pose("a.jpg", "a.jpg") is None
    with pytest.raises(InputError, match=r"line 1: image '.*a\.jpg' cannot be read \(No such file or directory\)"):
        read_ground_truth(path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.jpg b.jpg 0 0 1 2 3\n", "line 2: 7 fields; expected 38: image0 image1 rot0 rot1 K0 (9 numbers)"),
        (pair_line("a.jpg", "b.jpg", "0 7"), "line 2: rotations 0 and 7; expected 0, 1, 2 or 3 quarter turns"),
        (pair_line("a.jpg", "b.jpg").replace("60.0", "61.0"), "line 2: another K for 'a.jpg' than on a line before"),
        (pair_line("a.jpg", "b.jpg").replace("60.000000000", "nan"), "line 2: nan among the numbers; expected image0"),
        (pair_line("a.jpg", "b.jpg").replace("60.000000000", "K"), "line 2: 'K' is not a number; expected image0"),
        (pair_line("a.jpg", "b.jpg").replace(" 1.000000000\n", " 0.5\n"), "line 2: the last row of the pose is"),
    ],
)
def test_wrong_lines_of_a_pair_list(tmp_path, line, message):
    image(tmp_path / "a.jpg")
    image(tmp_path / "b.jpg")
    path = write(tmp_path / "list.txt", pair_line("a.jpg", "b.jpg") + line)
    with pytest.raises(InputError) as error:
        read_ground_truth(path)
    assert str(error.value).startswith(f"{path}, {message}")


# --- COLMAP ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def colmap_model(tmp_path_factory):
    """A text model by the demo's own writer."""
    folder = tmp_path_factory.mktemp("model")
    views = [
        View(name=name, camera_matrix=K, cam_from_world=p, width=SIZE[0], height=SIZE[1], light="day")
        for name, p in zip(("a.jpg", "sub/b.jpg"), POSES, strict=True)
    ]
    write_ground_truth(folder, views)
    return folder


def test_colmap_text_and_the_binary_that_colmap_makes_of_it(colmap_model, tmp_path):
    import zlib  # noqa: F401  (before pycolmap)

    import pycolmap

    names = ("a.jpg", "sub/b.jpg")
    check(read_ground_truth(colmap_model), names)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model = pycolmap.Reconstruction(colmap_model)
    model.write_binary(tmp_path / "sparse" / "0")
    truth = read_ground_truth(tmp_path)
    assert truth.format == "colmap"
    check(truth, names)
    for found in model.images.values():
        view = truth.views[found.name]
        assert view.cam_from_world is not None
        np.testing.assert_allclose(view.cam_from_world, found.cam_from_world().matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [60, 33, 23]),
        ("SIMPLE_RADIAL", [60, 33, 23, 0.05]),
        ("RADIAL", [60, 33, 23, 0.05, -0.02]),
        ("OPENCV", [60, 61, 33, 23, 0.05, -0.02, 0.003, 0.002]),
        ("FULL_OPENCV", [60, 61, 33, 23, 0.05, -0.02, 0.003, 0.002, 0.01, 0.02, 0.01, 0.005]),
    ],
)
def test_distortion_is_removed_as_colmap_does_it(tmp_path, model, params):
    import zlib  # noqa: F401  (before pycolmap)

    import pycolmap

    write(tmp_path / "cameras.txt", f"1 {model} 64 48 {' '.join(map(str, params))}\n")
    write(tmp_path / "images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n1.5 2.5 -1\n")
    view = read_ground_truth(tmp_path).views["a.jpg"]
    points = np.array([[0.5, 0.5], [33.0, 23.0], [60.0, 40.0]])
    camera = pycolmap.Camera(model=model, width=64, height=48, params=params)
    expected = camera.cam_from_img(points)
    straight = view.undistorted(points)
    found = (straight - view.camera_matrix[:2, 2]) / np.diag(view.camera_matrix)[:2]
    np.testing.assert_allclose(found, expected, atol=2e-4)
    assert bool(view.distortion) == (model != "SIMPLE_PINHOLE")
    assert len(view.undistorted(np.zeros((0, 2)))) == 0


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("cameras.txt", "1 OPENCV_FISHEYE 64 48 1 2 3 4 5 6 7 8\n", "camera model OPENCV_FISHEYE is not supported"),
        ("cameras.txt", "1 PINHOLE 64 48 60 61 33\n", "3 parameters of PINHOLE; expected 4"),
        ("cameras.txt", "# only\n1 PINHOLE\n", "line 2: 2 fields; expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"),
        ("images.txt", "1 1 0 0 0 0 0 0 9 a.jpg\n\n", "line 1: camera 9 of 'a.jpg' is not among the cameras"),
        ("images.txt", "1 2 0 0 0 0 0 0 1 a.jpg\n\n", "line 1: the quaternion of 'a.jpg' has length 2; expected 1"),
        ("images.txt", "1 1 0 0 0 0 nan 0 1 a.jpg\n\n", "line 1: nan among the numbers; expected QW QX QY QZ"),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n\n", "line 1: 9 fields; expected IMAGE_ID QW QX QY QZ TX TY TZ"),
        ("images.txt", "", "has no image with a known camera (colmap)"),
    ],
)
def test_wrong_colmap_text(tmp_path, file, content, message):
    write(tmp_path / "cameras.txt", "1 PINHOLE 64 48 60 61 33 23\n")
    write(tmp_path / "images.txt", "1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    write(tmp_path / file, content)
    with pytest.raises(InputError) as error:
        read_ground_truth(tmp_path)
    assert message in str(error.value)


@pytest.mark.parametrize("cut", [4, 20, 70, -1])
@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_truncated_colmap_binaries(colmap_model, tmp_path, file, cut):
    import zlib  # noqa: F401  (before pycolmap)

    import pycolmap

    pycolmap.Reconstruction(colmap_model).write_binary(tmp_path)
    path = tmp_path / file
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match="is cut short or broken"):
        read_ground_truth(tmp_path)


# --- h5 calibrations -------------------------------------------------------------------------------------------------


def test_image_matching_benchmark_with_depth(tmp_path):
    for name, p in zip(("x_1", "y_2"), POSES, strict=True):
        image(tmp_path / "images" / f"{name}.jpg")
        h5(tmp_path / "calibration" / f"calibration_{name}.h5", K=K, R=p[:, :3], T=p[:, 3], q=np.zeros(4))
    h5(tmp_path / "depth_maps" / "x_1.h5", depth=np.full((48, 64), 7.0, np.float32))
    truth = read_ground_truth(tmp_path)
    assert (truth.format, truth.unit) == ("image-matching-benchmark", "unknown")
    check(truth, ("x_1.jpg", "y_2.jpg"))
    depth = truth.depth("x_1.jpg")
    assert depth is not None
    assert depth.shape == (48, 64)
    assert depth[0, 0] == 7


def test_oanet_counts_from_the_middle_of_the_image_and_lists_its_files(tmp_path):
    middle = K - [[0, 0, 32], [0, 0, 24], [0, 0, 0]]
    for index, p in enumerate(POSES):
        file = tmp_path / "calibration" / f"calibration_{index:06d}.h5"
        h5(file, K=middle, R=p[:, :3], T=p[:, 3:].T, imsize=np.array([SIZE]))
        image(tmp_path / "images" / f"photo{index}.jpg")
    write(tmp_path / "images.txt", "images/photo0.jpg\nimages/photo1.jpg\n")
    write(tmp_path / "calibration.txt", "calibration/calibration_000000.h5\ncalibration/calibration_000001.h5\n")
    check(read_ground_truth(tmp_path), ("photo0.jpg", "photo1.jpg"))
    write(tmp_path / "images.txt", "images/photo0.jpg\n")
    with pytest.raises(InputError, match=r"calibration.txt has 2 lines and images.txt 1; expected as many"):
        read_ground_truth(tmp_path)


def test_wrong_calibrations(tmp_path):
    image(tmp_path / "images" / "a.jpg")
    file = tmp_path / "calibration" / "calibration_a.h5"
    h5(file, K=K, R=np.eye(3))
    with pytest.raises(InputError, match=r"calibration_a.h5' has no 'T' of 3 numbers; expected K \(3, 3\)"):
        read_ground_truth(tmp_path)
    h5(file, R=np.eye(3))
    with pytest.raises(InputError, match="has no data set 'K'; expected K, R, T"):
        read_ground_truth(tmp_path)
    write(file, "no h5")
    with pytest.raises(InputError, match="cannot be read as an h5 file"):
        read_ground_truth(tmp_path)


# --- CSV -------------------------------------------------------------------------------------------------------------


def csv_line(name: str, p: np.ndarray) -> str:
    x, y, z, w = Rotation.from_matrix(p[:, :3]).as_quat()
    return f"{name},64,48,60,61,33,23," + ",".join(f"{v:.9f}" for v in (w, x, y, z, *p[:, 3]))


def test_csv(tmp_path):
    path = write(
        tmp_path / "cameras.csv",
        "\n".join([HEADER, csv_line("a.jpg", POSES[0]), "", csv_line('"sub/b,c.jpg"', POSES[1])]),
    )
    truth = read_ground_truth(path)
    assert truth.format == "csv"
    check(truth, ("a.jpg", "sub/b,c.jpg"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("name,x\n", f"line 1: the header is 'name,x'; expected '{HEADER}'"),
        (f"{HEADER}\na.jpg,64,48\n", "line 2: 3 fields; expected 14"),
        (f"{HEADER}\na.jpg,64,48,60,61,33,23,1,0,0,0,nan,0,0\n", "line 2: nan among the numbers"),
        (f"{HEADER}\na.jpg,64,48,60,61,33,23,1,1,0,0,0,0,0\n", "line 2: the quaternion has length 1.414; expected 1"),
        (f"{HEADER}\na.jpg,64,0,60,61,33,23,1,0,0,0,0,0,0\n", "line 2: the image is 64x0; expected whole pixels"),
        (f"{HEADER}\na.jpg,64,48,0,61,33,23,1,0,0,0,0,0,0\n", "line 2: K is"),
        (f"{HEADER}\n" + "a.jpg,64,48,60,61,33,23,1,0,0,0,0,0,0\n" * 2, "line 3: 'a.jpg' has a line already"),
    ],
)
def test_wrong_csv(tmp_path, content, message):
    path = write(tmp_path / "cameras.csv", content)
    with pytest.raises(InputError) as error:
        read_ground_truth(path)
    assert str(error.value).startswith(f"{path}, {message}")


def test_a_csv_that_is_no_text(tmp_path):
    path = tmp_path / "cameras.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"cameras\.csv' is not a text file"):
        read_ground_truth(path)


# --- whole data sets -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nested", ["", "scannet_test_1500", "scans_test"])
def test_scannet1500_from_its_scenes(tmp_path, nested):
    scannet(tmp_path / nested / "scene0707_00")
    np.savez(tmp_path / "test.npz", name=np.array([[707, 0, 0, 15], [707, 0, 0, 15]], np.uint16))
    truth = read_ground_truth(tmp_path)
    names = ("scene0707_00/color/0.jpg", "scene0707_00/color/15.jpg")
    assert (truth.format, truth.pairs) == ("scannet1500", (names,))
    check(truth, names)


def test_scannet1500_with_relative_poses_and_intrinsics_only(tmp_path):
    names = ("scene0707_00/color/0.jpg", "scene0707_00/color/15.jpg")
    for name in names:
        image(tmp_path / name)
    lists = {"name": np.array([[707, 0, 0, 15]]), "rel_pose": RELATIVE.reshape(1, 12)}
    np.savez(tmp_path / "test.npz", **lists)
    with pytest.raises(InputError, match=r"has no intrinsics, and .* no intrinsics.npz; expected one of them"):
        read_ground_truth(tmp_path)
    at_640 = np.diag([10.0, 10, 1]) @ K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    np.savez(tmp_path / "intrinsics.npz", scene0707_00=at_640.ravel())
    check(read_ground_truth(tmp_path), names, poses=(None, None))
    np.savez(tmp_path / "test.npz", name=lists["name"], rel_pose=np.zeros(7))
    with pytest.raises(InputError, match=r"7 numbers in 'rel_pose'; expected 1 poses of 12"):
        read_ground_truth(tmp_path)


def test_scannet1500_that_is_not_complete(tmp_path):
    np.savez(tmp_path / "test.npz", name=np.array([[707, 0, 0, 15]]))
    with pytest.raises(InputError, match="has no scene 'scene0707_00'"):
        read_ground_truth(tmp_path)
    folder = scannet(tmp_path / "scene0707_00")
    (folder / "color" / "15.jpg").unlink()
    with pytest.raises(InputError, match=r"lacks 1 images of .*, such as 'scene0707_00/color/15\.jpg'"):
        read_ground_truth(tmp_path)
    np.savez(tmp_path / "test.npz", other=np.zeros(3))
    with pytest.raises(InputError, match=r"test\.npz' has no array 'name'; expected name, rel_pose"):
        read_ground_truth(tmp_path)
    write(tmp_path / "test.npz", "no zip")
    with pytest.raises(InputError, match="cannot be read as a list of numpy arrays"):
        read_ground_truth(tmp_path)


def megadepth(folder: Path, lists: Path) -> tuple[str, str]:
    names = ("Undistorted_SfM/0015/images/a.jpg", "Undistorted_SfM/0015/images/b.jpg")
    for name in names:
        image(folder / name)
    h5(folder / "depths" / "a.h5", depth=np.ones((48, 64), np.float32))
    pair_infos = np.empty(1, object)
    pair_infos[0] = (np.array([0, 2]), 0.25, np.zeros((1, 4)))
    lists.mkdir(parents=True, exist_ok=True)
    np.savez(
        lists / "0015_0.1_0.3.npz",
        image_paths=np.array([names[0], None, names[1]], object),
        depth_paths=np.array(["depths/a.h5", None, "depths/b.h5"], object),
        intrinsics=np.array([K, None, K], object),
        poses=np.array([square(POSES[0]), None, square(POSES[1])], object),
        pair_infos=pair_infos,
    )
    return names


@pytest.mark.parametrize("place", ["", "megadepth_test_1500_scene_info"])
def test_megadepth1500(tmp_path, place):
    names = megadepth(tmp_path, tmp_path / place)
    truth = read_ground_truth(tmp_path)
    assert (truth.format, truth.pairs, truth.unit) == ("megadepth1500", (names,), "unknown")
    check(truth, names)
    assert truth.depth(names[0]) is not None
    assert truth.depth(names[1]) is None
    write(tmp_path / place / "megadepth_test_1500.txt", "0022_0.1_0.3.npz\n")
    with pytest.raises(InputError, match=r"0022_0\.1_0\.3\.npz' cannot be read"):
        read_ground_truth(tmp_path)


def test_a_megadepth_list_that_is_no_list_of_pairs(tmp_path):
    names = megadepth(tmp_path, tmp_path)
    arrays = {"image_paths": np.array(names), "intrinsics": np.array([K, K]), "poses": np.array([np.eye(3)] * 2)}
    np.savez(tmp_path / "0015_0.1_0.3.npz", pair_infos=np.zeros(3), **arrays)
    with pytest.raises(InputError, match=r"pair_infos are not rows of \(\(i, j\), overlap, matches\)"):
        read_ground_truth(tmp_path)
    infos = np.array([[[0, 5]]])
    np.savez(tmp_path / "0015_0.1_0.3.npz", pair_infos=infos, **arrays)
    with pytest.raises(InputError, match="image 0: 9 numbers of a pose; expected 3 or 4 rows of 4"):
        read_ground_truth(tmp_path)
    arrays["poses"] = np.array([square(p) for p in POSES])
    np.savez(tmp_path / "0015_0.1_0.3.npz", pair_infos=infos, **arrays)
    with pytest.raises(InputError, match="image 5: the list has 2 images"):
        read_ground_truth(tmp_path)
    np.savez(tmp_path / "0015_0.1_0.3.npz", pair_infos=infos, image_paths=np.array(names))
    with pytest.raises(InputError, match=r"has no array 'intrinsics'; expected image_paths, intrinsics and poses"):
        read_ground_truth(tmp_path)


def test_a_pickle_that_would_run_something_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    header = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little")
    header += b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(tmp_path / "0015_0.1_0.3.npz", "w") as file:
        file.writestr("pair_infos.npy", header + pickle.dumps(Evil()))
    with pytest.raises(InputError, match=r"it holds \w+\.mkdir, which is not data"):
        read_ground_truth(tmp_path)
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize("place", ["", "yfcc100m", "raw_data/yfcc100m"])
def test_yfcc100m(tmp_path, place):
    names = ("reichstag/test/images/a.jpg", "reichstag/test/images/b.jpg")
    for name in names:
        image(tmp_path / place / name)
    write(tmp_path / "yfcc_test_pairs_with_gt.txt", pair_line(*names, "1 0"))
    truth = read_ground_truth(tmp_path)
    assert (truth.format, truth.pairs) == ("yfcc100m", (names,))
    check(truth, names, poses=(None, None))


def kitti360(folder: Path) -> tuple[str, str]:
    drive = "2013_05_28_drive_0003_sync"
    names = tuple(f"data_2d_raw/{drive}/image_00/data_rect/{frame:010d}.png" for frame in (1, 12))
    lines = []
    for frame, name, p in zip((1, 12), names, POSES, strict=True):
        image(folder / name)
        lines.append(f"{frame} {words(square(inverse(p)))}")
    lines.append(f"77 {words(np.eye(4))}")  # its image is not there
    write(folder / "data_poses" / drive / "cam0_to_world.txt", "\n".join(lines) + "\n")
    P = np.column_stack([CENTRE_0, np.zeros(3)])
    calibration = f"calib_time: today\nS_rect_00: 6.4e+01 4.8e+01\nP_rect_00: {words(P)}\nP_rect_01: 1\n"
    write(folder / "calibration" / "perspective.txt", calibration)
    return names[0], names[1]


def test_kitti360(tmp_path):
    names = kitti360(tmp_path)
    label = tmp_path / "data_2d_semantics/train/2013_05_28_drive_0003_sync/image_00/semantic/0000000012.png"
    write(label, "")
    truth = read_ground_truth(tmp_path)
    assert (truth.format, truth.pairs, truth.unit) == ("kitti360", None, "metres")
    check(truth, names)
    assert (truth.labels(names[0]), truth.labels(names[1])) == (None, label)
    write(tmp_path / "pairs.txt", " ".join(names) + "\n")
    assert read_ground_truth(tmp_path).pairs == (names,)
    poses = tmp_path / "data_poses/2013_05_28_drive_0003_sync/cam0_to_world.txt"
    write(poses, "1 2 3\n")
    with pytest.raises(InputError, match="line 1: 3 numbers; expected a frame number and a 4 x 4 matrix"):
        read_ground_truth(tmp_path)
    write(tmp_path / "calibration/perspective.txt", "S_rect_00: 64 48\n")
    with pytest.raises(InputError, match="no P_rect_00 of 12 numbers and S_rect_00 of 2"):
        read_ground_truth(tmp_path)


@pytest.mark.parametrize("above", ["", "scans", "v1/scans"])
def test_matterport3d_turns_cameras_that_look_along_minus_z(tmp_path, above):
    house = tmp_path / above / "17DRP5sb8fy"
    bottom = K.copy()
    bottom[1, 2] = SIZE[1] - K[1, 2]
    lines = ["dataset matterport", "n_images 3", f"intrinsics_matrix {words(bottom)}"]
    for index, p in enumerate(POSES):
        image(house / "undistorted_color_images" / f"u_i0_{index}.jpg")
        world_from_gl = square(np.column_stack([inverse(p)[:, :3] @ FLIP, inverse(p)[:, 3]]))
        lines.append(f"scan u_d0_{index}.png u_i0_{index}.jpg {words(world_from_gl)}")
    lines.append(f"scan u_d0_2.png not_there.jpg {words(np.eye(4))}")
    conf = write(house / "undistorted_camera_parameters" / "17DRP5sb8fy.conf", "\n".join(lines))
    depth_png(house / "undistorted_depth_images" / "u_d0_0.png", 6000)
    truth = read_ground_truth(tmp_path)
    prefix = f"{above}/17DRP5sb8fy".lstrip("/")
    names = (f"{prefix}/undistorted_color_images/u_i0_0.jpg", f"{prefix}/undistorted_color_images/u_i0_1.jpg")
    assert (truth.format, truth.unit) == ("matterport3d", "metres")
    check(truth, names)
    depth = truth.depth(names[0])
    assert depth is not None
    assert depth[0, 0] == 1.5
    write(conf, "\n".join(line for line in lines if not line.startswith("intrinsics")))
    with pytest.raises(InputError, match="line 3: expected intrinsics_matrix before, and scan <depth> <colour>"):
        read_ground_truth(tmp_path)


# --- finding the format, and names -----------------------------------------------------------------------------------


def test_what_fits_no_format_is_refused_with_all_that_would(tmp_path):
    with pytest.raises(InputError) as error:
        read_ground_truth(tmp_path)
    assert str(error.value).startswith(f"'{tmp_path}' is no ground truth of a known format; expected one of these.")
    for name, found in FORMATS.items():
        assert f"{name}: {found.expects}" in str(error.value)
    with pytest.raises(InputError, match=r"there is no ground truth at .*absent"):
        read_ground_truth(tmp_path / "absent")
    with pytest.raises(OptionError, match=r"'stretcha' is unknown; did you mean 'strecha'\?"):
        read_ground_truth(tmp_path, "stretcha")
    path = write(tmp_path / "notes.txt", "hello\n")
    with pytest.raises(InputError, match="no ground truth of a known format"):
        read_ground_truth(path)


@pytest.mark.parametrize("name", FORMATS)
def test_a_named_format_that_is_not_there_is_an_error_of_ours(tmp_path, name):
    file = write(tmp_path / "empty.txt", "")
    for path in (tmp_path, file):
        with pytest.raises(InputError):
            read_ground_truth(path, name)


def test_names_match_by_their_ends():
    def view(name: str) -> TrueView:
        return TrueView(name=name, width=64, height=48, camera_matrix=K, cam_from_world=None)

    names = ("scene0/color/0.jpg", "scene0/color/1.jpg", "scene1/color/1.jpg", "b.jpg")
    truth = GroundTruth(source=Path("gt"), format="test", views={name: view(name) for name in names})
    found = truth.match_names(["0.jpg", "scene1/color/1.jpg", "color/0.jpg", "images/b.jpg", "c.jpg", "other/0.jpg"])
    assert found == {
        "0.jpg": "scene0/color/0.jpg",
        "scene1/color/1.jpg": "scene1/color/1.jpg",
        "color/0.jpg": "scene0/color/0.jpg",
        "images/b.jpg": "b.jpg",
    }
    with pytest.raises(InputError, match=r"'1\.jpg' may be 'scene0/color/1\.jpg' or 'scene1/color/1\.jpg' of gt"):
        truth.match_names(["1.jpg"])


# --- presets ---------------------------------------------------------------------------------------------------------


def test_presets_name_known_formats_and_are_documented():
    assert {preset.format for preset in PRESETS.values()} <= {*FORMATS}
    page = (Path(__file__).parents[2] / "docs" / "datasets.md").read_text()
    for name in (*PRESETS, *FORMATS):
        assert f"`{name}`" in page, name
    assert HEADER in page


def test_pairs_by_frame_difference():
    names = [
        "s/0.jpg",
        "s/5.jpg",
        "s/10.jpg",
        "s/11.jpg",
        "t/5.jpg",
        "scene0007_00_000005.jpg",
        "scene0007_00_000010.jpg",
    ]
    assert frame_pairs(names, 5) == (
        ("s/0.jpg", "s/5.jpg"),
        ("s/5.jpg", "s/10.jpg"),
        ("scene0007_00_000005.jpg", "scene0007_00_000010.jpg"),
    )
    assert frame_pairs(["a_0.jpg", "b_0.jpg", "b_5.jpg", "note.jpg"], 5) == (("b_0.jpg", "b_5.jpg"),)
    many = [f"{i}.jpg" for i in range(100)]
    drawn = frame_pairs(many, 10, 20, np.random.default_rng(4))
    assert len(set(drawn)) == 20
    assert drawn == frame_pairs(many, 10, 20, np.random.default_rng(4))
    assert list(drawn) == sorted(drawn, key=lambda pair: int(pair[0][:-4]))
