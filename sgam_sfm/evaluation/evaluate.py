"""Judge pairs with a known pose: every variant of the options on the same pairs, sliced by what makes a pair hard."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import inf
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from sgam_core import PRESETS as ALGORITHMS
from sgam_core import Matches, match_whole
from sgam_core.errors import InputError, OptionError, SGAMError
from sgam_core.options import changed
from sgam_sfm.evaluation.ground_truth import GroundTruth, TrueView, read_ground_truth
from sgam_sfm.evaluation.metrics import area_matching_precision, pose_auc
from sgam_sfm.evaluation.options import EvaluateOptions
from sgam_sfm.evaluation.presets import PRESETS, frame_pairs
from sgam_sfm.evaluation.two_view import PIXELS, JudgedPair, TruePair, areas_of, judge_pair, true_pair
from sgam_sfm.files import write_json
from sgam_sfm.images import list_images
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.label_maps import LabelMaps, make_label_maps
from sgam_sfm.machine import find_device, use_threads
from sgam_sfm.match_cache import CachedMatcher
from sgam_sfm.nearest import unknown
from sgam_sfm.options import MatchOptions, told_options
from sgam_sfm.pairs import Pair, spread_over, write_pairs
from sgam_sfm.progress import Stages
from sgam_sfm.runs.matching import CollectionMatcher, create_area_matcher
from sgam_sfm.runs.summary import versions

VERSION = 2
_AMP_OVERLAP = 0.7

_PAPER = {"guidance__enabled": False}
_OFF = {**_PAPER, "prediction__enabled": False, "rejection__rule": "none", "collection__rule": "none"}
_ABLATION: Mapping[str, Mapping[str, Any]] = {
    "SOA": {**_OFF, "semantic__intersections__enabled": False},
    "SIA": {**_OFF, "semantic__objects__enabled": False},
    "SOA+SIA": _OFF,
    "+GP": {**_PAPER, "rejection__rule": "none", "collection__rule": "none"},
    "+GR": {**_PAPER, "prediction__enabled": False, "collection__rule": "none"},
    "+GP+GR": {**_PAPER, "collection__rule": "none"},
    "full": _PAPER,
    "full, GR paper": {**_PAPER, "rejection__rule": "paper", "collection__rule": "paper"},
    "full, GR paper-literal": {**_PAPER, "rejection__rule": "paper-literal", "collection__rule": "paper-literal"},
    "full, guided": {},
}
"""The paper's table of components, its own rules of GR and GMC, and the second round of guided areas on top."""

