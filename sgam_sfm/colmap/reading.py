"""Read what COLMAP made, databases and models, as plain values and arrays.

Pixels have COLMAP's corner origin, as everywhere in this project: nothing is shifted here.
"""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from sgam_core.errors import InputError
from sgam_sfm.pairs import Pair


def read_database(path: Path) -> dict[str, dict]:
    """Everything in a database as plain values and arrays.

    Returns: `cameras` by id; `images` by name; `keypoints` (N, 2) float32 by name; `matches` (M, 2) uint32 and
        `two_view_geometries` (config, F, E, H, inlier_matches) by pair, the image with the smaller id first.
    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        images = {image.image_id: image for image in database.read_all_images()}

        def pair(pair_id: int) -> Pair:
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            return images[id0].name, images[id1].name

        return {
            "cameras": {
                camera.camera_id: {
                    "model": camera.model_name,
                    "width": camera.width,
                    "height": camera.height,
                    "params": np.asarray(camera.params),
                    "has_prior_focal": camera.has_prior_focal_length,
                }
                for camera in database.read_all_cameras()
            },
            "images": {
                image.name: {"image_id": image.image_id, "camera_id": image.camera_id} for image in images.values()
            },
            "keypoints": {image.name: database.read_keypoints(image.image_id) for image in images.values()},
            "matches": {pair(pair_id): indices for pair_id, indices in zip(*database.read_all_matches(), strict=True)},
            "two_view_geometries": {
                pair(pair_id): {
                    "config": pycolmap.TwoViewGeometryConfiguration(geometry.config).name,
                    **{matrix: getattr(geometry, matrix) for matrix in ("F", "E", "H", "inlier_matches")},
                }
                for pair_id, geometry in zip(*database.read_two_view_geometries(), strict=True)
            },
        }


@dataclass(frozen=True, kw_only=True, slots=True)
class DatabaseCounts:
    """keypoints: their number by image name. inliers: by verified pair, the image with the smaller id first."""

    keypoints: Mapping[str, int]
    inliers: Mapping[Pair, int]


MatchedPoints = tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, "K 2"]]
"""Keypoints (K, 2) of both images in pixels, a row a match."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ModelImage:
    """Keypoints of an image in a model. track_lengths: distinct images that see each one's point, 0 without a point."""

    points: Float[np.ndarray, "N 2"]
    track_lengths: Int[np.ndarray, " N"]


def read_counts(path: Path, *, failed: bool = False) -> DatabaseCounts:
    """How many keypoints every image has, and how many inliers every pair that COLMAP verified.

    Args: failed: give the pairs too that COLMAP looked at and found no geometry for, with 0 inliers.
    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pairs = zip(*database.read_two_view_geometry_num_inliers(), strict=True)
        ids = ((pycolmap.pair_id_to_image_pair(pair_id), count) for pair_id, count in pairs if failed or count > 0)
        return DatabaseCounts(
            keypoints={name: database.num_keypoints_for_image(image_id) for image_id, name in names.items()},
            inliers={(names[id0], names[id1]): count for (id0, id1), count in ids},
        )


def read_camera_ids(path: Path) -> dict[str, int]:
    """The camera of every image, by name.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        return {image.name: image.camera_id for image in database.read_all_images()}


def read_keypoints(path: Path, name: str) -> Float[np.ndarray, "N 2"] | None:
    """Keypoints (N, 2) of an image, None when the database does not know it.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        image = database.read_image_with_name(name)
        return None if image is None else np.asarray(database.read_keypoints(image.image_id)[:, :2], np.float64)


def read_pair_inliers(path: Path, pair: Pair) -> MatchedPoints | None:
    """The keypoints that COLMAP's verification matched in a pair; None when it has not looked at the pair.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        images = [database.read_image_with_name(name) for name in pair]
        ids = [image.image_id for image in images if image is not None]
        if len(ids) < 2 or not database.exists_two_view_geometry(*ids):
            return None
        indices = np.asarray(database.read_two_view_geometry(*ids).inlier_matches, np.int64).reshape(-1, 2)
        points = [np.asarray(database.read_keypoints(image_id)[:, :2], np.float64) for image_id in ids]
        return points[0][indices[:, 0]], points[1][indices[:, 1]]


def read_match_counts(path: Path) -> dict[Pair, int]:
    """How many matches every pair has, verified or not, the image with the smaller id first.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pairs = zip(*database.read_num_matches(), strict=True)
        ids = ((pycolmap.pair_id_to_image_pair(pair_id), count) for pair_id, count in pairs)
        return {(names[id0], names[id1]): int(count) for (id0, id1), count in ids}


def each_keypoints(path: Path) -> Iterator[tuple[str, Float[np.ndarray, "N _"]]]:
    """The keypoints of every image, an image at a time; x and y come first.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        for image in database.read_all_images():
            yield image.name, database.read_keypoints(image.image_id)


