"""What a run is judged by: figures of its model, its pairs and its price, and its poses against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from typing import Any, Literal

from sgam_sfm.colmap.reading import read_poses_and_points
from sgam_sfm.evaluation.metrics import pose_auc
from sgam_sfm.evaluation.sfm_metrics import Poses, align, camera_errors, pairwise_pose_errors

AUC_DEGREES = (0.5, 1.0, 3.0, 5.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class Figure:
    """One figure of a run. better: which way it improves; empty for a price or a fact. digits: after the point.

    title: with its unit; `{unit}` stands for that of the truth.
    """

    name: str
    title: str
    better: Literal["more", "less", ""] = ""
    digits: int = 0

    def titled(self, truth: Mapping[str, Any] | None) -> str:
        """The title for a ground truth, as compare.json has it."""
        unit = "unknown" if truth is None else truth["unit"]
        return self.title.format(unit="units of the truth" if unit == "unknown" else unit)

    def shown(self, value: float) -> float:
        """A value as it is printed: what differs only beyond its digits is equal."""
        return round(value, self.digits)


FIGURES = (
    Figure(name="registered", title="registered images", better="more"),
    *(Figure(name=f"auc_{d:g}", title=f"AUC@{d:g}\N{DEGREE SIGN}, %", better="more", digits=1) for d in AUC_DEGREES),
    Figure(name="center_error", title="centre error, {unit}", better="less", digits=4),
    Figure(name="rotation_error_deg", title="rotation error, degrees", better="less", digits=3),
    Figure(name="points", title="points", better="more"),
    Figure(name="observations", title="observations", better="more"),
    Figure(name="images_per_track", title="images a track", better="more", digits=2),
    Figure(name="reprojection_error_px", title="reprojection, px", better="less", digits=3),
    Figure(name="pairs_by_areas", title="pairs matched by areas, %", digits=0),
    Figure(name="verified_pairs", title="verified pairs", better="more"),
    Figure(name="inliers", title="inliers", better="more"),
    Figure(name="inlier_ratio", title="inlier ratio", better="more", digits=3),
    Figure(name="megapixels_matched", title="Mpx matched", digits=1),
    Figure(name="megapixels_extracted", title="Mpx extracted", digits=1),
)
TIMES = (
    Figure(name="matching_seconds", title="matching, s", better="less"),
    Figure(name="total_seconds", title="total, s", better="less"),
    Figure(name="peak_memory_mb", title="peak memory, MB", better="less"),
)
"""Figures that differ between two runs with one seed."""


def figures_of(result: Mapping[str, Any], folder: Path, true: Poses, *, by_areas: bool) -> dict[str, float | None]:
    """The figures of a run that do not depend on the machine; None for those that there is nothing to take from.

    Args: result: of `running.run_method`. folder: the run's output, for its model. true: known poses of the
        images; those without a pose in the model count as failed. by_areas: whether the method looks for areas at all.
    """
    summary = result["summary"]
    pairs, models = summary["pairs"], summary["models"]
    matches = summary.get("keypoints", {}).get("matches")
    model = models[0] if models else {}
    figures: dict[str, float | None] = {
        "registered": model.get("registered", 0),
        "points": model.get("points", 0),
        "observations": model.get("observations", 0),
        "images_per_track": model.get("mean_images_per_track"),
        "reprojection_error_px": model.get("mean_reprojection_error_px"),
        "pairs_by_areas": _by_areas(pairs) if by_areas else None,
        "verified_pairs": pairs["verified"],
        "inliers": pairs["inliers"],
        "inlier_ratio": pairs["inliers"] / matches if matches else None,
        "megapixels_matched": pairs["pixels_matched"] / 1e6 if "pixels_matched" in pairs else None,
        "megapixels_extracted": result["pixels_extracted"] / 1e6,
    }
    if len(true) > 1:
        figures |= _against_truth(folder / "sparse" / "0" if models else None, true)
    return figures


def _by_areas(pairs: Mapping[str, Any]) -> float | None:
    """Percentage of the matched pairs that did not fall back to whole images."""
    return 100 * (1 - sum(pairs["fallbacks"].values()) / pairs["matched"]) if pairs["matched"] else None


def times_of(result: Mapping[str, Any]) -> dict[str, float | None]:
    """The figures that depend on the machine: what the run would have taken had it found nothing done before."""
    summary, saved = result["summary"], result["saved_seconds"]
    memory = [value for value in summary.get("peak_memory_mb", {}).values() if value is not None]
    return {
        "matching_seconds": summary["seconds"]["Matching pairs"] + saved,
        "total_seconds": sum(summary["seconds"].values()) + saved,
        "peak_memory_mb": max(memory, default=None),
    }


def _against_truth(model: Path | None, true: Poses) -> dict[str, float | None]:
    estimated = {} if model is None else read_poses_and_points(model)[0]
    errors = [error.max for error in pairwise_pose_errors(estimated, true).values()]
    areas = dict(zip((f"auc_{d:g}" for d in AUC_DEGREES), pose_auc(errors, AUC_DEGREES), strict=True))
    similarity = align(estimated, true)
    cameras = [] if similarity is None else list(camera_errors(estimated, true, similarity).values())
    return {name: 100 * area for name, area in areas.items()} | {
        "center_error": median(camera.centre for camera in cameras) if cameras else None,
        "rotation_error_deg": median(camera.rotation for camera in cameras) if cameras else None,
    }


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """A figure over seeds. spread: half of what lies between the smallest and the largest; None for one seed."""

    mean: float
    spread: float | None


def over_seeds(runs: Sequence[Mapping[str, float | None]]) -> dict[str, Spread | None]:
    """Every figure over the seeds; None where a seed has none."""
    found: dict[str, Spread | None] = {}
    for name in runs[0]:
        values = [value for run in runs if (value := run[name]) is not None]
        whole = len(values) == len(runs)
        spread = (max(values) - min(values)) / 2 if whole and len(values) > 1 else None
        found[name] = Spread(mean=fmean(values), spread=spread) if whole else None
    return found


def verdict(figure: Figure, one: Spread | None, other: Spread | None) -> Literal["gain", "loss", "tie", ""]:
    """Whether a method's figure is better than the reference's; a tie within the spread of the seeds, or as printed.

    Returns: empty where either has no figure, or none is better than another.
    """
    if one is None or other is None or not figure.better:
        return ""
    difference = (one.mean - other.mean) * (1 if figure.better == "more" else -1)
    same = figure.shown(one.mean) == figure.shown(other.mean)
    if same or abs(difference) <= (one.spread or 0.0) + (other.spread or 0.0):
        return "tie"
    return "gain" if difference > 0 else "loss"
