"""The whole run: photos and a pair list in, a COLMAP database and model out."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from sgam_core import PointMatcher
from sgam_core.errors import OptionError
from sgam_sfm.colmap.appending import Stamp, append_to_database, replace_database, stamp_of
from sgam_sfm.colmap.database import is_whole, write_database
from sgam_sfm.colmap.mapping import MappingOptions, MappingSummary
from sgam_sfm.colmap.verification import VerificationOptions, VerificationSummary
from sgam_sfm.executors import MatchingJob, open_executor
from sgam_sfm.files import write_json
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.label_maps import make_label_maps, segmenter_of_run
from sgam_sfm.machine import peak_memory_mb
from sgam_sfm.options import MatchOptions, as_json, fingerprint
from sgam_sfm.pairs import Pair, blocks
from sgam_sfm.progress import Stages
from sgam_sfm.runs.assembly import build_models, merged_records, verify_pairs, write_for_hloc
from sgam_sfm.runs.block_matching import count_outcomes, match_blocks
from sgam_sfm.runs.differences import difference, goes_on
from sgam_sfm.runs.matching import create_area_matcher, special_labels
from sgam_sfm.runs.results import json_object
from sgam_sfm.runs.run_record import recording
from sgam_sfm.runs.shards import Shard
from sgam_sfm.runs.store import PairStore, stored_files
from sgam_sfm.runs.summary import (
    CountedPairs,
    summarise_images,
    summarise_keypoints,
    summarise_models,
    summarise_pairs,
    versions,
)

_log = logging.getLogger(__name__)
_WITHOUT_EFFECT = frozenset({"output", "config", "threads", "verbose", "log_json", "accept_licence", "retry_failed"})

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
    with recording(options.output, stages := stages or Stages(quiet=True)) as before:
        ended_well = before is not None and before.state == "done"
        return _match_collection(options, stages, point_matcher, ended_well)


def _match_collection(
    options: MatchOptions, stages: Stages, point_matcher: PointMatcher | None, ended_well: bool
) -> dict[str, Any]:
    needs_labels = create_area_matcher(options).needs_labels or bool(options.mask_matches)
    existing = stamp_of_existing(options)
    with open_executor(options, point_matcher) as executor:
        options = replace(options, device=executor.device)
        segmenting = replace(options, device=executor.own_device)
        segmenter = segmenter_of_run(segmenting) if needs_labels else None  # what it lacks is said before work begins
        inputs = read_inputs(options, stages)
        stages.counts.update(images=len(inputs.images), images_failed=len(inputs.failed), pairs=len(inputs.pairs.pairs))
        same = ended_well and same_options(options)
        store = open_store(options, inputs)
        work = blocks(inputs.pairs.pairs, options.block_images)
        if same and (summary := finished(options, store, work)) is not None:
            count_outcomes(stages, store, range(len(work)))
            if not stages.quiet:
                again = "`sgam-sfm reconstruct` makes the model anew"
                told = f"'{options.output}' is complete, and nothing has changed since; {again}"
                stages.console.print(told, soft_wrap=True)
            return summary
        (options.output / "summary.json").unlink(missing_ok=True)  # of a run that this one goes on from
        labels = make_label_maps(segmenting, inputs.images, stages, segmenter) if needs_labels else None
        special_labels(options, labels)
        del segmenter  # its memory is the matcher's from here on
        share = Shard.parse(options.shard).blocks(work) if options.shard else range(len(work))
        job = MatchingJob(options=options, inputs=inputs, labels=labels)
        steps = match_blocks(work, store, executor, job, stages, share)
        facts = {"executor": executor.facts(), "matching_seconds": steps}
    if options.shard:
        return _summarise_shard(job, store, share, facts, stages)
    return assemble(job, store, len(work), facts, stages, existing)


def _summarise_shard(
    job: MatchingJob, store: PairStore, share: range, facts: dict[str, Any], stages: Stages
) -> dict[str, Any]:
    """What is known of a run that stops before merging, as OUT/summary.json."""
    nothing = VerificationSummary(inliers={}, num_pairs=0, seconds=0.0, peak_memory_mb=None)
    counted = CountedPairs(record for number in share for record in store.read(number))
    for _ in counted:
        pass
    summary = {
        "shard": {"shard": job.options.shard, "blocks": len(share)},
        "images": summarise_images(job.inputs),
        "pairs": summarise_pairs(job.inputs, counted, nothing),
        "labels": _summarise_labels(job),
        "models": [],
        "no_model": f"shard {job.options.shard} has its own pairs only; `sgam-sfm join` puts all shards together",
        "seconds": stages.seconds,
        **facts,
        "peak_memory_mb": {"matching": peak_memory_mb()},
        "device": job.options.device,
        "versions": versions(),
    }
    written: dict[str, Any] = write_json(job.options.output / "summary.json", summary)
    return written


def assemble(
    job: MatchingJob, store: PairStore, num_blocks: int, facts: dict[str, Any], stages: Stages, existing: Stamp | None
) -> dict[str, Any]:
    """Keypoints, database and model from a store that holds all blocks.

    Args: facts: what the summary is to say of the matching. existing: stamp of --database, see `reconstruct`.
    Returns: the content of OUT/summary.json.
    """
    options, inputs, output = job.options, job.inputs, job.options.output
    with stages.stage("Merging keypoints", None):
        counted = CountedPairs(store.read_all(num_blocks))
        limit, folders = options.geometry.max_residual, (output, options.images, options.mask_path)
        with merged_records(counted, options.keypoints, limit, *folders) as merged:
            write = write_database if existing is None else append_to_database
            write(output / "database.db", output / "cameras.db", merged.keypoints, merged.matches)
            write_for_hloc(merged, output)
            keypoints = summarise_keypoints(merged)
    verified, mapped = reconstruct(options, inputs, stages, existing)

    summary = {
        "images": summarise_images(inputs),
        "pairs": summarise_pairs(inputs, counted, verified),
        "labels": _summarise_labels(job),
        "keypoints": keypoints,
        **summarise_models(mapped, output / "database.db"),
        "seconds": stages.seconds,
        **facts,
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


def same_options(options: MatchOptions) -> bool:
    """Whether OUT was made with these very options, those of merging and mapping too."""
    before = json_object(options.output / "options.json")
    now = json.loads(json.dumps(as_json(options)))
    return all(before.get(name) == value for name, value in now.items() if name not in _WITHOUT_EFFECT)


def finished(options: MatchOptions, store: PairStore, work: Sequence[Sequence[Pair]]) -> dict[str, Any] | None:
    """The summary of a run in OUT that ended well and whose results are all still there, None when one is not.

    A run into --database is never finished: what it wrote into may have been changed since. Nor is one with failed
    pairs that are to be matched once more.
    """
    output = options.output
    summary = json_object(output / "summary.json")
    files = ("database.db", "keypoints.h5", *(f"sparse/{model['folder']}" for model in summary.get("models", ())))
    if not summary or options.database is not None or not all((output / name).exists() for name in files):
        return None
    if not is_whole(output / "database.db") or not all(store.has(index, block) for index, block in enumerate(work)):
        return None
    if options.retry_failed and summary["pairs"]["failed"]:
        return None
    _log.info("nothing has changed since this run was finished")
    return summary


def _summarise_labels(job: MatchingJob) -> dict[str, Any]:
    return {} if job.labels is None else {"failed": job.labels.set.failed, **job.labels.set.facts}


def fingerprint_of(options: MatchOptions, inputs: Inputs) -> str:
    """Of all that the raw results of a run follow from, as its options.json has it."""
    return fingerprint(options, images=inputs.digests, pairs=inputs.pairs.pairs, cameras=inputs.cameras)


def open_store(options: MatchOptions, inputs: Inputs) -> PairStore:
    """The store of raw results in OUT, bound to options and inputs, which are written to OUT as JSON.

    An options.json that the disk has damaged is written anew: every block knows its own fingerprint.
    Raises: OptionError when OUT was begun with others, naming them, or holds another shard.
    """
    mark = fingerprint_of(options, inputs)
    path, database = options.output / "options.json", options.output / "database.db"
    now, known = as_json(options) | {"fingerprint": mark}, _as_json(inputs)
    if path.exists():
        before = json_object(path)
        if not before:
            _log.warning("'%s' is damaged, and is written anew", path)
        if before.get("fingerprint") != mark and before and stored_files(options.output):
            there, here = (before, json_object(options.output / "inputs.json")), (now, known)
            told = f"'{options.output}' was begun with other {difference(there, here)}; choose a new --output folder"
            later = goes_on(there, here) and database.is_file()
            raise OptionError(told + (f", and list the later pairs alone, with --database {database}" if later else ""))
        other = before.get("shard", "")
        if options.shard and other not in ("", options.shard):
            raise OptionError(
                f"'{options.output}' holds shard {other}, not {options.shard}; give each shard an --output folder of "
                "its own"
            )
    write_json(path, now)
    write_json(options.output / "inputs.json", known)
    return PairStore(folder=options.output / "pairs", fingerprint=mark)


def _as_json(inputs: Inputs) -> dict[str, Any]:
    """What OUT/inputs.json says."""
    given = sorted(name for name, camera in inputs.cameras.items() if camera.known)
    known = {"images": inputs.digests, "failed": inputs.failed, KNOWN_CAMERAS: given}
    return known | {"pairs": inputs.pairs.pairs, "left_out": inputs.pairs.unreadable}


def stamp_of_existing(options: MatchOptions) -> Stamp | None:
    """The stamp of --database, None without one.

    Raises: OptionError when it is what the run writes itself.
    """
    database = options.database
    if database is None:
        return None
    if database.resolve() == (options.output / "database.db").resolve():
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
