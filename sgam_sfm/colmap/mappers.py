"""COLMAP's mappers: the child process of `sgam_sfm.colmap.mapping`.

It runs the mapper that the options choose, refines its models, orders and counts them, and writes them for its parent.
"""

from __future__ import annotations

import sqlite3
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pycolmap

from sgam_core.wording import counted
from sgam_sfm.colmap.mapping import MappingOptions, ModelSummary
from sgam_sfm.colmap.process import Progress, serve
from sgam_sfm.colmap.refinement import refine
from sgam_sfm.colmap.triangulation import triangulated

_MANY_INLIERS = 100  # COLMAP starts a model with a pair that has as many


def _map(job: dict[str, Any], send: Progress) -> dict[str, Any]:
    """Runs in the child process; see `process`."""
    options = MappingOptions(**job["options"])
    with pycolmap.Database.open(job["database"]) as database:
        total = database.num_images()
        cameras = database.read_all_cameras()
        counts = database.read_two_view_geometry_num_inliers()[1]
    pycolmap.set_random_seed(options.seed)
    fixed = {*job["fixed_cameras"]}
    if options.mapper == "incremental":
        models = _map_incrementally(job, options, fixed, total, send)
    elif options.mapper == "hierarchical":
        models = _map_hierarchically(job, options, fixed)
    elif options.mapper == "triangulate":
        refined = options.refine_intrinsics
        models = [triangulated(job, send, seed=options.seed, threads=options.threads, refine_intrinsics=refined)]
    else:
        calibrated = all(camera.has_prior_focal_length for camera in cameras)
        models = _map_globally(job, options, bool(fixed), calibrated, send)

    if options.mapper != "triangulate":
        for model in models:
            refine(model, _incremental_options(options, fixed))
    elif not models[0].num_points3D():
        models = []
    order = sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    summaries = []
    for number, model in enumerate(order):
        folder = Path(job["output"], "sorted", str(number))
        folder.mkdir(parents=True)
        model.write_binary(folder)
        summaries.append(asdict(_summary(model, folder.name, total)))
    verified = [count for count in counts if count > 0]
    return {"models": summaries, "reason": "" if summaries else _no_model(verified, total, options)}


def _no_model(inliers: Sequence[int], total: int, options: MappingOptions) -> str:
    """Why there may be no model, and what to do. Args: inliers: of each verified pair. total: number of images."""
    if options.mapper == "triangulate":
        return f"COLMAP triangulated no point with the known poses from {counted(len(inliers), 'verified pair')}"
    if total < options.min_model_size:
        return f"COLMAP's models start at {options.min_model_size} images, and there are {total}; give more photos"
    strong = sum(count >= _MANY_INLIERS for count in inliers)
    if 2 * strong > len(inliers):
        return (
            f"COLMAP found no model of at least {options.min_model_size} images, though {strong} of {len(inliers)} "
            f"verified pairs have {_MANY_INLIERS} inliers or more: photos from nearly one place show no depth, so give "
            "some from farther apart; where EXIF has no focal length, give --camera-params or --cameras"
        )
    return (
        f"COLMAP found no model of at least {options.min_model_size} images from "
        f"{counted(len(inliers), 'verified pair')}, the best with {counted(max(inliers, default=0), 'inlier')}; "
        "try pairs that overlap more (`sgam-sfm show OUT` draws them), a larger --image-size, or another --matcher"
    )


def _map_incrementally(
    job: dict[str, Any], options: MappingOptions, fixed: set[int], total: int, send: Progress
) -> list:
    registered = 0

    def started() -> None:
        nonlocal registered
        registered = 2
        send("map", registered, total)

    def added() -> None:
        nonlocal registered
        registered += 1
        send("map", registered, total)

    models = pycolmap.incremental_mapping(
        job["database"],
        job["images"],
        job["output"],
        _incremental_options(options, fixed),
        initial_image_pair_callback=started,
        next_image_callback=added,
    )
    return list(models.values())


def _map_hierarchically(job: dict[str, Any], options: MappingOptions, fixed: set[int]) -> list:
    pipeline = pycolmap.HierarchicalPipelineOptions()
    pipeline.incremental_options = _incremental_options(options, fixed)
    pipeline.num_threads = pipeline.num_workers = options.threads
    return list(pycolmap.hierarchical_mapping(job["database"], job["images"], job["output"], pipeline).values())


def _incremental_options(options: MappingOptions, fixed: set[int]) -> Any:
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.min_model_size = options.min_model_size
    pipeline.random_seed = options.seed
    pipeline.num_threads = options.threads
    pipeline.constant_cameras = fixed
    return pipeline


def _map_globally(
    job: dict[str, Any], options: MappingOptions, all_fixed: bool, calibrated: bool, send: Progress
) -> list:
    database_path = job["database"]
    if not calibrated:
        # Calibration changes cameras and geometries in the database; the incremental mapper wants them as they were.
        send("calibrate", 0, 0)
        database_path = str(Path(job["output"], "calibrated.db"))
        with closing(sqlite3.connect(job["database"])) as original, closing(sqlite3.connect(database_path)) as copy:
            original.backup(copy)
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = options.seed
        pycolmap.calibrate_view_graph(database_path, calibration)
    pipeline = pycolmap.GlobalPipelineOptions()
    pipeline.min_model_size = options.min_model_size
    pipeline.random_seed = options.seed
    pipeline.num_threads = options.threads
    if all_fixed:
        pipeline.mapper.bundle_adjustment.refine_focal_length = False
        pipeline.mapper.bundle_adjustment.refine_extra_params = False
    send("map", 0, 0)
    return list(pycolmap.global_mapping(database_path, job["images"], job["output"], pipeline).values())


def _summary(model: Any, folder: str, total: int) -> ModelSummary:
    model.update_point_3d_errors()
    distinct = [len({element.image_id for element in point.track.elements}) for point in model.points3D.values()]
    return ModelSummary(
        folder=folder,
        registered=model.num_reg_images(),
        total=total,
        points=model.num_points3D(),
        observations=model.compute_num_observations(),
        mean_images_per_track=sum(distinct) / max(len(distinct), 1),
        images_per_track=dict(sorted(Counter(distinct).items())),
        mean_reprojection_error_px=model.compute_mean_reprojection_error(),
        images=tuple(sorted(model.image(image_id).name for image_id in model.reg_image_ids())),
    )


if __name__ == "__main__":
    serve(_map)
