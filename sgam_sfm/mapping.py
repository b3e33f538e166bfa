"""COLMAP's verification and mapping, each in a child process.

Native code can end a process without an exception (corrupt data, memory). In a child that becomes a `StageError`, and
everything computed before is still there. The child is this module run as a program: it reads a job as JSON from its
standard input and writes one JSON object a line, progress and finally the result; it ends when its input is closed.
What native code prints is appended to a log file.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from sgam_core.errors import InputError, OptionError, StageError
from sgam_sfm.child import end_with_parent
from sgam_sfm.files import flush
from sgam_sfm.machine import peak_memory_mb
from sgam_sfm.pairs import Pair
from sgam_sfm.refinement import refine
from sgam_sfm.triangulation import require_fitting, triangulated

Progress = Callable[[str, int, int], None]
"""Called with the name of the step, how much of it is done, and how much there is (0 when nobody knows)."""

MAPPERS = ("incremental", "global", "hierarchical", "triangulate")


@dataclass(frozen=True, kw_only=True, slots=True)
class VerificationOptions:
    """COLMAP's two-view verification; the defaults are COLMAP's own, but for the seed.

    max_error_px: of an inlier, in pixels of the images as they are. min_num_inliers: fewer and the pair is dropped.
    seed: of the robust estimation, the same for every pair. threads: -1 for all cores, which does not change the
    result.
    """

    max_error_px: float = 4.0
    min_num_inliers: int = 15
    seed: int = 0
    threads: int = -1

    def __post_init__(self) -> None:
        if self.max_error_px <= 0:
            raise OptionError(f"verification's max_error_px is {self.max_error_px}; expected more than 0 pixels")


@dataclass(frozen=True, kw_only=True, slots=True)
class VerificationSummary:
    """What verification left. inliers: their number for every verified pair. num_pairs: pairs that had matches."""

    inliers: Mapping[Pair, int]
    num_pairs: int
    seconds: float
    peak_memory_mb: float | None


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
            raise OptionError(f"mapper '{self.mapper}' is unknown; choose one of {', '.join(MAPPERS)}")
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


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseErrors:
    """How a model's poses differ from the truth after a similarity alignment. center: in the truth's unit."""

    num_images: int
    median_center: float
    max_center: float
    median_rotation_deg: float
    max_rotation_deg: float


def verify(
    database_path: Path,
    options: VerificationOptions | None = None,
    on_progress: Progress | None = None,
    log_path: Path | None = None,
    *,
    anew: bool = True,
) -> VerificationSummary:
    """Estimate the two-view geometry of every pair with matches and write it into the database.

    Args: anew: of pairs too that have one. log_path: takes COLMAP's own log, by default `colmap.log` beside the
        database.
    Raises: StageError when COLMAP fails or ends its process; InputError when there is no database.
    """
    _require(database_path)
    job = {
        "stage": "verification",
        "database": str(database_path),
        "options": asdict(options or VerificationOptions()),
        "anew": anew,
    }
    result, seconds = _run(job, log_path or database_path.parent / "colmap.log", on_progress)
    return VerificationSummary(
        inliers={(name0, name1): count for name0, name1, count in result["inliers"]},
        num_pairs=result["num_pairs"],
        seconds=seconds,
        peak_memory_mb=result["peak_memory_mb"],
    )


def match_sift(
    database_path: Path,
    image_folder: Path,
    pairs: Sequence[Pair],
    options: VerificationOptions | None = None,
    on_progress: Progress | None = None,
    log_path: Path | None = None,
) -> float:
    """COLMAP's own SIFT features and matches of the pairs, into a database whose images and cameras are imported.

    Returns: the seconds it took. Features and matcher have COLMAP's defaults; `verify` comes afterwards, as after any
        other matches.
    Raises: StageError when COLMAP fails or ends its process; InputError for names that its pair list cannot hold.
    """
    _require(database_path)
    pair_list = database_path.with_name("sift_pairs.txt")
    spaced = [name for pair in pairs for name in pair if len(name.split()) > 1]
    if spaced:
        raise InputError(f"image name '{spaced[0]}' has a space, which COLMAP's pair list cannot hold; leave out sift")
    pair_list.write_text("".join(f"{name0} {name1}\n" for name0, name1 in pairs), encoding="utf-8")
    job = {
        "stage": "SIFT",
        "database": str(database_path),
        "images": str(image_folder),
        "pairs": str(pair_list),
        "options": asdict(options or VerificationOptions()),
    }
    return _run(job, log_path or database_path.parent / "colmap.log", on_progress)[1]


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
    _require(database_path)
    if not image_folder.is_dir():
        raise InputError(f"there is no image folder at {image_folder}")
    partial = output_sparse.with_name(f".{output_sparse.name}.{os.getpid()}.partial")
    job: dict[str, Any] = {
        "stage": "triangulation" if options.mapper == "triangulate" else f"{options.mapper} mapping",
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
    try:
        partial.mkdir(parents=True, exist_ok=True)
        result, seconds = _run(job, log_path or database_path.parent / "colmap.log", on_progress)
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


def compare_poses(model: Path, truth: Path, max_center_error: float = 0.1) -> PoseErrors:
    """Align a model to the true one by their camera centres and compare the poses of the images they share.

    Args: model, truth: folders with COLMAP models. max_center_error: of an inlier of the alignment, in the truth's
        unit.
    Raises: StageError when they cannot be read or aligned.
    """
    job = {"stage": "comparison", "model": str(model), "truth": str(truth), "max_center_error": max_center_error}
    result, _ = _run(job, model.parent.parent / "colmap.log", None)
    rotations, centers = result["rotations_deg"], result["centers"]
    return PoseErrors(
        num_images=len(centers),
        median_center=median(centers),
        max_center=max(centers),
        median_rotation_deg=median(rotations),
        max_rotation_deg=max(rotations),
    )


def _model_summary(model: dict[str, Any]) -> ModelSummary:
    """From JSON, which knows neither tuples nor numbers as keys."""
    lengths = {int(length): count for length, count in model["images_per_track"].items()}
    return ModelSummary(**{**model, "images": tuple(model["images"]), "images_per_track": lengths})


def _require(database_path: Path) -> None:
    # COLMAP would create a missing database and find it empty.
    if not database_path.is_file():
        raise InputError(f"there is no database at {database_path}")


def _refuse_partly_known(database_path: Path, num_known: int) -> None:
    with closing(sqlite3.connect(database_path)) as database:
        (num_cameras,) = database.execute("SELECT COUNT(*) FROM cameras").fetchone()
    if num_known != num_cameras:
        raise OptionError(
            f"{num_known} of {num_cameras} cameras are known, but the global mapper holds all of them fixed or none; "
            "give every camera, pass --refine-intrinsics, or use the incremental mapper"
        )


def _run(job: dict[str, Any], log_path: Path, on_progress: Progress | None) -> tuple[dict[str, Any], float]:
    """Run a job in a child process. Returns: its result, and the seconds it took."""
    start = time.perf_counter()
    result = None
    # -P keeps the working directory off the module path: a `random.py` there must not be what COLMAP's child imports.
    command = [sys.executable, "-P", "-m", "sgam_sfm.mapping"]
    log_path.parent.mkdir(parents=True, exist_ok=True)
    with log_path.open("ab") as log:
        log_start = log.tell()
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True)
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            with suppress(BrokenPipeError):  # a child that ended at once is told by its exit code
                child.stdin.write(json.dumps(job) + "\n")
                child.stdin.flush()  # and left open: the child ends when it is closed
            with child.stdout:
                for line in child.stdout:
                    message = json.loads(line)
                    if "step" in message and on_progress is not None:
                        on_progress(message["step"], message["done"], message["total"])
                    result = message.get("result", result)
            code = child.wait()
        finally:
            child.kill()
            child.wait()
            with suppress(BrokenPipeError):
                child.stdin.close()
    if code != 0 or result is None:
        ending = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        ending += " (out of memory?)" if ending == "SIGKILL" else ""
        raise StageError(
            f"COLMAP's {job['stage']} ended with {ending}: {_last_words(log_path, log_start)} (log: {log_path}); "
            "everything before this stage has been kept"
        )
    return result, time.perf_counter() - start


_ERROR_LINE = re.compile(r"what\(\):|[EF]\d{8} |[A-Za-z.]*(Error|Exception): ")
_TRACE_LINE = re.compile(r"@ |PC: |\*\*\* |terminate called")


def _last_words(log_path: Path, start: int) -> str:
    """The line of the log since byte `start` that tells most: the last error, or else the last line."""
    with log_path.open("rb") as log:
        log.seek(start)
        # glog's handler of signals may write into a line that is not ended yet
        lines = [
            line.partition("*** Aborted")[0].strip() for line in log.read().decode("utf-8", "replace").splitlines()
        ]
    lines = [line for line in lines if line and not _TRACE_LINE.match(line)]
    errors = [line for line in lines if _ERROR_LINE.match(line)]
    return (errors or lines or ["it left no message"])[-1]


# What follows runs in the child.

Send = Callable[[str, int, int], None]


def _verify(job: dict[str, Any], send: Send) -> dict[str, Any]:
    import pycolmap

    options = VerificationOptions(**job["options"])
    with pycolmap.Database.open(job["database"]) as database:
        if job["anew"]:
            database.clear_two_view_geometries()  # COLMAP skips pairs that have one
        names = {image.image_id: image.name for image in database.read_all_images()}
        num_pairs = database.num_matched_image_pairs()
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = options.threads
    two_view = pycolmap.TwoViewGeometryOptions()
    two_view.min_num_inliers = options.min_num_inliers
    two_view.ransac.max_error = options.max_error_px
    two_view.ransac.random_seed = options.seed
    with _counting_rows(job["database"], "two_view_geometries", lambda done: send("verify", done, num_pairs)):
        pycolmap.geometric_verification(job["database"], verifier, two_view_geometry_options=two_view)
    with pycolmap.Database.open(job["database"]) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    send("verify", num_pairs, num_pairs)
    pairs = [(*pycolmap.pair_id_to_image_pair(pair_id), count) for pair_id, count in zip(pair_ids, counts, strict=True)]
    return {
        "inliers": [[names[id0], names[id1], count] for id0, id1, count in sorted(pairs) if count > 0],
        "num_pairs": num_pairs,
    }


def _sift(job: dict[str, Any], send: Send) -> dict[str, Any]:
    import pycolmap

    options = VerificationOptions(**job["options"])
    with pycolmap.Database.open(job["database"]) as database:
        names = [image.name for image in database.read_all_images()]
        database.clear_two_view_geometries()
        database.clear_matches()
        database.clear_descriptors()
        database.clear_keypoints()
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = options.threads
    cpu = pycolmap.Device.cpu  # GPU SIFT gives other features on every run
    send("extract", 0, len(names))
    pycolmap.extract_features(job["database"], job["images"], names, extraction_options=extraction, device=cpu)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job["pairs"]
    two_view = pycolmap.TwoViewGeometryOptions()
    two_view.ransac.random_seed = options.seed
    send("match", 0, 0)
    pycolmap.match_image_pairs(job["database"], matching, pairing, verification_options=two_view, device=cpu)
    return {}


def _map(job: dict[str, Any], send: Send) -> dict[str, Any]:
    import pycolmap

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
        models = [triangulated(job, options, send)]
    else:
        calibrated = all(camera.has_prior_focal_length for camera in cameras)
        models = _map_globally(job, options, bool(fixed), calibrated, send)

    verified = [count for count in counts if count > 0]
    reason = (
        f"COLMAP found no model of at least {options.min_model_size} images from {len(verified)} verified pairs, the "
        f"best with {max(verified, default=0)} inliers; try pairs that overlap more (`sgam-sfm show OUT` draws them), "
        "a larger --image-size, or another --matcher"
    )
    if options.mapper != "triangulate":
        for model in models:
            refine(model, _incremental_options(options, fixed))
    elif not models[0].num_points3D():
        models, reason = [], f"COLMAP triangulated no point with the known poses from {len(verified)} verified pairs"
    order = sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    summaries = []
    for number, model in enumerate(order):
        folder = Path(job["output"], "sorted", str(number))
        folder.mkdir(parents=True)
        model.write_binary(folder)
        summaries.append(asdict(_summary(model, folder.name, total)))
    return {"models": summaries, "reason": "" if summaries else reason}


def _map_incrementally(job: dict[str, Any], options: MappingOptions, fixed: set[int], total: int, send: Send) -> list:
    import pycolmap

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
    import pycolmap

    pipeline = pycolmap.HierarchicalPipelineOptions()
    pipeline.incremental_options = _incremental_options(options, fixed)
    pipeline.num_threads = pipeline.num_workers = options.threads
    return list(pycolmap.hierarchical_mapping(job["database"], job["images"], job["output"], pipeline).values())


def _incremental_options(options: MappingOptions, fixed: set[int]) -> Any:
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.min_model_size = options.min_model_size
    pipeline.random_seed = options.seed
    pipeline.num_threads = options.threads
    pipeline.constant_cameras = fixed
    return pipeline


def _map_globally(job: dict[str, Any], options: MappingOptions, all_fixed: bool, calibrated: bool, send: Send) -> list:
    import pycolmap

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


def _compare(job: dict[str, Any], send: Send) -> dict[str, Any]:
    import pycolmap

    found = pycolmap.compare_reconstructions(
        pycolmap.Reconstruction(job["model"]),
        pycolmap.Reconstruction(job["truth"]),
        alignment_error="proj_center",
        max_proj_center_error=job["max_center_error"],
    )
    if found is None:
        raise RuntimeError(f"{job['model']} cannot be aligned to {job['truth']}")
    errors = found["errors"]
    return {
        "rotations_deg": [error.rotation_error_deg for error in errors],
        "centers": [error.proj_center_error for error in errors],
    }


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


@contextmanager
def _counting_rows(database_path: str, table: str, report: Callable[[int], None]) -> Iterator[None]:
    """Report the growing number of rows, twice a second; verification itself has no callback."""
    finished = threading.Event()

    def count() -> None:
        with closing(sqlite3.connect(f"{Path(database_path).resolve().as_uri()}?mode=ro", uri=True)) as database:
            while not finished.wait(0.5):
                report(database.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])

    thread = threading.Thread(target=count, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()


def _main() -> None:
    # The parent reads our lines only: what native code prints to standard output joins its log on standard error.
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def write(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    job = json.loads(sys.stdin.buffer.readline())
    end_with_parent(sys.stdin.fileno())  # it would go on to write into a database that the next run replaces
    stage = {"verification": _verify, "comparison": _compare, "SIFT": _sift}.get(job["stage"], _map)
    result = stage(job, lambda step, done, total: write({"step": step, "done": done, "total": total}))
    write({"result": {**result, "peak_memory_mb": peak_memory_mb()}})


if __name__ == "__main__":
    _main()