def each_matches(path: Path) -> Iterator[tuple[Pair, Int[np.ndarray, "M 2"]]]:
    """The matches of every pair as rows of keypoints, a pair at a time, the image with the smaller id first.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        for pair_id in database.read_num_matches()[0]:
            id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
            yield (names[id0], names[id1]), database.read_matches(id0, id1)


def read_pair_matches(path: Path, wanted: Iterable[Pair]) -> Iterator[tuple[Pair, MatchedPoints]]:
    """The matched keypoints of some pairs, verified or not, a pair at a time; pairs of unknown images are left out.

    Raises: InputError when the file is missing or no COLMAP database.
    """
    with opened(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for pair in wanted:
            if not all(name in ids for name in pair):
                continue
            rows = np.asarray(database.read_matches(*(ids[name] for name in pair)), np.int64).reshape(-1, 2)
            points = [np.asarray(database.read_keypoints(ids[name])[:, :2], np.float64) for name in pair]
            yield pair, (points[0][rows[:, 0]], points[1][rows[:, 1]])


def read_model_names(folder: Path) -> tuple[str, ...]:
    """The images with a pose in a model, sorted.

    Raises: InputError when the folder holds no COLMAP model.
    """
    model = read_model(folder)
    return tuple(sorted(model.image(image_id).name for image_id in model.reg_image_ids()))


def read_model_image(folder: Path, name: str) -> ModelImage:
    """The keypoints of an image with a pose in a model, and the lengths of their tracks.

    Raises: InputError when the folder holds no COLMAP model, or the model no such image.
    """
    model = read_model(folder)
    image = model.find_image_with_name(name)
    if image is None:
        raise InputError(f"the model in {folder} has no image '{name}'")
    tracks = [
        len({element.image_id for element in model.point3D(point.point3D_id).track.elements})
        if point.has_point3D()
        else 0
        for point in image.points2D
    ]
    points = np.array([point.xy for point in image.points2D], np.float64).reshape(-1, 2)
    return ModelImage(points=points, track_lengths=np.array(tracks, np.int64))


def read_poses_and_points(folder: Path) -> tuple[dict[str, np.ndarray], Float[np.ndarray, "N 3"]]:
    """cam_from_world (3, 4) of the images with a pose, by name, and the points (N, 3) of a model in the order of ids.

    Raises: InputError when the folder holds no COLMAP model.
    """
    model = read_model(folder)
    images = sorted((model.image(image_id) for image_id in model.reg_image_ids()), key=lambda image: image.name)
    poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in images}
    points = [model.points3D[point_id].xyz for point_id in sorted(model.points3D)]
    return poses, np.array(points, np.float64).reshape(-1, 3)


def read_observations(folder: Path) -> dict[str, Int[np.ndarray, " _"]]:
    """The ids of the points that each image with a pose observes in a model, sorted, each once; images by name, sorted.

    Raises: InputError when the folder holds no COLMAP model.
    """
    model = read_model(folder)
    seen: dict[int, list[int]] = {image_id: [] for image_id in model.reg_image_ids()}
    for point_id, point in model.points3D.items():
        for image_id in {element.image_id for element in point.track.elements}:
            seen[image_id].append(point_id)
    images = sorted((model.image(image_id).name, image_id) for image_id in seen)
    return {name: np.array(sorted(seen[image_id]), np.int64) for name, image_id in images}


def database_content(path: Path) -> dict[str, dict]:
    """`read_database` with lists in place of arrays: two databases are equal when this is."""
    return _plain(read_database(path))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return {key: _plain(item) for key, item in value.items()} if isinstance(value, dict) else value


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """A model as COLMAP has it. Raises: InputError when the folder holds none."""
    try:
        with quiet():
            return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"{folder} cannot be read as a COLMAP model ({str(error).splitlines()[0]}); it needs cameras, images and "
            "points3D as .txt or .bin"
        ) from error


def require_database(path: Path) -> None:
    """Raises: InputError when there is no such file, which COLMAP would create and find empty."""
    if not path.is_file():
        raise InputError(f"there is no database at {path}")


@contextmanager
def opened(path: Path) -> Iterator[pycolmap.Database]:
    """An existing database. Raises: InputError when the file is missing or no COLMAP database."""
    require_database(path)
    try:
        database = pycolmap.Database.open(path)
    except RuntimeError as error:
        raise InputError(f"{path} is not a COLMAP database") from error
    with database:
        yield database


@contextmanager
def quiet() -> Iterator[None]:
    """Keep COLMAP from printing anything short of a fatal error."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
