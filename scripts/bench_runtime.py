"""What areas cost: seconds of every stage, with areas against the same matcher on whole images, as ratios of one run.

    python scripts/bench_runtime.py SCENE OUT [--pairs N] [--presets fast default] [--device cpu] [-- --matcher sift]

SCENE: a Strecha or ScanNet folder, see `scenes.py`. --pairs: as many, spread evenly over all (0: all). Options after
`--` go to all variants, but for those of the algorithm, which the presets decide. Every block of pairs is matched by
all variants in turn: whole images, then for each preset the areas and whole images of as many pixels (`none@PRESET`),
then whole images again, so that what slows the machine down slows down all. Only the ratios tell anything of another
machine. Prints a Markdown table and, last, a line of JSON. OUT/bench is begun anew.

The plain matcher extracts features once an image and block, areas are extracted once a pair: `Mpx extracted` beside
`Mpx matched` says how much of the time per pixel follows from that. Where several pairs are matched at once, the
seconds of a stage are those of all threads; `extracting` is part of what whole images and areas take.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
import tyro
from scenes import scene_options, split_options

from sgam_core import Image, PairResult, PointMatcher, WholeImages
from sgam_core.types import Crop, Matches
from sgam_sfm.comparison.budget import fit_budget
from sgam_sfm.evaluation.options import EvaluateOptions
from sgam_sfm.executors import MatchingJob
from sgam_sfm.images import read_image
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.label_maps import LabelMaps, make_label_maps
from sgam_sfm.machine import find_device, use_threads
from sgam_sfm.options import MatchOptions, with_preset
from sgam_sfm.pairs import Pair, PairList, blocks, spread_over
from sgam_sfm.progress import Stages
from sgam_sfm.runs.matching import CollectionMatcher, create_area_matcher, create_matcher, is_concurrent, reset
from sgam_sfm.runs.runner import assemble, open_store
from sgam_sfm.runs.store import PairRecord
from sgam_sfm.runs.summary import versions

PLAIN = "none"
MAX_PER_PIXEL = 1.1  # times plain's, at the same number of pixels
MAX_RATIO = {"fast": 1.5, "default": 2.0}  # times plain's, at the same input size (the paper: 4)
MAX_AREA_MATCHING = 0.02  # of the run
MAX_SEGMENTATION_SECONDS = 1.0  # an image
LARGEST = 4096  # pixels of a whole image's long side, however many there are to match
PAIR_STAGES = ("whole images", "area matching", "crops", "GP", "GR", "GMC", "guided areas")
REST = ("Merging keypoints", "Verifying pairs", "Mapping")


@dataclass
class TimedMatcher:
    """A point matcher whose seconds, of all threads, are told apart: of whole images and of areas.

    It never says that it is repeatable, so that every block, which some variants match twice, begins without features.
    """

    matcher: PointMatcher
    seconds: Counter[str] = field(default_factory=Counter)
    lock: Lock = field(default_factory=Lock)

    @property
    def concurrent(self) -> bool:
        """Whether threads may match at once."""
        return is_concurrent(self.matcher)

    def reset(self) -> None:
        """Forget what the point matcher has in memory."""
        reset(self.matcher)

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`."""
        start = time.perf_counter()
        found = self.matcher.match(pairs)
        seconds = time.perf_counter() - start
        whole = all(_is_whole(crop.image, crop) for pair in pairs for crop in pair)
        with self.lock:
            # typeshed's counters count whole things
            self.seconds["whole images matched" if whole else "areas matched"] += seconds  # type: ignore[assignment]
        return found

    @property
    def pixels_extracted(self) -> int:
        """0 where the matcher does not count them."""
        return getattr(self.matcher, "pixels_extracted", 0)

    @property
    def extracting(self) -> float:
        """Seconds of the above that went into features."""
        return getattr(getattr(self.matcher, "features", None), "seconds_extracting", 0.0)


