"""The output folders of all shards of a run, put together into the output of the whole run."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sgam_core.errors import InputError, OptionError
from sgam_sfm.executors import MatchingJob
from sgam_sfm.files import replacing
from sgam_sfm.inputs import read_inputs, refuse_among_images
from sgam_sfm.label_maps import LabelMaps
from sgam_sfm.label_set import RECORD, read_label_set
from sgam_sfm.machine import use_threads
from sgam_sfm.options import MatchOptions, starting_options
from sgam_sfm.pairs import Pair, blocks
from sgam_sfm.progress import Stages
from sgam_sfm.runs.differences import Told, difference
from sgam_sfm.runs.results import json_object, open_results
from sgam_sfm.runs.run_record import recording
from sgam_sfm.runs.runner import assemble, open_store, stamp_of_existing
from sgam_sfm.runs.shards import Shard
from sgam_sfm.runs.store import PairStore
from sgam_sfm.stage_options import JoinOptions

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Part:
    """The output folder of a shard. options: content of options.json. pairs: of the whole run."""

    folder: Path
    shard: Shard
    options: dict[str, Any]
    pairs: tuple[Pair, ...]

    @property
    def store(self) -> PairStore:
        return PairStore(folder=self.folder / "pairs", fingerprint=self.options["fingerprint"])


def options_of(options: JoinOptions) -> MatchOptions:
    """The options of the whole run, as its shards have them.

    Raises: InputError for a folder that is no shard's output; OptionError for an --output that is a shard's, or lies
        among the images.
    """
    if not options.shards:
        raise OptionError("no shard was given; give the --output folders of all shards of a run")
    if options.output.resolve() in {folder.resolve() for folder in options.shards}:
        raise OptionError(f"--output '{options.output}' is the folder of a shard; choose a new one for the whole run")
    first = _read_part(options.shards[0], options.images)
    run = starting_options(first.folder / "options.json", None)
    run = replace(run, output=options.output, images=options.images or run.images, shard="", executor="local")
    refuse_among_images(run.output, run.images)
    return run


def join(options: JoinOptions, stages: Stages | None = None) -> dict[str, Any]:
    """Put the shards of a run together, then merge, verify and map as `match` does.

    Returns: the content of OUT/summary.json.
    Raises: InputError when a shard is missing or not done; OptionError when they do not belong together.
    """
    run = options_of(options)
    parts = [_read_part(folder, options.images) for folder in options.shards]
    _require_one_run(parts)
    work = blocks(parts[0].pairs, run.block_images)
    sources = _sources(parts, work)
    existing = stamp_of_existing(run)
    with recording(run.output, stages := stages or Stages(quiet=True), "join"):
        use_threads(run.threads)
        inputs = read_inputs(run, stages)
        store = open_store(run, inputs)
        if store.fingerprint != parts[0].store.fingerprint:
            raise InputError(
                f"the shards were matched with other {difference(_told(parts[0].folder), _told(run.output))}; put back "
                "what they were matched with, or match them again"
            )
        with stages.stage("Joining shards", len(work)) as advance:
            for number, part in enumerate(sources):
                if not store.has(number):
                    _link(part.store.path(number), store.path(number))
                advance(1)
            labels = _join_labels(parts, run.output / "labels")
        facts = {"executor": {"name": "shards", "shards": len(parts)}, "matching_seconds": _seconds(parts)}
        job = MatchingJob(options=run, inputs=inputs, labels=labels)
        return assemble(job, store, len(work), facts, stages, existing)


def _read_part(folder: Path, images: Path | None) -> _Part:
    """Raises: InputError when the folder is not the output of a shard."""
    results = open_results(folder, images)
    inputs = json_object(folder / "inputs.json")
    if not results.options.get("shard"):
        raise InputError(f"'{folder}' is not the output of a shard (it was matched without --shard); leave it out")
    if "pairs" not in inputs or "fingerprint" not in results.options:
        raise InputError(f"'{folder}' has not got to its pairs yet; {_again(folder)}")
    return _Part(
        folder=folder,
        shard=Shard.parse(results.options["shard"]),
        options=dict(results.options),
        pairs=tuple((name0, name1) for name0, name1 in inputs["pairs"]),
    )


def _again(folder: Path) -> str:
    return f"start it again: `sgam-sfm match --config '{folder / 'options.json'}'`"


def _told(folder: Path) -> Told:
    return json_object(folder / "options.json"), json_object(folder / "inputs.json")


def _require_one_run(parts: Sequence[_Part]) -> None:
    """Raises: OptionError when the shards were matched with other inputs or options, or are of another number."""
    first = parts[0]
    for part in parts[1:]:
        if part.options["fingerprint"] != first.options["fingerprint"]:
            raise OptionError(
                f"'{part.folder}' was matched with other {difference(_told(first.folder), _told(part.folder))} than "
                f"'{first.folder}'; join shards of one run"
            )
        if part.shard.count != first.shard.count:
            raise OptionError(
                f"'{part.folder}' is shard {part.shard} and '{first.folder}' is {first.shard}; join shards of one run"
            )


def _sources(parts: Sequence[_Part], work: Sequence[Sequence[Pair]]) -> list[_Part]:
    """The shard that holds each block. Raises: InputError when one is held by none, naming the shards at fault."""
    count = parts[0].shard.count
    by_number = {part.shard.number: part for part in parts}
    found: dict[int, _Part] = {}
    for part in parts:
        found |= {number: part for number in range(len(work)) if number not in found and part.store.has(number)}
    missing, begun = [], []
    for shard in (Shard(number=number, count=count) for number in range(1, count + 1)):
        share = shard.blocks(work)
        done = sum(number in found for number in share)
        if done < len(share):
            if shard.number in by_number:
                folder = by_number[shard.number].folder
                begun.append(f"{shard} in '{folder}' has {done} of {len(share)} blocks; {_again(folder)}")
            else:
                missing.append(str(shard))
    if missing:
        named = f"shard {missing[0]} is" if len(missing) == 1 else f"shards {', '.join(missing)} are"
        raise InputError(f"{named} missing; give the --output folders of all {count} shards")
    if begun:
        raise InputError(f"shard {'; shard '.join(begun)}")
    return [found[number] for number in range(len(work))]


def _link(source: Path, target: Path) -> None:
    """The same file under another name, or where that cannot be, a copy."""
    with replacing(target) as partial:
        try:
            os.link(source, partial)
        except OSError:
            shutil.copyfile(source, partial)


def _join_labels(parts: Sequence[_Part], folder: Path) -> LabelMaps | None:
    """The label maps of the shards, which are those of all images in each; None when there are none."""
    sets = {part.folder: (part.folder / "labels" / RECORD) for part in parts}
    made = {shard: path for shard, path in sets.items() if path.exists()}
    if not made:
        return None
    first, source = next(iter(made.items()))
    for other, path in made.items():
        if path.read_bytes() != source.read_bytes():
            _log.warning(
                "the label maps of '%s' and '%s' differ (other machines or threads?): their pairs are sound, but not "
                "those of a run without shards; segment first, then match all shards with the same --labels",
                first,
                other,
            )
    for path in sorted((first / "labels").rglob("*.png")):
        _link(path, folder / path.relative_to(first / "labels"))
    _link(source, folder / RECORD)
    return LabelMaps(folder=folder, set=read_label_set(folder))


def _seconds(parts: Sequence[_Part]) -> dict[str, float]:
    """The seconds that each step of the matching took in all shards."""
    total: dict[str, float] = {}
    for part in parts:
        for step, seconds in json_object(part.folder / "summary.json").get("matching_seconds", {}).items():
            total[step] = total.get(step, 0.0) + seconds
    return total
