"""The whole run: photos and a pair list in, a COLMAP database and model out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from sgam_core import PointMatcher
from sgam_core.errors import OptionError
from sgam_sfm.appending import Stamp, append_to_database, replace_database, stamp_of
from sgam_sfm.assembly import build_models, merged_records, verify_pairs, write_for_hloc
from sgam_sfm.database import write_database
from sgam_sfm.files import write_json
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.label_maps import make_label_maps
from sgam_sfm.label_set import RECORD
from sgam_sfm.machine import find_device, peak_memory_mb, use_threads
from sgam_sfm.mapping import MappingOptions, MappingSummary, VerificationOptions, VerificationSummary
from sgam_sfm.matching import CollectionMatcher, create_area_matcher, create_matcher, match_blocks
from sgam_sfm.options import NOT_IN_RESULTS, VERSION, MatchOptions, as_json, fingerprint
from sgam_sfm.pairs import blocks
from sgam_sfm.progress import Stages
from sgam_sfm.run_record import recording
from sgam_sfm.store import PairStore
from sgam_sfm.summary import CountedPairs, summarise_images, summarise_keypoints, summarise_pairs, versions

KNOWN_CAMERAS = "known_cameras"
"""In inputs.json: the images whose camera the user gave."""


def match_collection(
    options: MatchOptions, stages: Stages | None = None, point_matcher: PointMatcher | None = None
) -> dict[str, Any]:
    """Match a collection and reconstruct it with COLMAP; started again, it continues where it stopped.

    Args: stages shows progress and keeps times; none by default. point_matcher: in place of the one that the options
        name, and equal to it in what it returns.
    Returns: the content of OUT/summary.json.
    Raises: SGAMError for what cannot be used at all. Single images and pairs that fail are counted in the summary.
    """
    with recording(options.output, stages := stages or Stages(quiet=True)):
        return _match_collection(options, stages, point_matcher)


def _match_collection(options: MatchOptions, stages: Stages, point_matcher: PointMatcher | None) -> dict[str, Any]:
    options = replace(options, device=str(find_device(options.device, "--device")))
    use_threads(options.threads)
    point_matcher = point_matcher or create_matcher(options)
    needs_labels = create_area_matcher(options).needs_labels or bool(options.mask_matches)
    output = options.output

    existing = None if options.database is None else _stamp(options.database, output)
    inputs = read_inputs(options, stages)
    store = open_store(options, inputs)
    labels = make_label_maps(options, inputs.images, stages) if needs_labels else None
    work = blocks(inputs.pairs.pairs, options.block_images)
    matcher = CollectionMatcher(options, inputs, labels, point_matcher)
    steps = match_blocks(work, store, matcher, stages)

    with stages.stage("Merging keypoints", None):
        counted = CountedPairs(store.read_all(len(work)))
        with merged_records(counted, options.keypoints, options.geometry.max_residual, output) as merged:
            write = write_database if existing is None else append_to_database
            write(output / "database.db", output / "cameras.db", merged.keypoints, merged.matches)
            write_for_hloc(merged, output)
            keypoints = summarise_keypoints(merged)
    verified, mapped = reconstruct(options, inputs, stages, existing)

    summary = {
        "images": summarise_images(inputs),
        "pairs": summarise_pairs(inputs, counted, verified),
        "labels": {} if labels is None else {"failed": labels.set.failed, **labels.set.facts},
        "keypoints": keypoints,
        "models": [] if mapped is None else mapped.models,
        "no_model": "mapping was not asked for (--no-mapping)" if mapped is None else mapped.reason,
        "seconds": stages.seconds,
        "matching_seconds": steps,
        "peak_memory_mb": {
            "matching": peak_memory_mb(),
            "verification": verified.peak_memory_mb,
            "mapping": None if mapped is None else mapped.peak_memory_mb,
        },
        "device": options.device,
        "versions": versions(),
    }
    written: dict[str, Any] = write_json(output / "summary.json", summary)
    return written


def open_store(options: MatchOptions, inputs: Inputs) -> PairStore:
    """The store of raw results in OUT, bound to options and inputs, which are written to OUT as JSON.

    Raises: OptionError when OUT was begun with others, naming them.
    """
    mark = fingerprint(options, images=inputs.digests, pairs=inputs.pairs.pairs, cameras=inputs.cameras)
    path = options.output / "options.json"
    now = as_json(options) | {"fingerprint": mark}
    if path.exists():
        before = _read_options(path)
        if before.get("fingerprint") != mark:
            if any((options.output / "pairs").glob("*.h5")):
                raise OptionError(
                    f"'{options.output}' was begun with other {difference(before, now)}; choose a new --output folder"
                )
            (options.output / "labels" / RECORD).unlink(missing_ok=True)  # nothing is matched yet: begin anew
    write_json(path, now)
    given = sorted(name for name, camera in inputs.cameras.items() if camera.known)
    known = {"images": inputs.digests, "failed": inputs.failed, KNOWN_CAMERAS: given}
    listed = {"pairs": inputs.pairs.pairs, "left_out": inputs.pairs.unreadable}
    write_json(options.output / "inputs.json", known | listed)
    return PairStore(folder=options.output / "pairs", fingerprint=mark)


def difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Which options differ, for a message; the images or pairs when none does."""
    there, here = _flags(before), _flags(now)
    changed = [
        f"{flag} ({there.get(flag)} there, {value} here)" for flag, value in here.items() if there.get(flag) != value
    ]
    return ", ".join(changed) or "images, pairs or cameras"


def _read_options(path: Path) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise OptionError(f"'{path}' is damaged ({error}); choose a new --output folder") from error
    return content


def _flags(options: dict[str, Any], prefix: str = "--") -> dict[str, Any]:
    """Nested options by the flags that set them, those left out that results do not follow from."""
    flat: dict[str, Any] = {}
    for name, value in options.items():
        if prefix == "--" and name in NOT_IN_RESULTS | {"fingerprint"}:
            continue
        flag = "version of sgam-sfm" if name == VERSION else prefix + name.replace("_", "-")
        flat |= _flags(value, "--" if name == "crop" else f"{flag}.") if isinstance(value, dict) else {flag: value}
    return flat


def _stamp(database: Path, output: Path) -> Stamp:
    if database.resolve() == (output / "database.db").resolve():
        raise OptionError(f"--database '{database}' is what the run writes itself; leave it out, or choose another one")
    return stamp_of(database)


def reconstruct(
    options: MatchOptions, inputs: Inputs, stages: Stages, existing: Stamp | None = None
) -> tuple[VerificationSummary, MappingSummary | None]:
    """COLMAP's verification, then its mapper unless --no-mapping.

    Args: existing: stamp of the --database that OUT/database.db was made from, which it replaces once it is verified.
    """
    database = options.output / "database.db"
    verification = VerificationOptions(seed=options.seed, threads=options.threads or -1)
    verified = verify_pairs(database, verification, stages, anew=existing is None)
    if options.database is not None and existing is not None:
        replace_database(options.database, database, existing)
        ours = {frozenset(pair) for pair in inputs.pairs.pairs}
        inliers = {pair: count for pair, count in verified.inliers.items() if frozenset(pair) in ours}
        verified = replace(verified, inliers=inliers)
    if not options.mapping:
        return verified, None
    mapped = build_models(
        database,
        options.images,
        options.output / "sparse",
        MappingOptions(mapper=options.mapper, refine_intrinsics=options.refine_intrinsics, seed=options.seed),
        stages,
        known_camera_ids={camera.camera_id for camera in inputs.cameras.values() if camera.known},
    )
    return verified, mapped
