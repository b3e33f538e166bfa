"""Keypoints, database and model anew from what a run has matched: the work of `aggregate` and `reconstruct`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sgam_core.errors import InputError, OptionError
from sgam_sfm.colmap.appending import stamp_of
from sgam_sfm.colmap.database import copy_database, write_database
from sgam_sfm.colmap.mapping import MappingOptions
from sgam_sfm.colmap.reading import read_camera_ids
from sgam_sfm.colmap.verification import VerificationOptions
from sgam_sfm.files import write_json
from sgam_sfm.inputs import refuse_among_images
from sgam_sfm.machine import use_threads
from sgam_sfm.options import starting_options
from sgam_sfm.progress import Stages
from sgam_sfm.runs.assembly import build_models, merged_records, verify_pairs, write_for_hloc
from sgam_sfm.runs.results import json_object, open_results
from sgam_sfm.runs.run_record import recording
from sgam_sfm.runs.runner import KNOWN_CAMERAS
from sgam_sfm.runs.store import read_pairs_of, stored_files
from sgam_sfm.runs.summary import summarise_keypoints, summarise_models, versions
from sgam_sfm.stage_options import AggregateOptions, ReconstructOptions


def reconstruct(options: ReconstructOptions, stages: Stages | None = None) -> dict[str, Any]:
    """Make the model anew from a database that has matches.

    Returns: the content of reconstruct.json.
    Raises: SGAMError for what cannot be used.
    """
    source = source_of(options)
    with recording(source.output, stages := stages or Stages(quiet=True), "reconstruct"):
        source.carry_over()
        if source.database != source.written:
            copy_database(source.database, source.written)
        content = _verify_and_map(options, source, stages, anew=False, mapping=True)
        source.keep({"mapper": options.mapper, "refine_intrinsics": options.refine_intrinsics}, content)
        written: dict[str, Any] = write_json(source.output / "reconstruct.json", content)
    return written


def aggregate(options: AggregateOptions, stages: Stages | None = None) -> dict[str, Any]:
    """Merge the raw matches of a run again, verify them and make the model anew.

    Returns: the content of aggregate.json.
    Raises: SGAMError for what cannot be used.
    """
    source, folder = source_of(options), options.results
    with recording(source.output, stages := stages or Stages(quiet=True), "aggregate"):
        source.carry_over()
        use_threads(options.threads)
        run = starting_options(folder / "options.json", None)
        with stages.stage("Merging keypoints", None):
            records, limit = read_pairs_of(folder), run.geometry.max_residual
            folders = (source.output, source.images, run.mask_path)
            with merged_records(records, options.keypoints, limit, *folders) as merged:
                write_database(source.written, folder / "cameras.db", merged.keypoints, merged.matches)
                write_for_hloc(merged, source.output, large=options.hloc)
                content: dict[str, Any] = {"keypoints": summarise_keypoints(merged)}
        content |= _verify_and_map(options, source, stages, anew=True, mapping=options.mapping)
        source.keep({"keypoints": asdict(options.keypoints)}, content)
        written: dict[str, Any] = write_json(source.output / "aggregate.json", content)
    return written


@dataclass(frozen=True, kw_only=True, slots=True)
class Source:
    """What a model is made from, and where it goes.

    results: folder of the run, None for a database of any program. known_cameras: images whose camera the user gave.
    """

    results: Path | None
    database: Path
    images: Path
    output: Path
    known_cameras: frozenset[str]

    @property
    def written(self) -> Path:
        """The database that is worked on."""
        return self.output / "database.db"

    @property
    def in_place(self) -> bool:
        """Whether the results go into the folder of the run."""
        return self.results is not None and self.results.resolve() == self.output.resolve()

    def known_camera_ids(self) -> set[int]:
        """Cameras that mapping holds fixed unless it is to refine them."""
        return {camera for name, camera in read_camera_ids(self.written).items() if name in self.known_cameras}

    def carry_over(self) -> None:
        """Make another output folder one that these commands read too."""
        if self.results is not None and not self.in_place:
            for name in ("options.json", "inputs.json"):
                write_json(self.output / name, json_object(self.results / name))

    def keep(self, options: Mapping[str, Any], content: Mapping[str, Any]) -> None:
        """Write into the record of a run what holds from now on; `match` does not know the mapper triangulate."""
        if self.results is None:
            return
        changes = {name: value for name, value in options.items() if value != "triangulate"}
        write_json(self.output / "options.json", json_object(self.output / "options.json") | changes)
        summary = json_object(self.output / "summary.json")
        if summary:
            pairs = summary.get("pairs", {}) | {"verified": content["verified"], "inliers": content["inliers"]}
            names = ("models", "no_model", "without_pose", "keypoints")
            changed = {name: content[name] for name in names if name in content}
            write_json(self.output / "summary.json", summary | {"pairs": pairs} | changed)


def source_of(options: ReconstructOptions | AggregateOptions) -> Source:
    """What the options name, checked; nothing is written yet.

    Raises: InputError when it cannot be used as it is; OptionError when the output folder is not free.
    """
    source = _any_database(options) if isinstance(options, ReconstructOptions) and options.database else _run(options)
    refuse_among_images(source.output, source.images)
    there = json_object(source.output / "options.json").get("fingerprint")
    ours = json_object(source.results / "options.json").get("fingerprint") if source.results else None
    another_run = there is not None and (there != ours or bool(stored_files(source.output)))
    if another_run and not source.in_place:
        raise OptionError(f"'{source.output}' holds another run; choose a new --output folder")
    return source


def _run(options: ReconstructOptions | AggregateOptions) -> Source:
    assert options.results is not None
    results = open_results(options.results, options.images)
    inputs = json_object(results.folder / "inputs.json")
    if KNOWN_CAMERAS not in inputs:
        raise InputError(
            f"'{results.folder}' does not say which cameras are known; start the same match again (no pair is matched "
            "twice)"
        )
    if isinstance(options, AggregateOptions):
        if results.options.get("database"):
            raise OptionError(
                f"'{results.folder}' was matched into --database '{results.options['database']}', where keypoints keep "
                "their rows; start the same match with other --keypoints options and a --database without ours"
            )
        waiting = {(a, b) for a, b in inputs["pairs"]} - results.blocks.keys()
        if waiting:
            raise InputError(
                f"{len(waiting)} of {len(inputs['pairs'])} pairs have no result in '{results.folder / 'pairs'}'; start "
                "the same match again, it continues where it stopped"
            )
    return Source(
        results=results.folder,
        database=results.folder / "database.db" if isinstance(options, AggregateOptions) else results.database(),
        images=results.images,
        output=options.output or results.folder,
        known_cameras=frozenset(inputs[KNOWN_CAMERAS]),
    )


def _any_database(options: ReconstructOptions) -> Source:
    assert options.database is not None
    assert options.images is not None
    assert options.output is not None
    if not options.images.is_dir():
        raise InputError(f"the image folder '{options.images}' does not exist; check --images")
    source = Source(
        results=None,
        database=options.database,
        images=options.images,
        output=options.output,
        known_cameras=frozenset(),
    )
    if source.database.resolve() == source.written.resolve():
        raise OptionError(f"--database '{source.database}' would be overwritten by its copy; choose another --output")
    stamp_of(source.database)  # refuses what the installed COLMAP cannot read
    return source


def _verify_and_map(
    options: ReconstructOptions | AggregateOptions, source: Source, stages: Stages, *, anew: bool, mapping: bool
) -> dict[str, Any]:
    verification = VerificationOptions(seed=options.seed, threads=options.threads or -1)
    verified = verify_pairs(source.written, verification, stages, anew=anew)
    mapped = None
    if mapping:
        mapped = build_models(
            source.written,
            source.images,
            source.output / "sparse",
            MappingOptions(mapper=options.mapper, refine_intrinsics=options.refine_intrinsics, seed=options.seed),
            stages,
            known_camera_ids=source.known_camera_ids(),
            input_model=options.input_model,
        )
    return {
        "options": options,
        "database": source.database,
        "pairs": verified.num_pairs,
        "verified": len(verified.inliers),
        "inliers": sum(verified.inliers.values()),
        **summarise_models(mapped, source.written),
        "seconds": stages.seconds,
        "peak_memory_mb": {
            "verification": verified.peak_memory_mb,
            "mapping": None if mapped is None else mapped.peak_memory_mb,
        },
        "versions": versions(),
    }
