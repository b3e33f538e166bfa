"""Run every method on the same collection, and put their figures side by side."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from sgam_sfm.comparison.figures import FIGURES, TIMES, Figure, Spread, figures_of, over_seeds, times_of, verdict
from sgam_sfm.comparison.harder import Cut, cut_collection, cut_folder, cut_views, parse_cut, read_windows
from sgam_sfm.comparison.methods import Method, budget_reference, parse_methods
from sgam_sfm.comparison.options import CompareOptions
from sgam_sfm.comparison.running import Job, run_apart
from sgam_sfm.evaluation.ground_truth import GroundTruth, read_ground_truth
from sgam_sfm.evaluation.sfm_metrics import Poses
from sgam_sfm.files import write_json
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.label_maps import create_segmenter, write_label_maps
from sgam_sfm.label_set import RECORD
from sgam_sfm.machine import find_device
from sgam_sfm.options import AFTER_MATCHING, MatchOptions, as_json, fingerprint, fingerprint_of_labels, told_options
from sgam_sfm.pairs import spread_over, write_pairs
from sgam_sfm.progress import Stages
from sgam_sfm.runs.matching import create_area_matcher, create_matcher
from sgam_sfm.runs.results import json_object
from sgam_sfm.runs.summary import versions
from sgam_sfm.tables import print_figures

VERSION = 1
_log = logging.getLogger(__name__)


def compare(options: CompareOptions, console: Console) -> dict[str, Any]:
    """Run the methods and write OUT/compare.json; started again, it runs what is missing.

    Returns: the content of compare.json, see docs/compare.md.
    Raises: SGAMError for what cannot be used at all.
    """
    methods, cut = parse_methods(options.methods), parse_cut(options.hard, options.scene_scale)
    common = MatchOptions(**{field.name: getattr(options, field.name) for field in fields(MatchOptions)})
    common = replace(common, device=str(find_device(options.device, "--device")))
    for matcher in sorted({method.matcher for method in methods if method.matcher}):
        create_matcher(replace(common, matcher=matcher))  # what one lacks is said now, not after hours
    truth = None if options.ground_truth is None else read_ground_truth(options.ground_truth)
    given = common
    stages = Stages(console=console)
    inputs = read_inputs(replace(common, output=options.output / "inputs"), stages)
    if str(cut):
        common = cut_collection(cut, common, inputs, cut_folder(options.output, cut), stages)
        inputs = read_inputs(replace(common, output=options.output / "inputs"), stages)
    pairs = spread_over(inputs.pairs.pairs, options.max_pairs)
    write_pairs(options.output / "pairs.txt", pairs)
    common = replace(common, pairs=options.output / "pairs.txt")
    inputs = replace(inputs, pairs=replace(inputs.pairs, pairs=tuple(pairs)))
    names = sorted({name for pair in pairs for name in pair})
    windows = read_windows(cut_folder(options.output, cut))
    views = {} if truth is None else cut_views(truth.views_of(names), windows)
    poses = {name: pose for name, view in views.items() if (pose := view.cam_from_world) is not None}

    results: dict[str, list[dict[str, Any]]] = {method.slug: [] for method in methods}
    for seed in range(options.seed, options.seed + options.repeats):
        labelled = replace(common, labels=_labels(common, options.output, methods, inputs, seed, stages))
        for method in sorted(methods, key=lambda method: method.same_budget):
            folder = options.output / method.slug
            folder = folder / f"seed-{seed}" if seed != options.seed else folder
            target = 0
            if method.same_budget and (reference := budget_reference(methods, method)) is not None:
                target = results[reference.slug][-1]["summary"]["pairs"]["pixels_matched"]
            job = Job(
                method=method,
                options=method.applied(labelled, folder, seed),
                cache=options.output / "cache" / "matches",
                target=target,
                max_image_size=options.budget_image_size,
            )
            results[method.slug].append(_run(job, inputs, poses))
    content = _content(given, common.images, cut, methods, names, len(pairs), truth, results)
    written: dict[str, Any] = write_json(options.output / "compare.json", content)
    return written


def _labels(
    common: MatchOptions,
    output: Path,
    methods: Sequence[Method],
    inputs: Inputs,
    seed: int,
    stages: Stages,
) -> Path | None:
    """One folder of label maps for all methods of a seed; label maps that were given serve all seeds."""
    if common.labels is not None:
        return common.labels
    named = {method.area_matcher for method in methods} - {""}
    needed = (create_area_matcher(replace(common, area_matcher=name)).needs_labels for name in named)
    if not common.mask_matches and not any(needed):
        return None
    wanted = replace(common, seed=seed)
    folder = output / "labels" / f"seed-{seed}-{fingerprint_of_labels(wanted, images=inputs.digests)[:8]}"
    if not (folder / RECORD).exists():
        segmenter = create_segmenter(wanted, output / "cache" / "segmenter")
        write_label_maps(segmenter, common.segmenter, inputs.images, folder, stages, full_size=True)
    return folder


def _run(job: Job, inputs: Inputs, true: Poses) -> dict[str, Any]:
    """Run a method, unless its result is there already; figures are taken anew, since the truth may be another one.

    What was matched is kept where only options of merging and mapping are others.
    Raises: OptionError when the method's folder was begun with other pairs, options of matching or cameras.
    """
    folder = job.options.output
    path = folder / "result.json"
    matching, whole = _marks(job, inputs)
    result = json_object(path)
    if result.get("fingerprint") != whole:
        before = result if job.method.matcher and result.get("matching") == matching else {}
        (folder / "summary.json").unlink(missing_ok=True)  # keypoints, database and model are made anew
        result = _with_price_of(before, run_apart(job)) | {"matching": matching, "fingerprint": whole}
        write_json(path, result)
    return result | {
        "seed": job.options.seed,
        "folder": str(folder),
        "figures": figures_of(result, folder, true, by_areas=job.method.area_matcher not in ("", "none")),
        "times": times_of(result),
    }


def _marks(job: Job, inputs: Inputs) -> tuple[str, str]:
    """Of all that a method's matches follow from, and of all that its figures do."""
    rigs = job.options.rigs
    given = {
        "images": inputs.digests,
        "pairs": inputs.pairs.pairs,
        "cameras": inputs.cameras,
        "budget": (job.target, job.max_image_size),
    }
    late = {name: value for name, value in as_json(job.options).items() if name in AFTER_MATCHING}
    late |= {} if rigs is None else {"rigs": rigs.read_text(encoding="utf-8")}
    return fingerprint(job.options, **given), fingerprint(job.options, **given, late=late)