@dataclass
class Variant:
    """One way to match all pairs, and what it took. wall: seconds of the blocks, reading of images included."""

    name: str
    options: MatchOptions
    timed: TimedMatcher
    collection: CollectionMatcher
    records: dict[int, list[PairRecord]] = field(default_factory=dict)
    wall: list[float] = field(default_factory=list)
    seconds: Counter[str] = field(default_factory=Counter)
    rounds: int = 1

    @staticmethod
    def of(name: str, options: MatchOptions, inputs: Inputs, labels: LabelMaps | None) -> Variant:
        """A variant with a point matcher of its own."""
        timed = TimedMatcher(create_matcher(options))
        return Variant(name, options, timed, CollectionMatcher(options, inputs, labels, timed))

    def match(self, number: int, block: Sequence[Pair]) -> None:
        """Match a block, timed."""
        start = time.perf_counter()
        records = [record for _, record in self.collection.match_blocks([(number, block)], lambda _: None)]
        self.wall.append(time.perf_counter() - start)
        self.records[number] = records
        for result in results_of(records):
            self.seconds.update({stage: s for stage, s in result.seconds.items() if stage in PAIR_STAGES})

    @property
    def pixels(self) -> int:
        """Matched, over all pairs."""
        return sum(result.pixels_matched for records in self.records.values() for result in results_of(records))

    def figures(self) -> dict[str, float]:
        """Seconds by stage of one pass over all pairs, their sum as measured, and pixels."""
        seconds = {**self.seconds, **self.timed.seconds, "extracting": self.timed.extracting}
        stages = {stage: s / self.rounds for stage, s in seconds.items()}
        told = {"matching pairs": sum(self.wall) / self.rounds}
        pixels = {"Mpx matched": self.pixels / 1e6, "Mpx extracted": self.timed.pixels_extracted / 1e6 / self.rounds}
        return stages | told | pixels


