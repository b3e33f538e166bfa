"""Models from a verified database: options and results of COLMAP's mappers, which run in a child process."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Collection, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sgam_core.errors import InputError, OptionError
from sgam_sfm.colmap.process import Progress, run
from sgam_sfm.colmap.reading import require_database
from sgam_sfm.colmap.triangulation import require_fitting
from sgam_sfm.files import flush
from sgam_sfm.nearest import unknown

MAPPERS = ("incremental", "global", "hierarchical", "triangulate")


@dataclass(frozen=True, kw_only=True, slots=True)
class MappingOptions:
    """COLMAP's mappers; what is not named here keeps COLMAP's default.

    mapper: incremental; global (GLOMAP); hierarchical (clusters of many images, mapped apart and joined); triangulate
    (points only, for poses that are known). refine_intrinsics: let bundle adjustment change cameras that the user gave;
    other cameras are always refined, as COLMAP does. min_model_size: images, smaller models are dropped. threads: the
    incremental mapper gives the same model every time with 1 only; -1 for all cores.
    """

    mapper: str = "incremental"
    refine_intrinsics: bool = False
    min_model_size: int = 3
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        if self.mapper not in MAPPERS:
            raise OptionError(unknown("mapper", self.mapper, MAPPERS))
        if self.min_model_size < 2:
            raise OptionError(f"min_model_size is {self.min_model_size}; a model has at least 2 images")


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelSummary:
    """One reconstruction.

    folder: its name under the output folder. registered: images with a pose, of the `total` in the database.
    mean_images_per_track: distinct images that see a point, however often each does. images_per_track: how many points
    (values) are seen by how many images (keys).
    """

    folder: str
    registered: int
    total: int
    points: int
    observations: int
    mean_images_per_track: float
    images_per_track: Mapping[int, int]
    mean_reprojection_error_px: float
    images: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class MappingSummary:
    """What mapping made. models: most images first. reason: why there is none, empty otherwise."""

    models: tuple[ModelSummary, ...]
    reason: str
    seconds: float
    peak_memory_mb: float | None


def map_images(
    database_path: Path,
    image_folder: Path,
    output_sparse: Path,
    options: MappingOptions | None = None,
    on_progress: Progress | None = None,
    *,
    known_camera_ids: Collection[int] = (),
    input_model: Path | None = None,
    log_path: Path | None = None,
) -> MappingSummary:
    """Build models from a verified database: output_sparse/0 is the one with most images, then 1, 2, ...

    Models of an earlier run in `output_sparse` are replaced once the new ones are complete.

    Args: known_camera_ids: cameras that the user gave, held fixed unless the options refine them. input_model: folder
        with the COLMAP model whose poses and cameras `triangulate` holds. log_path: takes COLMAP's own log, by default
        `colmap.log` beside the database.
    Raises: StageError when COLMAP fails or ends its process; InputError when the database or image folder is missing,
        or the input model does not fit the database; OptionError when there is no input model to triangulate, or
        when the global mapper would have to hold some cameras fixed and not others.
    """
    options = options or MappingOptions()
    require_database(database_path)
    if not image_folder.is_dir():
        raise InputError(f"there is no image folder at {image_folder}")
    partial = output_sparse.with_name(f".{output_sparse.name}.{os.getpid()}.partial")
    job: dict[str, Any] = {
        "database": str(database_path),
        "images": str(image_folder),
        "output": str(partial),
        "options": asdict(options),
        "fixed_cameras": [] if options.refine_intrinsics else sorted(known_camera_ids),
    }
    if (options.mapper == "triangulate") != (input_model is not None):
        raise OptionError(
            "the mapper triangulate and an input model go together: --mapper triangulate --input-model DIR, with a "
            "COLMAP model of known poses"
        )
    if input_model is not None:
        require_fitting(input_model, database_path)
        job["input_model"] = str(input_model)
    if options.mapper == "global" and job["fixed_cameras"]:
        _refuse_partly_known(database_path, len(job["fixed_cameras"]))
    stage = "triangulation" if options.mapper == "triangulate" else f"{options.mapper} mapping"
    log_path = log_path or database_path.parent / "colmap.log"
    try:
        partial.mkdir(parents=True, exist_ok=True)
        result, seconds = run("sgam_sfm.colmap.mappers", stage, job, log_path, on_progress)
        models = tuple(_model_summary(model) for model in result["models"])
        output_sparse.mkdir(exist_ok=True)
        for old in output_sparse.iterdir():
            if old.name.isdecimal():
                shutil.rmtree(old)
        for model in models:
            for file in (partial / "sorted" / model.folder).iterdir():
                flush(file)
            (partial / "sorted" / model.folder).rename(output_sparse / model.folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return MappingSummary(
        models=models, reason=result["reason"], seconds=seconds, peak_memory_mb=result["peak_memory_mb"]
    )


def _model_summary(model: dict[str, Any]) -> ModelSummary:
    """From JSON, which knows neither tuples nor numbers as keys."""
    lengths = {int(length): count for length, count in model["images_per_track"].items()}
    return ModelSummary(**{**model, "images": tuple(model["images"]), "images_per_track": lengths})


def _refuse_partly_known(database_path: Path, num_known: int) -> None:
    with closing(sqlite3.connect(database_path)) as database:
        (num_cameras,) = database.execute("SELECT COUNT(*) FROM cameras").fetchone()
    if num_known != num_cameras:
        raise OptionError(
            f"{num_known} of {num_cameras} cameras are known, but the global mapper holds all of them fixed or none; "
            "give every camera, pass --refine-intrinsics, or use the incremental mapper"
        )
