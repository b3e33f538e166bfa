"""What the plots show, as plain values: the page makes plotly's traces of them, in the colours of its theme.

A trace names its method by number (`method`), or the truth by None.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from typing import Any

import numpy as np

from sgam_sfm.comparison.report.bounds import Bounds, evenly_of
from sgam_sfm.comparison.report.geometry import Model, ViewChange
from sgam_sfm.comparison.report.runs import MethodRun
from sgam_sfm.pairs import Pair

_SMALLEST_DEGREES = 0.01  # what a logarithmic axis starts with
_SMALL_STAGE = 0.02  # of the longest run
_BINS = 6  # of the lines through scattered errors
Trace = dict[str, Any]


def pose_curves(errors: Mapping[int, Sequence[float]], bounds: Bounds) -> list[Trace]:
    """Share of pairs below each pose error, by method number. errors: sorted, in degrees."""
    traces = []
    for number, values in errors.items():
        ranks = evenly_of(range(len(values)), bounds.curve_points)
        x = [max(round(values[rank], 4), _SMALLEST_DEGREES) for rank in ranks]
        y = [round(100 * (rank + 1) / len(values), 2) for rank in ranks]
        traces.append({"method": number, "x": [_SMALLEST_DEGREES, *x], "y": [0, *y]})
    return traces


def errors_by(
    what: str, errors: Mapping[int, Mapping[Pair, float]], changes: Mapping[Pair, ViewChange], names: Sequence[str]
) -> list[Trace]:
    """Pose error of pairs against what their views differ by (`angle` or `scale`), and its median in bins."""
    order = {name: number for number, name in enumerate(names)}
    values = {pair: float(getattr(change, what)) for pair, change in changes.items()}
    edges = np.quantile(list(values.values()), np.linspace(0, 1, _BINS + 1)) if values else np.zeros(0)
    traces = []
    for number, of_pair in errors.items():
        pairs = [pair for pair in of_pair if pair in values]
        x = np.array([values[pair] for pair in pairs])
        y = np.array([max(of_pair[pair], _SMALLEST_DEGREES) for pair in pairs])
        traces.append(
            {
                "method": number,
                "x": np.round(x, 3).tolist(),
                "y": np.round(y, 3).tolist(),
                "pairs": [[order[a], order[b]] for a, b in pairs],
                "median": _binned_median(x, y, edges),
            }
        )
    return traces


def _binned_median(x: np.ndarray, y: np.ndarray, edges: np.ndarray) -> list[tuple[float, float]]:
    """Medians (x, y) of as many bins as there are enough values for."""
    if len(x) < 2 * _BINS:
        return []
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, _BINS - 1)
    filled = (bins == number for number in range(_BINS) if np.any(bins == number))
    return [(round(float(np.median(x[rows])), 3), round(float(np.median(y[rows])), 3)) for rows in filled]


def coverages(runs: Iterable[MethodRun], names: Sequence[str], bounds: Bounds) -> list[Trace]:
    """Share of the images inside kept areas, pairs sorted by it, of every method with areas."""
    order = {name: number for number, name in enumerate(names)}
    traces = []
    for run in runs:
        if not run.has_areas:
            continue
        ranked = sorted(run.pairs, key=lambda pair: -(run.pairs[pair].coverage or 0.0))
        ranks = evenly_of(range(len(ranked)), bounds.curve_points)
        traces.append(
            {
                "method": run.number,
                "x": [rank + 1 for rank in ranks],
                "y": [round(100 * (run.pairs[ranked[rank]].coverage or 0.0), 1) for rank in ranks],
                "pairs": [[order[name] for name in ranked[rank]] for rank in ranks],
            }
        )
    return traces


def stage_seconds(methods: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """Seconds of every stage by its name, a value a method: means over seeds.

    What results of earlier runs spared a method counts as a stage of its own, since it is charged for it. Stages that
    are small in every method are put together.
    """
    stages = list(
        dict.fromkeys(stage for method in methods for run in method["runs"] for stage in run["times"]["stages"])
    )
    seconds = {
        stage: [round(fmean(run["times"]["stages"].get(stage, 0.0) for run in method["runs"]), 3) for method in methods]
        for stage in stages
    }
    spared = [round(max(fmean(map(_spared, method["runs"])), 0.0), 3) for method in methods]
    seconds |= {"Looked-up matches": spared} if max(spared, default=0) > 0 else {}
    least = _SMALL_STAGE * max((sum(values) for values in zip(*seconds.values(), strict=True)), default=0.0)
    small = [stage for stage, values in seconds.items() if max(values) < least]
    kept = {stage: values for stage, values in seconds.items() if stage not in small}
    others = [round(sum(values), 3) for values in zip(*(seconds[stage] for stage in small), strict=True)]
    return kept | ({"Other": others} if others else {})


def _spared(run: Mapping[str, Any]) -> float:
    """Seconds that a run is charged for beyond those that it took."""
    total: float = run["times"]["total_seconds"]
    return total - sum(run["times"]["stages"].values())


def track_histograms(methods: Sequence[Mapping[str, Any]], bounds: Bounds) -> list[Trace]:
    """Points by the number of images that see them, of the first seed."""
    traces = []
    for number, method in enumerate(methods):
        counts: dict[int, int] = {}
        for images, points in method["runs"][0]["images_per_track"].items():
            length = min(int(images), bounds.track_length)
            counts[length] = counts.get(length, 0) + points
        if counts:
            traces.append({"method": number, "x": sorted(counts), "y": [counts[length] for length in sorted(counts)]})
    return traces


def pair_matrices(runs: Sequence[MethodRun], names: Sequence[str], bounds: Bounds) -> dict[str, Any]:
    """Raw matches and inliers of every pair and method.

    Returns: bins: first and last image (numbers) of every row; cells: [row, column] with row <= column; matches,
    inliers: by method, a value a cell (a mean where a cell is of several pairs).
    """
    order = {name: number for number, name in enumerate(names)}
    side = min(len(names), bounds.matrix_side)
    row_of = [number * side // max(len(names), 1) for number in range(len(names))]
    members: dict[tuple[int, int], list[Pair]] = {}
    for pair in sorted({pair for run in runs for pair in run.pairs}):
        row, column = sorted(row_of[order[name]] for name in pair)
        members.setdefault((row, column), []).append(pair)
    bins = [[row_of.index(row), len(row_of) - 1 - row_of[::-1].index(row)] for row in range(side)]
    return {
        "bins": bins,
        "cells": [list(cell) for cell in members],
        "counts": [len(pairs) for pairs in members.values()],
        "matches": [[_mean([run.facts(p).matches for p in pairs]) for pairs in members.values()] for run in runs],
        "inliers": [[_mean([run.facts(p).inliers for p in pairs]) for pairs in members.values()] for run in runs],
    }


def scene(models: Mapping[int | None, Model], bounds: Bounds) -> list[Trace]:
    """Cameras as wire pyramids and points of models that are in one frame, by method number; None is the truth."""
    size = _pyramid_size(list(models.values()))
    traces = []
    for number, model in models.items():
        names = evenly_of(sorted(model.poses), bounds.cameras)
        traces.append(
            {
                "method": number,
                "points": np.round(model.points, 4).T.tolist(),
                "num_points": model.num_points,
                "cameras": [np.round(_pyramid(model.poses[name], size), 4).tolist() for name in names],
                "names": names,
                "num_cameras": len(model.poses),
            }
        )
    return traces


def _pyramid(pose: np.ndarray, size: float) -> np.ndarray:
    """A camera (5, 3): its centre and the corners of its picture."""
    corners = size * np.array([[0, 0, 0], [-0.8, -0.6, 1], [0.8, -0.6, 1], [0.8, 0.6, 1], [-0.8, 0.6, 1]])
    placed: np.ndarray = corners @ pose[:, :3].T + pose[:, 3]
    return placed


def _pyramid_size(models: Sequence[Model]) -> float:
    """A third of what lies between neighbouring cameras, so that they do not hide each other."""
    centres = [np.array([pose[:, 3] for pose in model.poses.values()]) for model in models if len(model.poses) > 1]
    if not centres:
        return 1.0
    most = max(centres, key=len)[:2000]
    distances = np.linalg.norm(most[:, None] - most[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    return float(np.median(distances.min(axis=1))) / 3 or 1.0


def _mean(values: Sequence[float]) -> float:
    mean = fmean(values)
    return int(mean) if mean == int(mean) else round(mean, 1)
