"""New photos against a model: matched like the images of its run, then each gets COLMAP's absolute pose."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from sgam_core import PointMatcher
from sgam_core.errors import InputError
from sgam_core.geometry import residuals
from sgam_core.wording import counted
from sgam_sfm.colmap.absolute_pose import (
    Correspondences,
    Landmarks,
    Pose,
    carry_to_landmarks,
    estimate_pose,
    joined,
    landmarks_of,
)
from sgam_sfm.colmap.cameras import CameraInfo, camera_of_info
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.colmap.reading import read_model
from sgam_sfm.evaluation.ground_truth.camera_table import write_camera_table
from sgam_sfm.evaluation.ground_truth.types import TrueView
from sgam_sfm.executors import MatchingJob
from sgam_sfm.executors.local import LocalExecutor
from sgam_sfm.files import replacing, write_json
from sgam_sfm.images import inspect_image
from sgam_sfm.inputs import Inputs, read_images
from sgam_sfm.label_maps import make_label_maps
from sgam_sfm.machine import find_device
from sgam_sfm.options import MatchOptions, starting_options
from sgam_sfm.pairs import Pair, PairList, blocks, read_pairs, set_aside
from sgam_sfm.progress import Stages
from sgam_sfm.runs.block_matching import match_blocks
from sgam_sfm.runs.matching import create_area_matcher
from sgam_sfm.runs.results import Results, open_results
from sgam_sfm.runs.run_record import recording
from sgam_sfm.runs.runner import open_store
from sgam_sfm.runs.store import PairRecord, PairStore
from sgam_sfm.runs.summary import versions
from sgam_sfm.stage_options import LocalizeOptions

_log = logging.getLogger(__name__)
_MAX_REFERENCES = 60


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Query:
    """What became of a photo.

    correspondences: how many there were. seen: of those that agree with the pose, one for each point. reason: why it
    has no pose, empty when it has one.
    """

    references: int
    matches: int
    correspondences: int
    seen: Correspondences
    pose: Pose | None
    reason: str


def localize(
    options: LocalizeOptions, stages: Stages | None = None, point_matcher: PointMatcher | None = None
) -> dict[str, Any]:
    """Find the poses of photos in a model.

    Args: point_matcher: in place of the run's, and equal to it in what it returns.
    Returns: the content of localize.json.
    Raises: SGAMError for what cannot be used at all; photos without a pose are counted, with the reason.
    """
    results = open_results(options.results, options.reference_images)
    folder = options.model or results.folder / "sparse" / "0"
    if not folder.is_dir():
        raise InputError(f"there is no model at {folder}; `sgam-sfm reconstruct OUT` makes one, or give --model DIR")
    model = read_model(folder)
    with recording(options.output, stages := stages or Stages(quiet=True), "localize"):
        return _localize(options, results, model, stages, point_matcher)


def _localize(
    options: LocalizeOptions,
    results: Results,
    model: pycolmap.Reconstruction,
    stages: Stages,
    point_matcher: PointMatcher | None,
) -> dict[str, Any]:
    run = _options_of_run(options, results)
    executor = LocalExecutor.of(run, point_matcher)
    inputs, photos = _read_inputs(options, results, model, stages)
    store = open_store(run, inputs)
    needs_labels = create_area_matcher(run).needs_labels or bool(run.mask_matches)
    labels = make_label_maps(run, inputs.images, stages) if needs_labels else None
    work = blocks(inputs.pairs.pairs, run.block_images)
    match_blocks(work, store, executor, MatchingJob(options=run, inputs=inputs, labels=labels), stages)

    landmarks = lru_cache(None)(lambda name: landmarks_of(model, model.find_image_with_name(name)))
    queries: dict[str, _Query] = {}
    with stages.stage("Estimating poses", len(photos)) as advance:
        for name, records in _records_of(photos, store, work):
            parts = [_correspondences(record, landmarks, options, run) for record in records]
            queries[name] = _locate(inputs.cameras[name], records, joined(parts), options)
            advance(1)
    localized = {name: query.pose for name, query in queries.items() if query.pose is not None}
    _write_poses(options.output, localized)
    _write_model(options.output / "sparse" / "0", model, queries, inputs.cameras)
    failed = dict(inputs.failed) | {name: query.reason for name, query in queries.items() if query.pose is None}
    for name, reason in failed.items():
        _log.warning("%s has no pose: %s", name, reason)
    content = {
        "options": options,
        "localized": len(localized),
        "failed": failed,
        "references": len(inputs.images) - len(photos),
        "reference_images": results.images,
        "pairs": len(inputs.pairs.pairs),
        "pairs_of_unusable_images": inputs.pairs.unreadable,
        "photos": {name: _told(query) for name, query in queries.items()},
        "seconds": stages.seconds,
        "versions": versions(),
    }
    written: dict[str, Any] = write_json(options.output / "localize.json", content)
    return written


def _records_of(
    photos: Iterable[str], store: PairStore, work: Sequence[Sequence[Pair]]
) -> Iterator[tuple[str, list[PairRecord]]]:
    """The records of each photo, those of one photo in memory at a time: blocks are read again for each of theirs."""
    blocks_of: dict[str, list[int]] = {name: [] for name in photos}
    for number, pairs in enumerate(work):
        for name in {photo for photo, _ in pairs}:
            blocks_of[name].append(number)
    for name, numbers in blocks_of.items():
        yield name, [record for number in numbers for record in store.read(number) if record.pair[0] == name]


def _options_of_run(options: LocalizeOptions, results: Results) -> MatchOptions:
    """How the run matched, for the photos."""
    run = starting_options(results.folder / "options.json", None)
    return replace(
        run,
        images=options.images,
        output=options.output,
        pairs=options.pairs,
        cameras=options.cameras,
        labels=options.labels or run.labels,
        area_matcher=options.area_matcher or run.area_matcher,
        device=str(find_device(options.device, "--device")),
        threads=options.threads,
        rigs=None,
        database=None,
        mapping=False,
        executor="local",
        shard="",
    )


def _read_inputs(
    options: LocalizeOptions, results: Results, model: pycolmap.Reconstruction, stages: Stages
) -> tuple[Inputs, tuple[str, ...]]:
    """Photos and references as one collection, and the names of the photos that are in a pair."""
    found = read_images(options.images, options.output, stages, options.max_image_size)
    photos, failed = found.images, found.failed
    posed = {image.name: image for image in map(model.image, model.reg_image_ids())}
    _require_usable(options, results, photos, posed)
    with stages.stage("Reading cameras", None):
        imported = import_cameras(
            options.output / "cameras.db",
            options.images,
            tuple(photos),
            CameraOptions(
                model=options.camera_model,
                params=options.camera_params or None,
                mode=options.camera_mode,
                cameras=options.cameras,
            ),
        )
    for name, reason in imported.failures.items():
        failed[name] = f"'{name}': {reason}"
        del photos[name]
    if not photos:
        raise InputError(f"none of the {len(failed)} photos in '{options.images}' can be used: {min(failed.values())}")
    pairs = _pairs(options, results, tuple(photos), tuple(failed), sorted(posed))
    used = {name for pair in pairs.pairs for name in pair}
    for name in sorted(photos.keys() - used):
        failed[name] = f"'{name}' is in no pair with an image of the model; name some in --pairs"
    references = sorted(used & posed.keys())
    with stages.stage("Reading references", len(references)) as advance:
        images = {name: file for name, file in photos.items() if name in used}
        for name in references:
            images[name] = inspect_image(results.images, name, results.max_image_size)
            advance(1)
    cameras = {name: imported.cameras[name] for name in images if name in photos}
    cameras |= {name: _camera_in_model(posed[name], model) for name in references}
    inputs = Inputs(images=images, cameras=cameras, failed=failed, num_other_files=found.num_other_files, pairs=pairs)
    return inputs, tuple(sorted(photos.keys() & used))


def _require_usable(
    options: LocalizeOptions, results: Results, photos: Iterable[str], posed: Mapping[str, pycolmap.Image]
) -> None:
    missing = sorted(posed.keys() - {*results.names})
    if not posed or missing:
        what = f"image '{missing[0]}' of the model is" if missing else "the model has no image with a pose that is"
        raise InputError(f"{what} not among the images of '{results.folder}'; give --model and the run it came from")
    twice = sorted(posed.keys() & {*photos})
    if twice:
        raise InputError(
            f"photo '{twice[0]}' in '{options.images}' has the name of an image of the model; put the photos into a "
            "sub-folder of --images, so that names differ"
        )


def _pairs(
    options: LocalizeOptions, results: Results, photos: tuple[str, ...], failed: tuple[str, ...], posed: list[str]
) -> PairList:
    """Pairs of a photo and a reference, in this order."""
    if options.pairs is None:
        if len(posed) > _MAX_REFERENCES:
            raise InputError(
                f"the model has {len(posed)} images; matching a photo with all of them is meant for at most "
                f"{_MAX_REFERENCES}: name `photo reference` pairs in a file and pass it with --pairs"
            )
        return PairList(pairs=tuple(product(photos, posed)))
    unusable = (*failed, *sorted({*results.names} - {*posed, *photos}))  # no pose is no use, either
    listed = set_aside(read_pairs(options.pairs, (*photos, *posed, *unusable)), unusable)
    known = {*photos}
    for pair in listed.pairs:
        if len(known.intersection(pair)) != 1:
            what = "two photos" if known.issuperset(pair) else "two images of the model"
            raise InputError(f"{options.pairs} pairs '{pair[0]}' with '{pair[1]}', {what}; expected `photo reference`")
    if not listed.pairs:
        raise InputError(f"{options.pairs} has no pair of a photo that can be used and an image with a pose")
    return replace(listed, pairs=tuple(pair if pair[0] in known else pair[::-1] for pair in listed.pairs))


def _camera_in_model(image: pycolmap.Image, model: pycolmap.Reconstruction) -> CameraInfo:
    """The camera of a reference, as mapping has refined it."""
    camera = model.camera(image.camera_id)
    return CameraInfo(
        image_id=image.image_id,
        camera_id=image.camera_id,
        model=camera.model_name,
        params=tuple(map(float, camera.params)),
        width=camera.width,
        height=camera.height,
        has_prior_focal=True,
        known=True,
    )


def _correspondences(
    record: PairRecord, landmarks: Callable[[str], Landmarks], options: LocalizeOptions, run: MatchOptions
) -> Correspondences:
    result = record.result
    if result is None or result.two_view is None:
        return joined([])
    trusted = residuals(result.two_view.F, result.matches) <= run.geometry.max_residual
    return carry_to_landmarks(result.matches, landmarks(record.pair[1]), trusted, options.radius_px)


def _locate(info: CameraInfo, records: list[PairRecord], found: Correspondences, options: LocalizeOptions) -> _Query:
    matches = sum(len(record.result.matches) for record in records if record.result is not None)
    errors = [record.error for record in records if record.error]
    pose = estimate_pose(found, camera_of_info(info), max_error_px=options.max_error_px, seed=options.seed)
    agree, points = 0 if pose is None else pose.num_points, len(np.unique(found.ids))
    needed = f"{options.min_inliers} are needed (--min-inliers)"
    reason = ""
    if len(errors) == len(records):
        reason = errors[0]
    elif points < options.min_inliers:
        tried = f"{counted(matches, 'match')} with {counted(len(records), 'reference')}"
        reason = f"{tried} show {counted(points, 'point')} of the model; {needed}"
    elif agree < options.min_inliers:
        reason = f"{agree} of {counted(points, 'point')} of the model agree with one pose; {needed}"
    pose = None if reason else pose
    return _Query(
        references=len(records),
        matches=matches,
        correspondences=len(found.ids),
        seen=joined([]) if pose is None else found.select(_one_for_each_point(found, pose)),
        pose=pose,
        reason=reason,
    )


def _one_for_each_point(found: Correspondences, pose: Pose) -> np.ndarray:
    """Rows of the correspondences that agree with the pose."""
    inliers = np.flatnonzero(pose.inliers)
    _, first = np.unique(found.ids[inliers], return_index=True)
    rows: np.ndarray = inliers[first]
    return rows


def _told(query: _Query) -> dict[str, Any]:
    pose = query.pose
    return {
        "references": query.references,
        "matches": query.matches,
        "correspondences": query.correspondences,
        "inliers": 0 if pose is None else int(pose.inliers.sum()),
        "points": 0 if pose is None else pose.num_points,
        "camera": None if pose is None else {"model": pose.camera.model_name, "params": pose.camera.params.tolist()},
        "reason": query.reason,
    }


def _write_poses(output: Path, poses: Mapping[str, Pose]) -> None:
    """OUT/poses.txt, `name qw qx qy qz tx ty tz` a line as hloc has it, and OUT/poses.csv."""
    lines = []
    for name, pose in poses.items():
        x, y, z, w = pose.cam_from_world.rotation.quat
        numbers = " ".join(f"{value:.17g}" for value in (w, x, y, z, *pose.cam_from_world.translation))
        lines.append(f"{name} {numbers}\n")
    with replacing(output / "poses.txt") as partial:
        partial.write_text("".join(lines), encoding="utf-8")
    views = (
        TrueView(
            name=name,
            width=pose.camera.width,
            height=pose.camera.height,
            camera_matrix=np.asarray(pose.camera.calibration_matrix(), np.float64),
            cam_from_world=np.asarray(pose.cam_from_world.matrix(), np.float64),
        )
        for name, pose in poses.items()
    )
    write_camera_table(output / "poses.csv", views)


def _write_model(
    folder: Path, model: pycolmap.Reconstruction, queries: Mapping[str, _Query], cameras: Mapping[str, CameraInfo]
) -> None:
    """The model with the photos that have a pose, and what they see of its points."""
    next_camera = max([*model.cameras, *model.rigs]) + 1
    next_image = max([*model.images, *model.frames]) + 1
    camera_ids: dict[int, int] = {}
    for name, query in queries.items():
        pose, info = query.pose, cameras[name]
        if pose is None:
            continue
        if info.camera_id not in camera_ids or not info.has_prior_focal:  # an estimated focal length is the photo's own
            camera = deepcopy(pose.camera)
            camera.camera_id = camera_ids[info.camera_id] = next_camera
            model.add_camera_with_trivial_rig(camera)
            next_camera += 1
        image = pycolmap.Image(name, query.seen.pixels, camera_ids[info.camera_id], next_image)
        model.add_image_with_trivial_frame(image, pose.cam_from_world)
        for column, point in enumerate(query.seen.ids.tolist()):
            model.add_observation(point, pycolmap.TrackElement(next_image, column))
        next_image += 1
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    model.write_binary(partial)
    shutil.rmtree(folder, ignore_errors=True)
    partial.rename(folder)
