"""Points for a model whose poses are known: COLMAP's triangulation of a database's verified matches."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from sgam_core.errors import InputError
from sgam_sfm.colmap.process import Progress
from sgam_sfm.colmap.reading import opened, read_model


def require_fitting(input_model: Path, database_path: Path) -> None:
    """Check that a model of known poses can stand for the images of a database.

    Images are told by name. Cameras come from the model, so those that share one in the database must in the model.

    Raises: InputError when no image has a pose, or cameras disagree.
    """
    model = read_model(input_model)
    posed = _posed(model)
    with opened(database_path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    common = [image for image in images if image.name in posed]
    if not common:
        example = f", such as '{min(posed)}'," if posed else ""
        raise InputError(
            f"none of the {len(posed)} images with a pose in {input_model}{example} is among the {len(images)} images "
            "of the database; names are relative to the image folder"
        )
    first: dict[int, pycolmap.Image] = {}
    for image in common:
        camera, known = cameras[image.camera_id], model.camera(posed[image.name].camera_id)
        if (camera.width, camera.height) != (known.width, known.height):
            raise InputError(
                f"'{image.name}' is {known.width}x{known.height} in {input_model} but {camera.width}x{camera.height} "
                "(width x height) in the database; give a model of the images as they are"
            )
        other = first.setdefault(image.camera_id, image)
        if not _same(known, model.camera(posed[other.name].camera_id)):
            raise InputError(
                f"'{other.name}' and '{image.name}' share a camera in the database but have two in {input_model}; "
                "match with that model's cameras: --cameras DIR"
            )


def triangulated(
    job: Mapping[str, Any], send: Progress, *, seed: int, threads: int, refine_intrinsics: bool
) -> pycolmap.Reconstruction:
    """The job's input model with points from the verified matches of its database; images without a pose are left out.

    Poses stay as they are, cameras too unless `refine_intrinsics`. Ids are those of the database. Runs in the child
    `sgam_sfm.colmap.mappers`.
    """
    known = pycolmap.Reconstruction(job["input_model"])
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.random_seed = seed
    pipeline.num_threads = threads
    send("triangulate", 0, 0)
    return pycolmap.triangulate_points(
        _with_ids_of(job["database"], known),
        job["database"],
        job["images"],
        job["output"],
        options=pipeline,
        refine_intrinsics=refine_intrinsics,
    )


def _with_ids_of(database_path: str, known: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The poses and cameras of a model on the images, frames and rigs of a database."""
    model, posed = pycolmap.Reconstruction(), _posed(known)
    with pycolmap.Database.open(database_path) as database:
        images, frames = database.read_all_images(), database.read_all_frames()
        rigs, cameras = database.read_all_rigs(), database.read_all_cameras()
    source = {image.camera_id: known.camera(posed[image.name].camera_id) for image in images if image.name in posed}
    for camera in cameras:
        if camera.camera_id in source:
            camera.model = source[camera.camera_id].model
            camera.params = list(source[camera.camera_id].params)
        model.add_camera(camera)
    by_frame: dict[int, list[pycolmap.Image]] = {}
    for image in images:
        by_frame.setdefault(image.frame_id, []).append(image)
    for rig in rigs:
        model.add_rig(rig)
    for frame in frames:
        poses = {i.camera_id: posed[i.name].cam_from_world() for i in by_frame[frame.frame_id] if i.name in posed}
        _place_sensors(model.rig(frame.rig_id), poses)
        model.add_frame(frame)
    for image in images:
        model.add_image(image)
    for frame_id, members in by_frame.items():
        members.sort(key=lambda image: not model.rig(model.frame(frame_id).rig_id).is_ref_sensor(_sensor(image)))
        placed = [image for image in members if image.name in posed]
        if placed:
            model.frame(frame_id).set_cam_from_world(placed[0].camera_id, posed[placed[0].name].cam_from_world())
            model.register_frame(frame_id)
    return model


def _place_sensors(rig: pycolmap.Rig, poses: Mapping[int, pycolmap.Rigid3d]) -> None:
    """Where the cameras of a rig are, when the database does not say, from one moment with known poses."""
    reference = poses.get(rig.ref_sensor_id.id)
    for sensor, place in rig.non_ref_sensors.items():
        if place is None and reference is not None and sensor.id in poses:
            rig.set_sensor_from_rig(sensor, poses[sensor.id] * reference.inverse())


def _sensor(image: pycolmap.Image) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, image.camera_id)


def _posed(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    return {image.name: image for image in map(model.image, model.reg_image_ids())}


def _same(camera0: pycolmap.Camera, camera1: pycolmap.Camera) -> bool:
    return camera0.model == camera1.model and np.array_equal(camera0.params, camera1.params)
