"""The picture of a pair: labels and areas, point matches by their distance from the geometry, a table of the areas."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from sgam_core.geometry import sampson_distance
from sgam_core.types import AreaMatch, AreaState, PairResult, TwoViewModel
from sgam_core.wording import counted
from sgam_sfm.colmap.reading import MatchedPoints
from sgam_sfm.colours import distinct_colour
from sgam_sfm.pictures.canvas import (
    DISTANCES,
    INK,
    INNER,
    MARGIN,
    MUTED,
    NEUTRAL,
    SHADE,
    SMALL,
    WIDTH,
    Bar,
    Canvas,
    ImageView,
    Rect,
    Section,
    Table,
    Tag,
    draw_boxes,
    draw_image,
    evenly,
    fitted,
    header,
    heading,
    line_style,
    row_of,
    stacked,
    table,
    text_width,
)
from sgam_sfm.pictures.legend import label_legend

MAX_BOXES, MAX_ROWS, MAX_LINES, MAX_DOTS = 60, 20, 90, 500
MAX_DISTANCE = 4.0
"""Pixels where the colours end: the largest error of an inlier in COLMAP's verification."""

DASHES: Mapping[AreaState, tuple[float, ...] | None] = {
    AreaState.KEPT: None,
    AreaState.REJECTED: (4, 2.5),
    AreaState.UNRESOLVED: (1, 2),
    AreaState.SKIPPED: (1, 5),
}
_CROSS = "\N{MULTIPLICATION SIGN}"
_LEGENDS = {
    AreaState.KEPT: "kept (?: was doubtful)",
    AreaState.REJECTED: f"rejected ({_CROSS})",
    AreaState.UNRESOLVED: "doubtful, unresolved (?)",
    AreaState.SKIPPED: "skipped (-)",
}
_GUIDED = "Guided areas are windows on the ground that a first round found in both images, whatever its labels."
_MARKS = {AreaState.KEPT: "", AreaState.REJECTED: _CROSS, AreaState.UNRESOLVED: "?", AreaState.SKIPPED: "-"}


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Matching:
    """What one run found for a pair. title: over its point matches. inliers: None where COLMAP has not verified it."""

    title: str
    result: PairResult
    inliers: MatchedPoints | None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PairPicture:
    """What is drawn of a pair.

    plain: what the plain matcher found. missing: what cannot be drawn, and why. label_names: of labels that have one.
    """

    views: tuple[ImageView, ImageView]
    matching: Matching
    plain: Matching | None = None
    missing: Sequence[str] = ()
    label_names: Mapping[int, str] = field(default_factory=dict)


def draw_pair(picture: PairPicture) -> Figure:
    """Draw a pair: areas over labels, point matches, the plain matcher's, and the areas in a table."""
    result, views = picture.matching.result, picture.views
    sections = [header(" - ".join(view.name for view in views), _facts(picture))]
    if result.areas or any(view.labels is not None for view in views):
        title = heading("Areas", _area_facts(result)) if result.areas else heading("Labels")
        sections += [title, _areas(views, result), label_legend(views, picture.label_names)]
    sections += _matches(views, picture.matching)
    if picture.plain is not None:
        sections += _matches(views, picture.plain)
    if result.areas:
        sections += [heading("The areas in numbers"), table(_table(result, picture.label_names))]
    return stacked(sections)


def mark(area: AreaMatch, number: int) -> str:
    """What an area match is called in the picture: its number, and a sign where it is not simply kept."""
    return f"{number + 1}{'?' if area.predicted and area.state is AreaState.KEPT else _MARKS[area.state]}"


def _facts(picture: PairPicture) -> list[str]:
    result = picture.matching.result
    lines = [f"No areas, {counted(len(result.matches), 'point match')}."]
    if result.areas:
        lines = [
            f"{counted(len(result.areas), 'area match')}, {counted(len(result.matches), 'point match')}; "
            f"kept areas cover {result.coverage0:.0%} of the left image and {result.coverage1:.0%} of the right one."
        ]
    if result.fallback:
        lines.append(f"Matched as whole images: {result.fallback}.")
    if result.turned:
        lines.append(f"The right image was turned anticlockwise by {result.turned} degrees to be matched.")
    if result.zoom != 1:
        side = "right" if result.zoom < 1 else "left"
        lines.append(f"The {side} image, taken from nearer, was made smaller to be matched as a whole.")
    if result.notes:
        lines.append(f"Limits reached: {'; '.join(result.notes)}.")
    if picture.missing:
        lines.append(f"Not in this picture: {'; '.join(picture.missing)}.")
    return lines