def main() -> None:
    """Match with all variants, print the table and the targets."""
    own, passed_on = split_options(sys.argv[1:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--pairs", type=int, default=0)
    parser.add_argument("--presets", nargs="+", default=["fast", "default"])
    parser.add_argument("--device", default="auto", help="auto: CUDA where there is one")
    arguments = parser.parse_args(own)
    flags = [*scene_options(arguments.scene), "--output", str(arguments.out), "--device", arguments.device, *passed_on]
    options = tyro.cli(EvaluateOptions, args=flags).matching
    work = arguments.out / "bench"  # begun anew: label maps that are there would take no time
    shutil.rmtree(work, ignore_errors=True)
    options = replace(options, output=work, device=str(find_device(options.device, "--device")))
    content = measured(options, arguments.presets, arguments.pairs)
    print(table(content["variants"], content["once"]))
    for target in content["targets"]:
        verdict = "met" if target["met"] else "missed"
        print(f"\n{verdict}: {target['name']}: {target['value']:.3g}, at most {target['limit']:g}")
    print("\n" + json.dumps(content))


def measured(options: MatchOptions, presets: Sequence[str], num_pairs: int) -> dict[str, Any]:
    """Everything that is measured, as JSON."""
    use_threads(options.threads)
    once: dict[str, float] = {}
    stages = Stages(quiet=True)
    inputs = read_inputs(options, stages)
    chosen = tuple(spread_over(inputs.pairs.pairs, num_pairs))
    used = {name for pair in chosen for name in pair}
    images = {name: file for name, file in inputs.images.items() if name in used}
    inputs = replace(inputs, images=images, pairs=PairList(pairs=chosen))
    labels = make_label_maps(options, images, stages)
    once["reading inputs"] = stages.seconds.get("Reading images", 0.0) + stages.seconds.get("Reading cameras", 0.0)
    once["segmenting images"] = sum(s for name, s in stages.seconds.items() if not name.startswith("Reading"))
    once["decoding an image"] = _mean_seconds([lambda file=file: read_image(file) for file in images.values()])

    variants = _variants(options, presets, inputs, labels)
    once["describing an image"] = _describing(options, inputs, labels)
    work = blocks(chosen, options.block_images)
    for variant in variants.values():  # what is loaded at the first call is not timed
        variant.collection.match(work[0][0])
        variant.timed.seconds.clear()
        _forget_extracted(variant.timed.matcher)
    for number, block in enumerate(work):
        plains = [variant for name, variant in variants.items() if name.startswith(PLAIN) and "@" not in name]
        for plain in plains:
            plain.match(number, block)
        for preset in presets:
            variants[preset].match(number, block)
            _match_at_budget(variants[f"{PLAIN}@{preset}"], variants[preset], number, block, inputs)
        for plain in plains:
            plain.match(number, block)
            plain.rounds = 2
    figures = {}
    for name, variant in variants.items():
        figures[name] = variant.figures() | _rest(variant, name, inputs, labels, len(work))
    return {
        "scene": str(options.images.parent.name),
        "pairs": len(chosen),
        "images": len(images),
        "matcher": options.matcher,
        "device": options.device,
        "threads": torch.get_num_threads(),
        "machine": platform.processor() or platform.machine(),
        "versions": versions(),
        "once": once,
        "variants": figures,
        "targets": targets(figures, once, len(images), presets, options),
    }


def _variants(options: MatchOptions, presets: Sequence[str], inputs: Inputs, labels: LabelMaps) -> dict[str, Variant]:
    """Whole images at each input size that a preset has, each preset, and whole images at its number of pixels."""
    found: dict[str, Variant] = {}
    for preset in presets:
        areas = with_preset(options, preset)
        plain = replace(areas, area_matcher="none")
        size = _plain_name(areas)
        if size not in found:
            found[size] = Variant.of(size, plain, inputs, None)
        found[preset] = Variant.of(preset, areas, inputs, labels)
        found[f"{PLAIN}@{preset}"] = Variant.of(f"{PLAIN}@{preset}", plain, inputs, None)
    return found


def _plain_name(options: MatchOptions) -> str:
    return f"{PLAIN} {options.crop.image_size}"


def _match_at_budget(plain: Variant, areas: Variant, number: int, block: Sequence[Pair], inputs: Inputs) -> None:
    """Match the block on whole images of the size at which they have as many pixels as the areas had."""
    target = sum(result.pixels_matched for result in results_of(areas.records[number]))
    budget = fit_budget(plain.options, inputs.images, block, target, WholeImages(), {}, LARGEST)
    images = plain.collection.image  # those of the blocks before
    plain.collection = CollectionMatcher(budget.options, inputs, None, plain.timed)
    plain.collection.image = images
    plain.match(number, block)


def _describing(options: MatchOptions, inputs: Inputs, labels: LabelMaps) -> float:
    """Seconds an image."""
    matcher = create_area_matcher(options)
    usable = [name for name in inputs.images if name not in labels.set.failed]
    maps = {name: labels.read(name) for name in usable}
    sizes = {name: (inputs.images[name].height, inputs.images[name].width, 3) for name in usable}
    blank = {name: Image(name=name, pixels=np.broadcast_to(np.uint8(0), size)) for name, size in sizes.items()}
    return _mean_seconds([lambda name=name: matcher.describe(blank[name], maps[name]) for name in usable])


def _mean_seconds(calls: Sequence[Any]) -> float:
    start = time.perf_counter()
    for call in calls:
        call()
    return (time.perf_counter() - start) / max(len(calls), 1)


def _rest(variant: Variant, name: str, inputs: Inputs, labels: LabelMaps | None, num_blocks: int) -> dict[str, float]:
    """Merge, verify and map what a variant found."""
    output = variant.options.output / "models" / name.replace(" ", "-").replace("@", "-")
    output.mkdir(parents=True)
    options = replace(variant.options, output=output)
    shutil.copy(variant.options.output / "cameras.db", output / "cameras.db")
    store = open_store(options, inputs)
    for number, records in variant.records.items():
        store.write(number, records)
    stages = Stages(quiet=True)
    job = MatchingJob(options=options, inputs=inputs, labels=labels)
    assemble(job, store, num_blocks, {}, stages, None)
    return {stage: stages.seconds.get(stage, 0.0) for stage in REST}


def _forget_extracted(matcher: PointMatcher) -> None:
    features = getattr(matcher, "features", None)
    if features is not None:
        features.pixels_extracted, features.seconds_extracting = 0, 0.0


def _is_whole(image: Image, crop: Crop) -> bool:
    return (crop.window.width, crop.window.height) == (image.width, image.height)


def results_of(records: Sequence[PairRecord]) -> list[PairResult]:
    """Of the pairs that could be matched."""
    return [record.result for record in records if record.result is not None]


def targets(
    figures: Mapping[str, Mapping[str, float]],
    once: Mapping[str, float],
    num_images: int,
    presets: Sequence[str],
    options: MatchOptions,
) -> list[dict[str, Any]]:
    """The figures that have a limit, and whether they keep it.

    Times are of matching, reading of images included.
    """
    found = []

    def add(name: str, value: float, limit: float) -> None:
        found.append({"name": name, "value": value, "limit": limit, "met": value <= limit})

    for preset in presets:
        own, plain = figures[preset], figures[_plain_name(with_preset(options, preset))]
        for at, other in (("pixel budget", figures[f"{PLAIN}@{preset}"]), ("input size", plain)):
            ratio = _per_pixel(own) / _per_pixel(other)
            add(f"{preset}, time per matched pixel over plain's at the same {at}", ratio, MAX_PER_PIXEL)
        if preset in MAX_RATIO:
            for what, more in (("", 0.0), (" with segmentation", once["segmenting images"])):
                ratio = (own["matching pairs"] + more) / plain["matching pairs"]
                add(f"{preset}{what}, time over plain's at the same input size", ratio, MAX_RATIO[preset])
        run = once["reading inputs"] + once["segmenting images"] + own["matching pairs"]
        run += sum(own[stage] for stage in REST)
        areas = own.get("area matching", 0.0) + num_images * once["describing an image"]
        add(f"{preset}, share of area description and matching in the run", areas / run, MAX_AREA_MATCHING)
    add("segmentation, seconds an image", once["segmenting images"] / num_images, MAX_SEGMENTATION_SECONDS)
    return found


def _per_pixel(figures: Mapping[str, float]) -> float:
    """Seconds a megapixel."""
    return figures["matching pairs"] / figures["Mpx matched"]


def table(figures: Mapping[str, Mapping[str, float]], once: Mapping[str, float]) -> str:
    """Markdown: a row a stage; seconds, and in parentheses the ratio to plain's matching."""
    first = next(iter(figures.values()))["matching pairs"]
    rows = [["stage", *figures], ["---"] * (len(figures) + 1)]
    names = ["whole images matched", "areas matched", "extracting", *PAIR_STAGES, "matching pairs", *REST]
    for stage in names:
        values = [each.get(stage, 0.0) for each in figures.values()]
        rows.append([f"{stage}, s", *(f"{value:.2f} ({value / first:.3f})" for value in values)])
    for pixels in ("Mpx matched", "Mpx extracted"):
        rows.append([pixels, *(f"{each[pixels]:.1f}" for each in figures.values())])
    per_pixel = [_per_pixel(each) for each in figures.values()]
    rows.append(["s a Mpx (ratio)", *(f"{value:.3f} ({value / per_pixel[0]:.2f})" for value in per_pixel)])
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([*lines, "", ", ".join(f"{name}: {seconds:.3f} s" for name, seconds in once.items())])


if __name__ == "__main__":
    main()
