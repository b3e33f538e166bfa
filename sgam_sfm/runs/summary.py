"""What a run did, counted: the content of OUT/summary.json and the table on the terminal."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import distributions, version
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sgam_core.wording import counted
from sgam_sfm.colmap.mapping import MappingSummary
from sgam_sfm.colmap.reading import read_camera_ids
from sgam_sfm.colmap.verification import VerificationSummary
from sgam_sfm.inputs import Inputs
from sgam_sfm.merging.keypoints import CollectionKeypoints
from sgam_sfm.nearest import listing
from sgam_sfm.pairs import Pair
from sgam_sfm.runs.store import PairRecord

_PACKAGES = ("sgam-sfm", "pycolmap", "torch", "kornia", "numpy", "numba", "opencv-python-headless", "onnxruntime")


def summarise_images(inputs: Inputs) -> dict[str, Any]:
    """Images that the run works on, and those it cannot use."""
    return {
        "used": len(inputs.images),
        "failed": dict(inputs.failed),
        "other_files": inputs.num_other_files,
        "same_content": inputs.num_same_content,
    }


class CountedPairs:
    """Records that are counted while they pass: areas, matches and fallbacks of all pairs."""

    def __init__(self, records: Iterable[PairRecord]) -> None:
        self._records = records
        self._areas: Counter[str] = Counter()
        self._fallbacks: Counter[str] = Counter()
        self._totals: Counter[str] = Counter()
        self._failed: dict[str, str] = {}
        self._limited: Pair | None = None
        self._coverage = self._scale = 0.0

    def __iter__(self) -> Iterator[PairRecord]:
        for record in self._records:
            self._count(record)
            yield record

    def _count(self, record: PairRecord) -> None:
        result = record.result
        if result is None:
            self._failed[" - ".join(record.pair)] = record.error
            return
        self._totals["pairs"] += 1
        self._totals["raw_matches"] += len(result.matches)
        self._totals["pixels_matched"] += result.pixels_matched
        if result.notes:
            self._totals["pairs_with_limits"] += 1
            self._limited = self._limited or record.pair
        self._totals["pairs_turned"] += bool(result.turned)
        self._totals["pairs_zoomed"] += result.zoom != 1
        self._coverage += (result.coverage0 + result.coverage1) / 2
        if result.fallback:
            self._fallbacks[result.fallback.partition(":")[0]] += 1
        for area in result.areas:
            self._areas[f"{area.area0.kind}_{area.state}"] += 1
            self._areas["predicted"] += area.predicted and area.state == "kept"
            if area.state == "kept":
                self._totals["areas_kept"] += 1
                self._scale += (area.scale0 / result.whole_scale0 + area.scale1 / result.whole_scale1) / 2

    def figures(self) -> dict[str, Any]:
        """Of the records that have passed."""
        return {
            "matched": self._totals["pairs"],
            "failed": self._failed,
            "fallbacks": dict(sorted(self._fallbacks.items())),
            "areas": dict(sorted(self._areas.items())),
            "mean_coverage": self._coverage / max(self._totals["pairs"], 1),
            "mean_resolution_gain": self._scale / max(self._totals["areas_kept"], 1),
            "pairs_with_limits": self._totals["pairs_with_limits"],
            "pair_with_limits": self._limited,
            "pairs_turned": self._totals["pairs_turned"],
            "pairs_zoomed": self._totals["pairs_zoomed"],
            "raw_matches": self._totals["raw_matches"],
            "pixels_matched": self._totals["pixels_matched"],
        }


def summarise_pairs(inputs: Inputs, counted: CountedPairs, verified: VerificationSummary) -> dict[str, Any]:
    """The pair list, and what became of its pairs."""
    return {
        "listed": len(inputs.pairs.pairs),
        "of_unusable_images": len(inputs.pairs.unreadable),
        "repeated": inputs.pairs.num_repeated,
        "reversed": inputs.pairs.num_reversed,
        "self": inputs.pairs.num_self,
        **counted.figures(),
        "verified": len(verified.inliers),
        "inliers": sum(verified.inliers.values()),
    }


def summarise_keypoints(merged: CollectionKeypoints) -> dict[str, Any]:
    """What merging made of the raw matches."""
    return {
        "images": len(merged.keypoints),
        "keypoints": sum(map(len, merged.keypoints.values())),
        "matches": merged.num_matches,
        "raw_matches": merged.num_raw,
        "duplicates": merged.num_duplicates,
        "conflicts": merged.num_conflicts,
        "inconsistent": merged.num_inconsistent,
    }


def summarise_models(mapped: MappingSummary | None, database: Path) -> dict[str, Any]:
    """What mapping made (None: it was not asked for) of a database, and the images that it left without a pose."""
    if mapped is None:
        return {"models": [], "no_model": "mapping was not asked for (--no-mapping)", "without_pose": []}
    posed = {name for model in mapped.models for name in model.images}
    without = sorted(read_camera_ids(database).keys() - posed)
    return {"models": mapped.models, "no_model": mapped.reason, "without_pose": without}


def versions() -> dict[str, str]:
    """Versions of the packages that results depend on."""
    installed = {distribution.name for distribution in distributions()}
    return {package: version(package) for package in _PACKAGES if package in installed}


def print_summary(summary: Mapping[str, Any], console: Console) -> None:
    """A table for the terminal."""
    images, pairs = summary["images"], summary["pairs"]
    table = Table(show_header=False, box=None)
    table.add_row("images", f"{images['used']} used, {len(images['failed'])} failed")
    dropped = sum(pairs[reason] for reason in ("repeated", "reversed", "self"))
    told = (
        f"; {counted(dropped, 'line')} dropped: pairs repeated or reversed, or an image named twice" if dropped else ""
    )
    table.add_row(
        "pairs",
        f"{pairs['matched']} matched, {len(pairs['failed']) + pairs['of_unusable_images']} failed, "
        f"{pairs['verified']} verified{told}",
    )
    if summary["labels"].get("num_labels_chosen"):
        stability = summary["labels"]["stability"][str(summary["labels"]["num_labels_chosen"])]
        table.add_row("labels", f"{summary['labels']['num_labels_chosen']}, runs agree by {stability:.2f}")
    if summary["labels"].get("failed"):
        table.add_row(
            "labels", f"{counted(len(summary['labels']['failed']), 'image')} without any that can be used (log.txt)"
        )
    if pairs["areas"]:
        kept = sum(count for name, count in pairs["areas"].items() if name.endswith("_kept"))
        gain = pairs["mean_resolution_gain"]
        table.add_row(
            "areas",
            f"{kept} kept ({kept / max(pairs['matched'], 1):.1f} a pair), {pairs['areas'].get('predicted', 0)} by GP, "
            f"{sum(n for k, n in pairs['areas'].items() if k.endswith('_rejected'))} rejected; "
            f"{pairs['mean_coverage']:.0%} of the image, {gain:.1f}x the resolution",
        )
    if summary["labels"]:
        told = ", ".join(f"{counted(count, 'pair')}: {reason}" for reason, count in pairs["fallbacks"].items())
        table.add_row("fallbacks", f"matched as whole images: {told}" if told else "none")
    if pairs["pairs_turned"] or pairs["pairs_zoomed"]:
        turned = f"{counted(pairs['pairs_turned'], 'pair')} with a turned image"
        table.add_row("looks", f"{turned}, {pairs['pairs_zoomed']} with one from nearer")
    if pairs["pairs_with_limits"]:
        look = shlex.join(["sgam-sfm", "show", "OUT", *pairs["pair_with_limits"]])
        table.add_row("limits", f"reached in {counted(pairs['pairs_with_limits'], 'pair')}; for one: {look}")
    table.add_row("matches", f"{pairs['raw_matches']} raw, {summary['keypoints']['matches']} as tracks")
    _add_models(summary, table)
    console.print(table)


def print_shard(summary: Mapping[str, Any], console: Console) -> None:
    """A table for the terminal of what a shard did."""
    pairs, shard = summary["pairs"], summary["shard"]
    table = Table(show_header=False, box=None)
    table.add_row("shard", f"{shard['shard']}, {counted(shard['blocks'], 'block')} of pairs")
    table.add_row("images", f"{summary['images']['used']} in all shards, {len(summary['images']['failed'])} failed")
    table.add_row("pairs", f"{pairs['matched']} of {pairs['listed']} matched, {len(pairs['failed'])} failed")
    table.add_row("matches", f"{pairs['raw_matches']} raw")
    table.add_row("next", "once all shards are done: sgam-sfm join SHARD_OUT... --output OUT")
    table.add_row("time", _told_seconds(summary))
    console.print(table)


def print_models(content: Mapping[str, Any], console: Console) -> None:
    """A table for the terminal of what `reconstruct` or `aggregate` made."""
    table = Table(show_header=False, box=None)
    table.add_row("pairs", f"{content['pairs']} with matches, {content['verified']} verified")
    if "keypoints" in content:
        merged = content["keypoints"]
        table.add_row("matches", f"{merged['raw_matches']} raw, {merged['matches']} as tracks")
    _add_models(content, table)
    console.print(table)


def _add_models(content: Mapping[str, Any], table: Table) -> None:
    for number, model in enumerate(content["models"]):
        table.add_row(
            f"model {number}",
            f"{model['registered']} of {counted(model['total'], 'image')}, {counted(model['points'], 'point')}, "
            f"{model['mean_images_per_track']:.2f} images a track, {model['mean_reprojection_error_px']:.3f} px",
        )
    if not content["models"]:
        table.add_row("model", content["no_model"])
    elif content.get("without_pose"):  # runs of earlier versions do not say
        table.add_row("no pose", escape(listing(content["without_pose"])))
    table.add_row("time", _told_seconds(content))


def _told_seconds(content: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.lower()} {value:.0f} s" for name, value in content["seconds"].items())