def _area_facts(result: PairResult) -> list[str]:
    counts = Counter(area.state for area in result.areas)
    states = ", ".join(f"{counts[state]} {state}" for state in AreaState if counts[state])
    predicted = sum(area.predicted and area.state is AreaState.KEPT for area in result.areas)
    line = states
    if predicted:
        line += f"; {predicted} of those kept were doubtful, and chosen by geometry (GP)"
    kinds = Counter(area.area0.kind for area in result.areas)
    line += f"; by kind: {', '.join(f'{count} {kind}' for kind, count in kinds.items())}"
    hidden = len(result.areas) - MAX_BOXES
    told = [_GUIDED] if kinds["guided"] else []
    return [f"{line}." + (f" {hidden} of {len(result.areas)} are not drawn." if hidden > 0 else ""), *told]


def _areas(views: tuple[ImageView, ImageView], result: PairResult) -> Section:
    rects = row_of([view.size for view in views])
    numbers = sorted(range(len(result.areas))[:MAX_BOXES], key=lambda n: result.areas[n].state is AreaState.KEPT)

    def draw(canvas: Canvas, top: int) -> None:
        for side, (view, rect) in enumerate(zip(views, rects, strict=True)):
            axes = draw_image(canvas, view, rect._replace(top=top), tint=True)
            tags = [
                Tag(
                    box=(area.area0, area.area1)[side].box,
                    text=mark(area, number),
                    colour=distinct_colour(number),
                    dashes=DASHES[area.state],
                    weight=2.4 if area.state is AreaState.KEPT else 1.8,
                )
                for number in numbers
                for area in (result.areas[number],)
            ]
            draw_boxes(axes, rect, view.size, tags)
        _legend(canvas, top + rects[0].height + 8, result)

    return Section(rects[0].height + (40 if result.areas else 8), draw)


def _legend(canvas: Canvas, top: int, result: PairResult) -> None:
    """Line samples of the states that occur."""
    states = [
        (_LEGENDS[state], DASHES[state]) for state in AreaState if any(area.state is state for area in result.areas)
    ]
    axes = canvas.axes(Rect(MARGIN, top, INNER, 24), (0, INNER), (24, 0))
    canvas.text(MARGIN, top, title := "Outlines are areas:" if states else "", SMALL, MUTED)
    left = text_width(title, SMALL) + 20
    for text, dashes in states:
        axes.add_line(Line2D((left, left + 48), (12, 12), color=INK, linewidth=2, linestyle=line_style(dashes)))
        canvas.text(MARGIN + left + 58, top, text, SMALL, MUTED)
        left += 58 + text_width(text, SMALL) + 36


def _matches(views: tuple[ImageView, ImageView], matching: Matching) -> list[Section]:
    result, inliers = matching.result, matching.inliers
    points = (result.matches.points0, result.matches.points1)
    verified = inliers is not None and len(inliers[0]) > 0
    lined = inliers if inliers is not None and verified else points
    lines, dots = evenly(len(lined[0]), MAX_LINES), evenly(len(points[0]), MAX_DOTS)
    rects = row_of([view.size for view in views])
    norm = Normalize(0, MAX_DISTANCE)

    def draw(canvas: Canvas, top: int) -> None:
        for view, rect in zip(views, rects, strict=True):
            draw_image(canvas, view, rect._replace(top=top))
        row = Rect(rects[0].left, top, rects[1].left + rects[1].width - rects[0].left, rects[0].height)
        axes = canvas.axes(row, (0, row.width), (row.height, 0))
        ends = [_in_row(side, rects, views, lined) for side in (0, 1)]
        colours = _colours(result.two_view, lined, lines, norm)
        axes.add_collection(
            LineCollection(
                list(np.stack([end[lines] for end in ends], axis=1)),
                colors=colours,
                linewidths=1.5 if verified else 0.8,
                alpha=0.85 if verified else 0.5,
                path_effects=[withStroke(linewidth=2.6, foreground=SHADE, alpha=0.35)] if verified else None,
            )
        )
        for side in (0, 1):
            at = _in_row(side, rects, views, points)[dots]
            dot_colours = _colours(result.two_view, points, dots, norm)
            axes.scatter(at[:, 0], at[:, 1], s=22, c=dot_colours, edgecolors=SHADE, linewidths=0.6, zorder=3)

    bar = Bar("Sampson distance in pixels", norm, DISTANCES, {0: "0", 1: "1", 2: "2", 3: "3", 4: "4+"})
    facts = _match_facts(matching, len(lines), len(dots))
    title = heading(matching.title, facts, bar if result.two_view is not None and len(points[0]) else None)
    return [title, Section(rects[0].height + 8, draw)]


