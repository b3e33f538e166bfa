"""From compare.json and the output folders to report.html."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from sgam_core.wording import counted
from sgam_sfm.comparison.harder import cut_folder, read_windows
from sgam_sfm.comparison.report import gallery, geometry, plots, table
from sgam_sfm.comparison.report.bounds import Bounds, evenly_of
from sgam_sfm.comparison.report.runs import MethodRun, read_run
from sgam_sfm.evaluation.ground_truth import TrueView
from sgam_sfm.evaluation.projection import inverse
from sgam_sfm.files import replacing

_PAGE = Path(__file__).parent / "page"
_UNALIGNED = "its model shares too few images to be aligned; it is not in the 3D view"


def write_report(output: Path, content: Mapping[str, Any], bounds: Bounds | None = None) -> Path:
    """Write OUT/report.html, one file that needs no network and no other file.

    Args: output: folder of a comparison, with a folder for each method. content: of its compare.json.
    Returns: the path of the report.
    """
    path = output / "report.html"
    page = render(output, content, bounds or Bounds())
    with replacing(path) as partial:
        partial.write_text(page, encoding="utf-8")
    return path


def render(output: Path, content: Mapping[str, Any], bounds: Bounds) -> str:
    """The report as HTML."""
    collection, truth = content["collection"], content["collection"]["ground_truth"]
    images = Path(collection["images"])
    runs = [read_run(output, number, method) for number, method in enumerate(content["methods"])]
    reference = next(run for run in runs if run.content["slug"] == content["reference"])
    names = collection["names"]
    true = geometry.true_views(truth, names, read_windows(cut_folder(output, collection["hard"])))
    read = {run.number: geometry.read_model(run.model, bounds) for run in runs if run.model is not None}
    models, unaligned = _aligned(read, reference.number, true.views)
    data = {
        "methods": [run.name for run in runs],
        "reference": reference.number,
        "names": names,
        "thumbnails": {names.index(n): uri for n, uri in gallery.thumbnails(names, images, bounds).items()},
        "curves": _pose_curves(runs, read, true, bounds),
        **_pose_errors(runs, names, true.views, images, models, bounds),
        "matrices": plots.pair_matrices(runs, names, bounds),
        "coverage": plots.coverages(runs, names, bounds),
        "stages": plots.stage_seconds(content["methods"]),
        "tracks": plots.track_histograms(content["methods"], bounds),
        "scene": plots.scene(_upright(models), bounds) if models else [],
    }
    return _template().render(
        title=output.resolve().name,
        collection=collection,
        images=images.name,
        truth=None if truth is None else truth | {"name": PurePath(truth["path"]).name},
        no_truth=true.missing,
        reference=reference.name,
        reference_slug=content["reference"],
        methods=content["methods"],
        cards=table.cards(content),
        groups=table.table_groups(content),
        remarks=table.remarks(content) + [(runs[number].name, _UNALIGNED) for number in unaligned],
        marks=table.MARKS,
        counted=counted,
        data=_finite(data),
        gallery=gallery.make_gallery(runs, reference, images, bounds),
        bounds=bounds.sentences(),
        versions=content["versions"],
        style=_file("style.css"),
        script=_file("page.js"),
        plotly=Markup(get_plotlyjs()),
    )


def _template() -> Template:
    environment = Environment(loader=FileSystemLoader(_PAGE), autoescape=True, undefined=StrictUndefined)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment.get_template("page.html")


def _pose_curves(
    runs: Sequence[MethodRun],
    models: Mapping[int, geometry.Model],
    true: geometry.TrueViews,
    bounds: Bounds,
) -> list[plots.Trace]:
    """Cumulative pose errors of the models; empty without two true views."""
    if len(true.views) < 2:
        return []
    errors = {run.number: geometry.curve_errors(models.get(run.number), true.views, bounds) for run in runs}
    return plots.pose_curves(errors, bounds)


def _pose_errors(
    runs: Sequence[MethodRun],
    names: Sequence[str],
    views: Mapping[str, TrueView],
    images: Path,
    models: Mapping[int | None, geometry.Model],
    bounds: Bounds,
) -> dict[str, list[plots.Trace]]:
    """Errors of two-view poses against what the views differ by; empty without the truth."""
    sizes = gallery.image_sizes([name for name in names if name in views], images)
    pairs = sorted({pair for run in runs for pair in run.pairs if all(name in sizes for name in pair)})
    points = [model.points for number, model in models.items() if number is not None]
    if not views or not pairs or not points:
        return {"by_angle": [], "by_scale": []}
    changes = geometry.view_changes(pairs, views, np.concatenate(points))
    chosen = evenly_of(sorted(changes), bounds.pose_pairs)
    errors = {run.number: geometry.pair_errors(run, chosen, views, sizes, bounds) for run in runs}
    shown = {pair: changes[pair] for pair in chosen}
    return {f"by_{what}": plots.errors_by(what, errors, shown, names) for what in ("angle", "scale")}


def _aligned(
    read: Mapping[int, geometry.Model], reference: int, views: Mapping[str, TrueView]
) -> tuple[dict[int | None, geometry.Model], list[int]]:
    """The models in the frame of the truth, or else of the first model (the reference's before others).

    Returns: by method number, None for the truth; and the methods whose model cannot be aligned.
    """
    found: dict[int | None, geometry.Model] = {}
    poses: Mapping[str, np.ndarray] = {}
    if views:
        poses = {name: inverse(pose) for name, view in views.items() if (pose := view.cam_from_world) is not None}
        found[None] = geometry.Model(poses=poses, points=np.zeros((0, 3)), num_points=0)
    elif read:
        first = reference if reference in read else min(read)
        found[first], poses = read[first], read[first].poses
    moved = {number: geometry.aligned(model, poses) for number, model in read.items() if number not in found}
    found |= {number: model for number, model in moved.items() if model is not None}
    in_order = dict(sorted(found.items(), key=lambda item: -1 if item[0] is None else item[0]))
    return in_order, [number for number, model in moved.items() if model is None]


def _upright(models: Mapping[int | None, geometry.Model]) -> dict[int | None, geometry.Model]:
    turn = geometry.upright(list(models.values()))
    turned = [geometry.moved(model, turn) for model in models.values()]
    return dict(zip(models, geometry.without_far_points(turned), strict=True))


def _file(name: str) -> Markup:
    return Markup((_PAGE / name).read_text(encoding="utf-8"))


def _finite(value: Any) -> Any:
    """The same without values that JSON cannot hold."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list | tuple) else value