_SLICES: Mapping[str, tuple[Callable[[TruePair], float | str | None], Sequence[tuple[float, float] | str]]] = {
    "rotation, degrees": (lambda pair: pair.angle_deg, ((0, 15), (15, 30), (30, 45), (45, inf))),
    "scale change": (lambda pair: pair.scale_change, ((1, 1.5), (1.5, 2.5), (2.5, inf))),
    "overlap": (lambda pair: pair.overlap, ((0, 0.3), (0.3, 0.6), (0.6, inf))),
    "place": (lambda pair: pair.place, ("indoor", "outdoor")),
    "labels in both": (lambda pair: pair.num_labels, ((0, 4), (4, 8), (8, 16), (16, inf))),
}
"""What makes a pair hard: a title, its value for a pair, and the slices: names, or ranges without their end."""
_SHOWN = 0.01
"""Share of an image that a label must have to be shown by it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Variant:
    """Options under a name."""

    name: str
    options: MatchOptions


def evaluate(options: EvaluateOptions, stages: Stages) -> dict[str, Any]:
    """Match every pair with a known pose under every variant, judge it, and write OUT/evaluate.json.

    Returns: the content of evaluate.json. Raises: SGAMError for what cannot be used at all.
    """
    options = with_dataset(options)
    common = replace(options.matching, device=str(find_device(options.device, "--device")))
    use_threads(common.threads)
    truth = read_ground_truth(options.ground_truth, options.ground_truth_format or None, common.images)
    common = replace(common, pairs=_listed(options, truth))
    inputs = read_inputs(common, stages)
    names = truth.match_names(inputs.images)
    pairs = _known(inputs.pairs.pairs, truth, names, options.max_pairs)
    _require_true_sizes(inputs, truth, {name: names[name] for pair in pairs for name in pair})
    variants = _variants(common, ablation=options.ablation)
    needs_labels = any(create_area_matcher(variant.options).needs_labels for variant in variants)
    needs_labels |= bool(common.mask_matches)
    matcher = CachedMatcher.of(common, inputs, common.output / "cache" / "matches")  # first: it may lack weights
    labels = make_label_maps(common, inputs.images, stages) if needs_labels else None
    shown = {} if labels is None else _shown_labels(labels, {name for pair in pairs for name in pair})
    facts = {}
    whole: dict[Pair, Matches] = {}
    plain = CollectionMatcher(replace(common, area_matcher="none"), inputs, labels, matcher)
    with stages.stage("Matching whole images", len(pairs)) as advance:
        for pair in pairs:
            try:
                whole[pair] = match_whole(plain.image(pair[0]), plain.image(pair[1]), matcher, common.crop)
            except SGAMError:  # the pair counts as failed in every variant
                whole[pair] = Matches.empty()
            true = true_pair(truth, _views(truth, names, pair), whole[pair])
            num_labels = len(set.intersection(*(shown[name] for name in pair))) if shown.keys() >= {*pair} else None
            facts[pair] = replace(true, num_labels=num_labels)
            advance(1)
    judged = {}
    for variant in variants:
        with stages.stage(variant.name, len(pairs)) as advance:
            judged[variant.name] = _judge(variant, inputs, labels, matcher, pairs, truth, names, whole, advance)
    by_areas = {variant.name: variant.options.area_matcher != "none" for variant in variants}
    content = {
        "version": VERSION,
        "ground_truth": {"path": str(truth.source), "format": truth.format, "unit": truth.unit},
        "options": told_options(replace(common, pairs=options.pairs)),
        "num_pairs": len(pairs),
        "num_labels": len(labels.set.labels) if labels else 0,
        "auc_degrees": options.auc_degrees,
        "pixels": PIXELS,
        "variants": [
            {
                "name": name,
                "figures": figures_of(list(results.values()), options.auc_degrees, by_areas=by_areas[name]),
                "seconds": _seconds(list(results.values())),
                "slices": _sliced(results, facts, options.auc_degrees, by_areas=by_areas[name]),
                "pairs": [{"pair": pair, **asdict(facts[pair]), **asdict(result)} for pair, result in results.items()],
            }
            for name, results in judged.items()
        ],
        "versions": versions(),
    }
    written: dict[str, Any] = write_json(common.output / "evaluate.json", content)
    return written


def figures_of(pairs: Sequence[JudgedPair], auc_degrees: Sequence[float], *, by_areas: bool) -> dict[str, float | None]:
    """The metrics of some pairs: means over pairs for matches, over areas for areas; None where there is nothing.

    Args: by_areas: whether areas were looked for at all; otherwise there is nothing to fall back from.
    """
    if not pairs:
        return {}
    figures: dict[str, float | None] = {"matches": fmean(pair.num_matches for pair in pairs)}
    for index, pixels in enumerate(PIXELS):
        figures[f"mma_{pixels}"] = 100 * fmean(pair.precision[index] for pair in pairs)
        figures[f"mma_{pixels}_at_640"] = 100 * fmean(pair.precision_640[index] for pair in pairs)
    areas = pose_auc([error for pair in pairs for error in pair.pose_errors_deg], auc_degrees)
    figures |= {f"auc_{degrees:g}": 100 * area for degrees, area in zip(auc_degrees, areas, strict=True)}
    for name, chosen in (
        ("soa", areas_of(pairs, kind="object", stage="putative")),
        ("sia", areas_of(pairs, kind="intersection", stage="putative")),
        ("gp", areas_of(pairs, stage="predicted")),
        ("guided", areas_of(pairs, kind="guided")),
        ("all", areas_of(pairs)),
        ("after_gr", areas_of(pairs, kept=True)),
    ):
        figures[f"areas_{name}"] = len(chosen) / len(pairs)
        # The paper reports the one way; both ways also tell an area that is too large for its partner.
        for way, values in (("", [o.mean for o in chosen]), ("_one_way", [o.forward for o in chosen])):
            known = [value for value in values if not np.isnan(value)]
            figures[f"aor_{name}{way}"] = 100 * fmean(known) if known else None
            figures[f"amp_{name}{way}"] = 100 * area_matching_precision(known, _AMP_OVERLAP) if known else None
    figures["fallbacks"] = 100 * fmean(bool(pair.fallback) for pair in pairs) if by_areas else None
    figures["megapixels_matched"] = fmean(pair.pixels_matched for pair in pairs) / 1e6
    return figures


def _variants(common: MatchOptions, *, ablation: bool) -> list[Variant]:
    plain = Variant(name="whole images", options=replace(common, area_matcher="none"))
    if ablation:
        return [plain, *(Variant(name=name, options=changed(common, **change)) for name, change in _ABLATION.items())]
    return [plain, Variant(name=common.area_matcher, options=common)]


def with_dataset(options: EvaluateOptions) -> EvaluateOptions:
    """The options with the sizes and angles of a data set, as the paper has them, unless others are given; its format.

    Raises: OptionError for an unknown data set.
    """
    if not options.dataset:
        return options
    if options.dataset not in PRESETS:
        raise OptionError(unknown("--dataset", options.dataset, PRESETS))
    preset = PRESETS[options.dataset]
    area_size, degrees = options.crop.area_size, options.auc_degrees
    by_default = area_size == ALGORITHMS[options.preset].crop.area_size
    return replace(
        options,
        crop=replace(options.crop, area_size=preset.area_size if by_default else area_size),
        auc_degrees=preset.auc_angles if degrees == EvaluateOptions.auc_degrees else degrees,
        ground_truth_format=preset.format,
    )


def _listed(options: EvaluateOptions, truth: GroundTruth) -> Path | None:
    """The pair list: the one that was given, else frames so far apart, else the one published with the truth."""
    if options.pairs is not None or (truth.pairs is None and not options.frame_difference):
        return options.pairs
    names, _ = list_images(options.images)
    if options.frame_difference:
        pairs = frame_pairs(names, options.frame_difference, options.max_pairs or None)
    else:
        by_view = {view: name for name, view in truth.match_names(names).items()}
        pairs = tuple((by_view[a], by_view[b]) for a, b in truth.pairs or () if a in by_view and b in by_view)
    path = options.output / "pairs.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_pairs(path, pairs)
    return path


def _known(pairs: Sequence[Pair], truth: GroundTruth, names: Mapping[str, str], wanted: int) -> list[Pair]:
    """The pairs whose pose is known; at most `wanted` of them (0: all), evenly over the list."""
    in_truth = [(a, b) for a, b in pairs if a in names and b in names]
    known = [(a, b) for a, b in in_truth if truth.relative_pose(names[a], names[b]) is not None]
    if not known:
        raise InputError(
            f"none of the {len(pairs)} pairs has a known pose in '{truth.source}' ({truth.format}); its images are "
            f"named like '{min(truth.views, default='-')}', the first pair is '{pairs[0][0]}' - '{pairs[0][1]}'"
        )
    return spread_over(known, wanted)


def _require_true_sizes(inputs: Inputs, truth: GroundTruth, names: Mapping[str, str]) -> None:
    """Raises: InputError for an image that the true camera, which is one of pixels, does not belong to."""
    for name, true_name in names.items():
        image, view = inputs.images[name], truth.views[true_name]
        if (image.width, image.height) != (view.width, view.height):
            raise InputError(
                f"'{name}' has {image.width}x{image.height} pixels, its camera in '{truth.source}' ({truth.format}) is "
                f"of {view.width}x{view.height}; evaluate images of that size (`sgam-sfm compare --scene-scale` scales "
                "images and truth alike)"
            )


def _views(truth: GroundTruth, names: Mapping[str, str], pair: Pair) -> tuple[TrueView, TrueView]:
    return truth.views[names[pair[0]]], truth.views[names[pair[1]]]


def _judge(
    variant: Variant,
    inputs: Inputs,
    labels: LabelMaps | None,
    matcher: CachedMatcher,
    pairs: Sequence[Pair],
    truth: GroundTruth,
    names: Mapping[str, str],
    whole: Mapping[Pair, Matches],
    advance: Callable[[float], None],
) -> dict[Pair, JudgedPair]:
    options = variant.options
    collection = CollectionMatcher(options, inputs, labels, matcher)
    judged = {}
    for number, pair in enumerate(pairs):
        matcher.start()
        record = collection.match(pair)
        advance(1)
        if record.result is None:
            judged[pair] = JudgedPair.failed(record.error)
            continue
        # Results that were looked up are charged with what they cost when they were computed.
        seconds = {**record.result.seconds, "point matching": matcher.charged}
        rng = np.random.default_rng([options.seed, number])
        result = replace(record.result, seconds=seconds)
        judged[pair] = judge_pair(truth, _views(truth, names, pair), result, whole[pair], rng)
    return judged


def _seconds(pairs: Sequence[JudgedPair]) -> dict[str, float]:
    """Seconds a pair by stage."""
    total: Counter[str] = Counter()
    for pair in pairs:
        total.update(pair.seconds)
    return {stage: seconds / max(len(pairs), 1) for stage, seconds in total.items()}


def _sliced(
    results: Mapping[Pair, JudgedPair], facts: Mapping[Pair, TruePair], auc_degrees: Sequence[float], *, by_areas: bool
) -> list[dict[str, Any]]:
    slices = []
    for title, (value_of, parts) in _SLICES.items():
        for part in parts:
            chosen = [result for pair, result in results.items() if _belongs(value_of(facts[pair]), part)]
            figures = figures_of(chosen, auc_degrees, by_areas=by_areas)
            slices.append({"by": title, "part": _title(part), "num_pairs": len(chosen), "figures": figures})
    return slices


def _belongs(value: float | str | None, part: tuple[float, float] | str) -> bool:
    if isinstance(part, str) or isinstance(value, str):
        return value == part
    return value is not None and part[0] <= value < part[1]


def _title(part: tuple[float, float] | str) -> str:
    if isinstance(part, str):
        return part
    return f"{part[0]:g}-{part[1]:g}" if part[1] < inf else f"from {part[0]:g}"


def _shown_labels(labels: LabelMaps, names: Collection[str]) -> dict[str, set[int]]:
    """The labels that each image shows; images without a label map are left out."""
    without = {labels.set.void, *labels.set.ignored}
    shown = {}
    for name in sorted({*names} - labels.set.failed.keys()):
        ids, counts = np.unique(labels.read(name), return_counts=True)
        shown[name] = set(ids[counts >= _SHOWN * counts.sum()].tolist()) - without
    return shown
