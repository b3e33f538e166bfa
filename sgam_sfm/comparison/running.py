"""One run of one method, in a process of its own so that its memory and caches are its own."""

from __future__ import annotations

import logging
import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

from sgam_core import match_whole
from sgam_sfm.colmap.database import write_database
from sgam_sfm.colmap.sift_baseline import match_sift
from sgam_sfm.colmap.verification import VerificationOptions
from sgam_sfm.comparison.budget import Budget, fit_budget
from sgam_sfm.comparison.methods import Method
from sgam_sfm.exit_codes import ERROR
from sgam_sfm.files import write_json
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.label_maps import make_label_maps
from sgam_sfm.logs import logging_to
from sgam_sfm.match_cache import CachedMatcher
from sgam_sfm.options import MatchOptions
from sgam_sfm.progress import Stages
from sgam_sfm.runs.matching import CollectionMatcher, create_area_matcher
from sgam_sfm.runs.results import json_object
from sgam_sfm.runs.run_record import recording
from sgam_sfm.runs.runner import fingerprint_of, match_collection, reconstruct
from sgam_sfm.runs.summary import summarise_models

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """A run. options: of `match`. cache: folder of point matches. target: pixels to match, 0 without a budget."""

    method: Method
    options: MatchOptions
    cache: Path
    target: int = 0
    max_image_size: int = 0


def run_apart(job: Job) -> dict[str, Any]:
    """`run_method` in a new process.

    Raises: what `run_method` raises.
    """
    with new_process() as pool:
        return pool.submit(run_method, job).result()


def new_process() -> ProcessPoolExecutor:
    """A process to run one thing in, which ends when this one does, however that ends."""
    return ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn"), initializer=_end_with_parent)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(ERROR)

    Thread(target=watch, daemon=True).start()


def run_method(job: Job) -> dict[str, Any]:
    """Run a method, or find it done.

    Returns: summary (of `match`), pixels_extracted, saved_seconds (that results of earlier runs spared this one), and
        cap (why a budget was not met, empty: it was).
    """
    job.options.output.mkdir(parents=True, exist_ok=True)
    stages = Stages()
    with logging_to(job.options.output / "log.txt", stages.console, verbose=False):
        stages.console.rule(job.method.name if job.options.seed == 0 else f"{job.method.name}, seed {job.options.seed}")
        return _run_sift(job, stages) if not job.method.matcher else _run_matcher(job, stages)


def _run_matcher(job: Job, stages: Stages) -> dict[str, Any]:
    options, cap = job.options, ""
    inputs = read_inputs(options, Stages(quiet=True))
    matcher = CachedMatcher.of(options, inputs, job.cache)
    if job.target:
        budget = _fitted(job, inputs, matcher)
        options, cap = budget.options, budget.cap
        _log.info("%s: %d of %d pixels %s", job.method.name, budget.reached, budget.target, cap)
    _forget_interrupted(options, inputs)
    matcher.start()
    matcher.reset()
    summary = match_collection(options, stages, matcher)
    return {
        "summary": summary,
        "pixels_extracted": matcher.pixels_extracted,
        "saved_seconds": matcher.saved,
        "cap": cap,
    }


def _forget_interrupted(options: MatchOptions, inputs: Inputs) -> None:
    """Match from the start what was interrupted: the point matcher's results are kept, with what they cost."""
    begun = json_object(options.output / "options.json").get("fingerprint")
    if begun == fingerprint_of(options, inputs) and not (options.output / "result.json").exists():
        shutil.rmtree(options.output / "pairs", ignore_errors=True)


def _fitted(job: Job, inputs: Inputs, matcher: CachedMatcher) -> Budget:
    """The options with which the method matches as many pixels as it may."""
    area_matcher = create_area_matcher(job.options)
    whole = {}
    if job.method.area_matcher != "none":
        masked = bool(job.options.mask_matches)
        labels = make_label_maps(job.options, inputs.images, Stages(quiet=True)) if masked else None
        collection = CollectionMatcher(job.options, inputs, labels, matcher)
        for name0, name1 in inputs.pairs.pairs:
            images = (collection.image(name0), collection.image(name1))
            whole[name0, name1] = match_whole(*images, matcher, job.options.crop)
    return fit_budget(
        job.options, inputs.images, inputs.pairs.pairs, job.target, area_matcher, whole, job.max_image_size
    )


def _run_sift(job: Job, stages: Stages) -> dict[str, Any]:
    """COLMAP's own features and matches, then the same verification and mapping as for every other method."""
    options = job.options
    with recording(options.output, stages, "compare"):
        inputs = read_inputs(options, stages)
        database = options.output / "database.db"
        write_database(database, options.output / "cameras.db", {}, {})
        with stages.stage("Matching pairs", None):
            verification = VerificationOptions(seed=options.seed, threads=options.threads or -1)
            match_sift(database, options.images, inputs.pairs.pairs, verification)
        verified, mapped = reconstruct(options, inputs, stages)
        summary = {
            "images": {"used": len(inputs.images), "failed": inputs.failed},
            "pairs": {
                "listed": len(inputs.pairs.pairs),
                "matched": len(inputs.pairs.pairs),
                "verified": len(verified.inliers),
                "inliers": sum(verified.inliers.values()),
            },
            **summarise_models(mapped, database),
            "seconds": stages.seconds,
        }
        summary = write_json(options.output / "summary.json", summary)
    pixels = sum(file.width * file.height for file in inputs.images.values())
    return {"summary": summary, "pixels_extracted": pixels, "saved_seconds": 0.0, "cap": ""}