def _with_price_of(before: Mapping[str, Any], result: dict[str, Any]) -> dict[str, Any]:
    """A result charged with what its matches cost when they were made, by the one that made them (empty: it did)."""
    if not before:
        return result
    there, summary = before["summary"], result["summary"]
    matching = {
        "seconds": summary["seconds"] | {"Matching pairs": there["seconds"]["Matching pairs"]},
        "matching_seconds": there["matching_seconds"],
        "peak_memory_mb": summary["peak_memory_mb"] | {"matching": there["peak_memory_mb"]["matching"]},
    }
    price = {name: before[name] for name in ("pixels_extracted", "saved_seconds")}
    return result | price | {"summary": summary | matching}


def _content(
    given: MatchOptions,
    images: Path,
    cut: Cut,
    methods: Sequence[Method],
    names: Sequence[str],
    num_pairs: int,
    truth: GroundTruth | None,
    results: Mapping[str, Sequence[Mapping[str, Any]]],
) -> dict[str, Any]:
    options = told_options(given)
    figures = {slug: over_seeds([run["figures"] for run in runs]) for slug, runs in results.items()}
    times = {slug: over_seeds([run["times"] for run in runs]) for slug, runs in results.items()}
    plain = (method for method in methods if method.area_matcher == "none" and not method.same_budget)
    reference = next(plain, methods[0])
    known = None if truth is None else {"path": str(truth.source), "format": truth.format, "unit": truth.unit}
    return {
        "version": VERSION,
        "collection": {
            "images": str(images.absolute()),
            "hard": str(cut),
            "names": names,
            "num_pairs": num_pairs,
            "ground_truth": known,
        },
        "options": {name: value for name, value in options.items() if name not in ("area_matcher", "matcher")},
        "reference": reference.slug,
        "methods": [
            {
                "name": method.name,
                "slug": method.slug,
                "options": _own(told_options(method.applied(given, given.output, given.seed)), options),
                "figures": figures[method.slug],
                "verdicts": _verdicts(figures[method.slug], figures[reference.slug]),
                "times": times[method.slug],
                "cap": results[method.slug][0]["cap"],
                "runs": [_run_content(run) for run in results[method.slug]],
            }
            for method in methods
        ],
        "versions": versions(),
    }


def _own(options: Mapping[str, Any], common: Mapping[str, Any]) -> dict[str, Any]:
    """What a method has besides the common options, nested as they are; which matchers it has in any case."""
    return {
        name: _own(value, common[name]) if isinstance(value, dict) and isinstance(common.get(name), dict) else value
        for name, value in options.items()
        if name in ("area_matcher", "matcher") or value != common.get(name)
    }


def _verdicts(figures: Mapping[str, Spread | None], reference: Mapping[str, Spread | None]) -> dict[str, str]:
    return {figure.name: verdict(figure, figures.get(figure.name), reference.get(figure.name)) for figure in FIGURES}


def _run_content(run: Mapping[str, Any]) -> dict[str, Any]:
    summary = run["summary"]
    models = summary["models"]
    return {
        "seed": run["seed"],
        "folder": run["folder"],
        "figures": run["figures"],
        "times": run["times"] | {"stages": summary["seconds"]},
        "images_per_track": models[0]["images_per_track"] if models else {},
        "no_model": summary["no_model"],
        "fallbacks": summary["pairs"].get("fallbacks", {}),
    }


def print_table(content: Mapping[str, Any], console: Console) -> None:
    """Figures down, methods across; green for a gain over the reference, red for a loss, nothing for a tie."""
    methods, truth = content["methods"], content["collection"]["ground_truth"]
    rows = [(figure.titled(truth), [_cell(figure, method) for method in methods]) for figure in (*FIGURES, *TIMES)]
    hard = content["collection"]["hard"]
    title = f"against {content['reference']}{f', {hard}' if hard else ''}"
    print_figures(title, [method["name"] for method in methods], rows, console)
    for method in content["methods"]:
        if method["cap"]:
            console.print(f"{method['name']}: the budget could not be met: {method['cap']}")


def _cell(figure: Figure, method: Mapping[str, Any]) -> str:
    value = (method["figures"] | method["times"]).get(figure.name)
    if value is None:
        return ""
    spread = Spread(**value)
    text = f"{spread.mean:.{figure.digits}f}"
    if spread.spread is not None:
        text += f" ±{spread.spread:.{figure.digits}f}"
    colour = {"gain": "green", "loss": "red"}.get(method["verdicts"].get(figure.name, ""))
    return f"[{colour}]{text}[/]" if colour else text
