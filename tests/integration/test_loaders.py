"""Our output as others read it: COLMAP's tools and pycolmap, nerfstudio, gsplat, hloc.

pycolmap is COLMAP's own reader. nerfstudio and gsplat do not install beside this project (they bring a torch and an
OpenCV of their own), so what their loaders read is read here in their way: the same files, fields and types, and the
same look-ups. Theirs are nerfstudio 1.1.5 `data/utils/colmap_parsing_utils.py` and `data/dataparsers/
colmap_dataparser.py`; gsplat `examples/datasets/colmap.py`, whose older versions use the `SceneManager` of a fork of
pycolmap; hloc `utils/io.py` and `triangulation.py`. Where nerfstudio is installed, its own reader is asked, too.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import h5py
import numpy as np
import PIL.Image
import pycolmap
import pytest

from sgam_sfm.colmap.reading import database_content

NUM_PARAMS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}
"""Of the camera models that nerfstudio and the fork know, by their number in the file."""
SUPPORTED = {0, 1, 2, 3, 4, 5}
"""Those that nerfstudio and gsplat can use: pinhole, radial, OPENCV and its fisheye."""
PINHOLE = 1


@dataclass(frozen=True)
class ReadImage:
    """A record of images.bin."""

    rotation: np.ndarray
    translation: np.ndarray
    camera_id: int
    name: str
    xys: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True)
class ReadPoint:
    """A record of points3D.bin."""

    xyz: np.ndarray
    rgb: tuple[int, int, int]
    error: float
    track: np.ndarray


@dataclass(frozen=True)
class ReadModel:
    """The three files of a model; cameras by id: (model, width, height, params)."""

    cameras: dict[int, tuple[int, int, int, tuple[float, ...]]]
    images: dict[int, ReadImage]
    points: dict[int, ReadPoint]


def take(file: BinaryIO, layout: str) -> tuple:
    """The next fields of a file, little-endian and without padding."""
    layout = f"<{layout}"
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def read_as_loaders_do(folder: Path) -> ReadModel:
    """cameras.bin, images.bin and points3D.bin, field by field, to their last byte; rigs and frames are not known."""
    cameras, images, points = {}, {}, {}
    with (folder / "cameras.bin").open("rb") as file:
        for _ in range(*take(file, "Q")):
            camera_id, model, width, height = take(file, "iiQQ")
            cameras[camera_id] = (model, width, height, take(file, "d" * NUM_PARAMS[model]))
        assert not file.read()
    with (folder / "images.bin").open("rb") as file:
        for _ in range(*take(file, "Q")):
            image_id, *pose, camera_id = take(file, "idddddddi")
            name = b"".join(iter(lambda file=file: file.read(1), b"\0")).decode()
            (count,) = take(file, "Q")
            rows = np.array(take(file, "ddq" * count)).reshape(count, 3)
            images[image_id] = ReadImage(
                rotation=rotation_of(pose[:4]),
                translation=np.array(pose[4:]),
                camera_id=camera_id,
                name=name,
                xys=rows[:, :2],
                point_ids=rows[:, 2].astype(np.int64),
            )
        assert not file.read()
    with (folder / "points3D.bin").open("rb") as file:
        for _ in range(*take(file, "Q")):
            point_id, x, y, z, r, g, b, error = take(file, "QdddBBBd")
            (count,) = take(file, "Q")
            track = np.array(take(file, "ii" * count)).reshape(count, 2)
            points[point_id] = ReadPoint(xyz=np.array([x, y, z]), rgb=(r, g, b), error=error, track=track)
        assert not file.read()
    return ReadModel(cameras=cameras, images=images, points=points)


def rotation_of(quaternion: list[float]) -> np.ndarray:
    """The matrix of a quaternion (w, x, y, z) of length 1."""
    w, x, y, z = quaternion
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * skew + 2 * skew @ skew


def projected(model: ReadModel, image: ReadImage, points: np.ndarray) -> np.ndarray:
    """Pixels of points in space; the camera without distortion."""
    number, _, _, params = model.cameras[image.camera_id]
    assert number == PINHOLE
    fx, fy, cx, cy = params
    x, y, z = image.rotation @ points.T + image.translation[:, None]
    assert (z > 0).all()
    return np.stack([fx * x / z + cx, fy * y / z + cy], axis=1)


@pytest.fixture(params=["out/sparse/0", "splat/sparse/0"])
def folder(request, tutorial, splat) -> Path:
    """A model as a run leaves it, and the one without distortion."""
    return tutorial / request.param


def test_binary_files_hold_what_pycolmap_reads_from_them(folder):
    read, truth = read_as_loaders_do(folder), pycolmap.Reconstruction(folder)
    assert set(read.cameras) == set(truth.cameras)
    for camera_id, (number, width, height, params) in read.cameras.items():
        camera = truth.cameras[camera_id]
        assert (number, width, height) == (camera.model.value, camera.width, camera.height)
        assert params == tuple(camera.params)
        assert number in SUPPORTED
    assert set(read.images) == set(truth.reg_image_ids())
    for image_id, image in read.images.items():
        expected = truth.image(image_id)
        np.testing.assert_allclose(
            np.column_stack([image.rotation, image.translation]), expected.cam_from_world().matrix(), atol=1e-12
        )
        assert (image.name, image.camera_id) == (expected.name, expected.camera_id)
        assert len(image.xys) == expected.num_points2D()
        assert (image.point_ids >= 0).sum() == expected.num_points3D
    assert set(read.points) == set(truth.point3D_ids())
    for point_id, point in read.points.items():
        np.testing.assert_array_equal(point.xyz, truth.point3D(point_id).xyz)
        assert point.error == truth.point3D(point_id).error
        assert len(point.track) == truth.point3D(point_id).track.length()


def test_tracks_and_observations_name_each_other(folder):
    """nerfstudio looks up every observation of a track, gsplat every point of an observation."""
    read = read_as_loaders_do(folder)
    for point_id, point in read.points.items():
        assert len({image_id for image_id, _ in point.track.tolist()}) == len(point.track) >= 2
        for image_id, row in point.track.tolist():
            assert read.images[image_id].point_ids[row] == point_id
    for image in read.images.values():
        assert set(image.point_ids[image.point_ids >= 0].tolist()) <= set(read.points)


def test_points_have_the_colours_of_the_photos(folder):
    """Both trainers start from them."""
    colours = np.array([point.rgb for point in read_as_loaders_do(folder).points.values()])
    assert colours.std(axis=0).min() > 10


def test_points_fall_on_their_observations_without_distortion(splat):
    read = read_as_loaders_do(splat / "sparse/0")
    for image in read.images.values():
        seen = image.point_ids >= 0
        points = np.array([read.points[point_id].xyz for point_id in image.point_ids[seen].tolist()])
        distances = np.linalg.norm(projected(read, image, points) - image.xys[seen], axis=1)
        assert np.median(distances) < 1


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_photos_of_the_model_are_found_at_every_size(splat, factor):
    """nerfstudio joins the folder and the name; gsplat pairs the sorted files of both folders."""
    read = read_as_loaders_do(splat / "sparse/0")
    folder = splat / ("images" if factor == 1 else f"images_{factor}")
    names = sorted(image.name for image in read.images.values())
    full, scaled = (
        sorted(path.relative_to(each).as_posix() for path in each.rglob("*") if path.is_file())
        for each in (splat / "images", folder)
    )
    assert full == scaled == names
    assert len({model for model, *_ in read.cameras.values()}) == 1  # nerfstudio refuses several models
    for image in read.images.values():
        _, width, height, _ = read.cameras[image.camera_id]
        with PIL.Image.open(folder / image.name) as photo:
            assert photo.size == (width // factor, height // factor)


def test_newer_gsplat_reads_by_pycolmap(splat):
    """The calls of its parser."""
    model = pycolmap.Reconstruction(str(splat / "sparse/0/"))
    order = {point_id: row for row, point_id in enumerate(model.points3D)}
    for image in model.images.values():
        assert image.cam_from_world().matrix().shape == (3, 4)
        camera = model.cameras[image.camera_id]
        assert camera.model == pycolmap.CameraModelId.PINHOLE
        assert camera.calibration_matrix().shape == (3, 3)
        rows = [order[seen.point3D_id] for seen in image.get_observation_points2D()]
        assert len(rows) == image.num_points3D > 0
    first = next(iter(model.points3D.values()))
    assert (first.xyz.shape, first.color.shape, first.color.dtype) == ((3,), (3,), np.uint8)


def test_text_models_of_colmap_are_the_same(tutorial, tmp_path):
    """`colmap model_converter --output_type TXT` and back."""
    model = pycolmap.Reconstruction(tutorial / "out/sparse/0")
    model.write_text(tmp_path)
    again = pycolmap.Reconstruction(tmp_path)
    assert again.num_points3D() == model.num_points3D() > 0
    for image_id in model.reg_image_ids():
        np.testing.assert_allclose(
            again.image(image_id).cam_from_world().matrix(), model.image(image_id).cam_from_world().matrix()
        )


def test_the_database_opens_as_colmaps_own(tutorial):
    with pycolmap.Database.open(tutorial / "out/database.db") as database:
        assert database.num_images() == 3
        assert database.num_verified_image_pairs() == 3


def test_hloc_finds_every_pair_and_point(tutorial):
    """`hloc.reconstruction` with our two files: keypoints, each pair of the list in either order, 0.5 added."""
    content = database_content(tutorial / "out/database.db")
    pairs = [line.split() for line in (tutorial / "pairs.txt").read_text().splitlines()]
    assert len(pairs) == 3
    with h5py.File(tutorial / "out/keypoints.h5") as keypoints, h5py.File(tutorial / "out/matches.h5") as matches:
        found = {name: keypoints[name]["keypoints"].__array__() + 0.5 for name in content["keypoints"]}
        for name, points in found.items():
            np.testing.assert_allclose(points, content["keypoints"][name], atol=1e-3)
        for name0, name1 in pairs:
            key = "/".join(name.replace("/", "-") for name in (name0, name1))
            turned = key not in matches
            group = matches["/".join(reversed(key.split("/"))) if turned else key]
            matches0, scores = group["matches0"].__array__(), group["matching_scores0"].__array__()
            first, second = (name1, name0) if turned else (name0, name1)
            assert len(matches0) == len(scores) == len(found[first])
            assert (matches0 >= 0).sum() > 100
            assert matches0.max() < len(found[second])


def test_nerfstudios_own_reader_agrees(folder):
    reader = pytest.importorskip("nerfstudio.data.utils.colmap_parsing_utils")
    read = read_as_loaders_do(folder)
    cameras = reader.read_cameras_binary(folder / "cameras.bin")
    images = reader.read_images_binary(folder / "images.bin")
    points = reader.read_points3D_binary(folder / "points3D.bin")
    assert (set(cameras), set(images), set(points)) == (set(read.cameras), set(read.images), set(read.points))
    for image_id, image in images.items():
        np.testing.assert_allclose(reader.qvec2rotmat(image.qvec), read.images[image_id].rotation, atol=1e-9)
        np.testing.assert_array_equal(image.point3D_ids, read.images[image_id].point_ids)