def _in_row(
    side: int, rects: Sequence[Rect], views: Sequence[ImageView], points: Sequence[Float[np.ndarray, "M 2"]]
) -> Float[np.ndarray, "M 2"]:
    """The points of a side in the pixels of the row of images."""
    rect, size = rects[side], views[side].size
    scale = np.array([rect.width / size[0], rect.height / size[1]])
    moved: np.ndarray = points[side] * scale + [rect.left - rects[0].left, 0]
    return moved


def _colours(model: TwoViewModel | None, points: Sequence[np.ndarray], rows: np.ndarray, norm: Normalize) -> Any:
    """The colours of some of the matches: by distance, or one where there is no geometry."""
    if model is None:
        return NEUTRAL
    return DISTANCES(norm(_distances(model, points[0][rows], points[1][rows])))


def _distances(model: TwoViewModel, points0: np.ndarray, points1: np.ndarray) -> Float[np.ndarray, " M"]:
    """Sampson distances (M,) in pixels."""
    return np.sqrt(sampson_distance(model.F, points0, points1))


def _match_facts(matching: Matching, num_lines: int, num_dots: int) -> list[str]:
    result, inliers = matching.result, matching.inliers
    count, model = len(result.matches), result.two_view
    if model is not None and count:
        distances = _distances(model, result.matches.points0, result.matches.points1)
        near = np.count_nonzero(distances <= 1) / count
        found = (
            f"{counted(count, 'point match')}, {near:.0%} of them within 1 pixel of the pair's "
            f"{'essential' if model.calibrated else 'fundamental'} matrix (median {np.median(distances):.2f})"
        )
    else:
        found = (
            f"{counted(count, 'point match')}; no two-view geometry was found, so that their colour tells no distance"
        )
    if inliers is None:
        checked = "not verified by COLMAP"
    elif len(inliers[0]):
        checked = f"{counted(len(inliers[0]), 'inlier')} after COLMAP's verification"
    else:
        checked = "no inlier was left by COLMAP's verification"
    verified = inliers is not None and len(inliers[0]) > 0
    lined = counted(num_lines, "match")
    if inliers is not None and verified:
        lined = f"{num_lines} of {counted(len(inliers[0]), 'inlier')}"
    return [f"{found}; {checked}.", f"Dots: {num_dots} of {counted(count, 'point match')}. Lines: {lined}."]


def _table(result: PairResult, names: Mapping[int, str]) -> Table:
    widths = (64, 120, 120, 130, 140, 80, 100, 90)
    areas = result.areas[:MAX_ROWS]
    rest = Counter(area.state for area in result.areas[MAX_ROWS:])
    reason = WIDTH - 2 * MARGIN - sum(widths)
    return Table(
        titles=("", "kind", "label", "state", "scale", "zoom", "matches", "inliers", "reason"),
        widths=(*widths, reason),
        right=frozenset({"scale", "zoom", "matches", "inliers"}),
        rows=[
            (
                mark(area, number),
                area.area0.kind,
                fitted(_label(area, names), SMALL, widths[2] - 16),
                "kept, by GP" if area.predicted and area.state is AreaState.KEPT else str(area.state),
                f"{area.scale0:.2f} / {area.scale1:.2f}" if area.scale0 else "-",
                f"{_zoom(area, result):.1f}x" if area.scale0 else "-",
                str(area.num_matches),
                str(area.num_inliers),
                area.reason,
            )
            for number, area in enumerate(areas)
        ],
        colours=[distinct_colour(number) for number in range(len(areas))],
        rest=" ".join(
            [
                "scale: matcher pixels an image pixel, left / right; zoom: how much finer than the whole image.",
                *(
                    [f"{sum(rest.values())} more: {', '.join(f'{n} {state}' for state, n in rest.items())}."]
                    if rest
                    else []
                ),
            ]
        ),
    )


def _zoom(area: AreaMatch, result: PairResult) -> float:
    return (area.scale0 / result.whole_scale0 + area.scale1 / result.whole_scale1) / 2


def _label(area: AreaMatch, names: Mapping[int, str]) -> str:
    labels = [
        "several" if label is None else names.get(label, str(label)) for label in (area.area0.label, area.area1.label)
    ]
    return labels[0] if labels[0] == labels[1] else " / ".join(labels)
