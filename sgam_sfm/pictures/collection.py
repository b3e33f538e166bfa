"""The contact sheet of a collection: thumbnails, what became of each image, and the graph of verified pairs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sgam_core.wording import counted
from sgam_sfm.pairs import Pair
from sgam_sfm.pictures.canvas import (
    ALARM,
    GROUND,
    INK,
    INNER,
    MARGIN,
    MUTED,
    SMALL,
    TEXT,
    Bar,
    Canvas,
    ImageView,
    Rect,
    Section,
    draw_bar,
    draw_image,
    evenly,
    fitted,
    header,
    heading,
    stacked,
    wrap,
    write,
)

MAX_THUMBNAILS, MAX_NODES, MAX_EDGES, MAX_TROUBLES, MAX_STRONGEST = 60, 600, 600, 8, 8
MIN_INLIERS = 15
"""Where the colours of pairs begin: COLMAP verifies none with fewer inliers."""

_INLIERS = LinearSegmentedColormap.from_list("inliers", ["#b7cfe6", "#3f86c6", "#0d3566"])


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageEntry:
    """An image of the sheet.

    keypoints, verified: number of keypoints and of verified pairs, None when there is no database. model: the folder of
    its model, empty when it has no pose, None when there is no model at all. error: why it could not be used. no_pose:
    why it has no pose, where that is known.
    """

    name: str
    keypoints: int | None
    verified: int | None
    model: str | None
    error: str = ""
    no_pose: str = ""

    @property
    def trouble(self) -> str:
        """What went wrong with it; empty when nothing did."""
        return "failed" if self.error else "no pose" if self.model == "" else ""


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectionPicture:
    """What is drawn of a collection.

    entries: its images in order. inliers: of the verified pairs. num_listed: pairs of the list. num_matched,
    num_failed: those of them that were matched, and that failed, also for an image that cannot be used. missing: what
    cannot be drawn, and why.
    """

    title: str
    entries: Sequence[ImageEntry]
    inliers: Mapping[Pair, int]
    num_listed: int
    num_matched: int
    num_failed: int = 0
    missing: Sequence[str] = ()


def draw_collection(picture: CollectionPicture, thumbnail: Callable[[str], ImageView | None]) -> Figure:
    """Draw the contact sheet of a collection and its match graph.

    Of a large collection, 60 thumbnails evenly through its names are drawn; the graph has up to 600 images and the 600
    strongest of the pairs among them.

    Args: thumbnail: reads an image, None for one that cannot be read; called for those that are drawn.
    """
    nodes = evenly(len(picture.entries), MAX_NODES)
    rows = nodes[evenly(len(nodes), MAX_THUMBNAILS)].tolist()
    shown = [(row + 1, picture.entries[row]) for row in rows]
    sections = [
        header(picture.title, _facts(picture, len(shown))),
        _thumbnails(shown, thumbnail),
        *_graph(picture, nodes.tolist(), set(rows)),
    ]
    return stacked(sections)


def _facts(picture: CollectionPicture, num_shown: int) -> list[str]:
    entries = picture.entries
    failed = sum(bool(entry.error) for entry in entries)
    lines = [
        f"{counted(len(entries), 'image')}, {failed or 'none'} of them failed; "
        f"{counted(picture.num_listed, 'pair')} listed, "
        f"{picture.num_matched} matched, {picture.num_failed or 'none'} failed"
        + ("." if all(entry.verified is None for entry in entries) else f", {len(picture.inliers)} verified.")
    ]
    models = sorted({entry.model for entry in entries if entry.model}, key=int)
    registered = {model: sum(entry.model == model for entry in entries) for model in models}
    if registered:
        parts = (f"model {model} has {counted(count, 'image')}" for model, count in registered.items())
        without = sum(entry.trouble == "no pose" for entry in entries)
        lines.append(f"{', '.join(parts)}; images without a pose: {without}.")
    if picture.missing:
        lines.append(f"Not in this picture: {'; '.join(picture.missing)}.")
    if num_shown < len(entries):
        lines.append(f"{num_shown} thumbnails, evenly through the names; {len(entries) - num_shown} are not drawn.")
    return [line[0].upper() + line[1:] for line in lines]


def _thumbnails(shown: Sequence[tuple[int, ImageEntry]], thumbnail: Callable[[str], ImageView | None]) -> Section:
    columns = _columns(len(shown))
    width = (INNER + 12) // columns - 12
    cell = round(width * 0.75)
    pitch = cell + 82

    def draw(canvas: Canvas, top: int) -> None:
        for place, (number, entry) in enumerate(shown):
            left, upper = MARGIN + place % columns * (width + 12), top + place // columns * pitch
            _thumbnail(canvas, Rect(left, upper, width, cell), entry, None if entry.error else thumbnail(entry.name))
            colour = ALARM if entry.trouble else INK
            canvas.text(left, upper + cell + 6, fitted(f"{number}  {entry.name}", SMALL, width), SMALL, colour)
            for index, line in enumerate(_caption(entry)):
                colour = ALARM if entry.trouble in line and entry.trouble else MUTED
                canvas.text(left, upper + cell + 28 + 22 * index, fitted(line, SMALL, width), SMALL, colour)

    return Section(pitch * ceil(len(shown) / columns), draw)


def _columns(count: int) -> int:
    """Of 4 to 8 columns those that make a wide block and leave the last row fullest."""
    least = min(max(ceil(sqrt(1.6 * count)), 4), 8)
    return min(range(least, 9), key=lambda columns: (-count % columns, columns))


def _thumbnail(canvas: Canvas, place: Rect, entry: ImageEntry, view: ImageView | None) -> None:
    frame = canvas.axes(place, (0, place.width), (place.height, 0))
    frame.add_patch(Rectangle((0, 0), place.width, place.height, facecolor="#eef1f4"))
    if view is None:
        text = "no image" if not entry.error else "failed"
        write(frame, place.width / 2, place.height / 2, text, TEXT, ALARM, ha="center", va="center")
    else:
        scale = min(place.width / view.size[0], place.height / view.size[1])
        width, height = (max(round(side * scale), 1) for side in view.size)
        inner = Rect(place.left + (place.width - width) // 2, place.top + (place.height - height) // 2, width, height)
        draw_image(canvas, view, inner, calm=False)
    if entry.trouble:
        border = canvas.axes(place, (0, place.width), (place.height, 0))
        border.add_patch(
            Rectangle((1.5, 1.5), place.width - 3, place.height - 3, fill=False, edgecolor=ALARM, linewidth=2.2)
        )


def _caption(entry: ImageEntry) -> list[str]:
    """What is said of an image beneath its name."""
    if entry.error:
        return ["failed"]
    model = entry.trouble or (f"model {entry.model}" if entry.model else "")
    if entry.keypoints is None:
        return [model] if model else []
    return [
        counted(entry.keypoints, "keypoint"),
        counted(entry.verified or 0, "pair") + (f", {model}" if model else ""),
    ]


def _graph(picture: CollectionPicture, nodes: Sequence[int], labelled: Collection[int]) -> list[Section]:
    """The verified pairs among some images (rows of the entries), which stand on a circle; some have their number."""
    row = {picture.entries[node].name: index for index, node in enumerate(nodes)}
    among = [(pair, count) for pair, count in picture.inliers.items() if pair[0] in row and pair[1] in row]
    edges = sorted(among, key=lambda item: (-item[1], item[0]))[:MAX_EDGES][::-1]  # the strongest last, on top
    lines = [
        f"{len(edges)} of {counted(len(picture.inliers), 'verified pair')} drawn" + _left_out(picture, among, edges)
    ]
    if not edges:
        lines = ["No verified pair."] if picture.inliers or not picture.missing else ["No pair has been verified."]
    corners, side = circle(len(nodes)), min(440 + 20 * len(nodes), 900)
    norm = LogNorm(MIN_INLIERS, max((count for _, count in edges), default=0) + MIN_INLIERS)

    def draw(canvas: Canvas, top: int) -> None:
        reach = side / (side - 80)  # the circle with its numbers
        axes = canvas.axes(Rect(MARGIN, top, side, side), (-reach, reach), (reach, -reach))
        weights = np.asarray(norm(np.array([count for _, count in edges], float)), float)
        broadest = float(np.clip(110 / len(nodes), 0.8, 4.2))
        curves = [_curve(*(corners[row[name]] for name in pair)) for pair, _ in edges]
        axes.add_collection(LineCollection(curves, colors=_INLIERS(weights), linewidths=0.8 + broadest * weights))
        linked = {name for pair in picture.inliers for name in pair}
        entries = [picture.entries[node] for node in nodes]
        colours = [ALARM if entry.trouble or entry.name not in linked else INK for entry in entries]
        size = 60 if len(nodes) <= MAX_THUMBNAILS else 16
        axes.scatter(corners[:, 0], corners[:, 1], s=size, c=colours, edgecolors=GROUND, linewidths=0.8, zorder=3)
        outside = 1 + 26 / (side / 2 - 40)
        for node, (x, y), colour in zip(nodes, corners * outside, colours, strict=True):
            if node in labelled:
                write(axes, x, y, str(node + 1), SMALL, colour, ha="center", va="center_baseline")
        bar = Bar("inliers of a verified pair", norm, _INLIERS, _ticks(norm), open=False)
        _side(canvas, Rect(MARGIN + side + 60, top, INNER - side - 60, side), picture, bar if edges else None)

    return [heading("Match graph", lines), Section(side, draw)]


def circle(count: int) -> Float[np.ndarray, "N 2"]:
    """Points (N, 2) on the unit circle, clockwise from the top; many leave a gap between the last and the first."""
    gap = count // 20 if count > MAX_THUMBNAILS else 0
    angles = 2 * np.pi * np.arange(count) / max(count + gap, 1)
    return np.stack([np.sin(angles), -np.cos(angles)], axis=1)


def _curve(start: np.ndarray, end: np.ndarray) -> Float[np.ndarray, "K 2"]:
    """Points (K, 2) from one point of the circle to another, bent inwards the more the farther they are apart."""
    t = np.linspace(0, 1, 25)[:, None]
    middle = (start + end) / 2 * max(0.4, 1 - 1.5 * float(np.linalg.norm(end - start)))
    bent: np.ndarray = (1 - t) ** 2 * start + 2 * t * (1 - t) * middle + t**2 * end
    return bent


def _left_out(picture: CollectionPicture, among: Sequence[object], edges: Sequence[object]) -> str:
    parts = []
    if len(among) < len(picture.inliers):
        parts.append(f"{len(picture.inliers) - len(among)} are of images that are not drawn")
    if len(edges) < len(among):
        parts.append(f"the {len(among) - len(edges)} weakest are left out")
    return f"; {' and '.join(parts)}." if parts else "."


def _ticks(norm: LogNorm) -> dict[float, str]:
    """The ends of the colours and the round numbers between them."""
    return {norm.vmin or 0: str(MIN_INLIERS)} | {
        float(value): str(value) for value in (30, 100, 300, 1000, 3000, 10000, 30000) if value <= (norm.vmax or 0)
    }


def _side(canvas: Canvas, place: Rect, picture: CollectionPicture, bar: Bar | None) -> None:
    """Beside the graph: its colours, the images that something went wrong with, the strongest pairs."""
    y = place.top + 10
    if bar:
        draw_bar(canvas, Rect(place.left, y + 26, min(place.width, 600), 14), bar)
        y += 90
    lines: list[tuple[str, str]] = []
    troubled = [entry for entry in picture.entries if entry.trouble]
    if troubled:
        lines.append((f"Failed or without a pose: {len(troubled)}", ALARM))
        for entry in troubled[:MAX_TROUBLES]:
            lines += [(line, MUTED) for line in wrap(_reason(entry), SMALL, place.width)[:2]]
        if len(troubled) > MAX_TROUBLES:
            lines.append((f"and {len(troubled) - MAX_TROUBLES} more", MUTED))
        lines.append(("", MUTED))
    strongest = sorted(picture.inliers.items(), key=lambda item: (-item[1], item[0]))
    if strongest:
        lines.append(("Strongest pairs", INK))
        lines += [(f"{count}  {' - '.join(pair)}", MUTED) for pair, count in strongest[:MAX_STRONGEST]]
    for text, colour in lines[: (place.top + place.height - y) // 25]:
        weight = "normal" if colour == MUTED else "bold"
        canvas.text(place.left, y, fitted(text, SMALL, place.width, weight), SMALL, colour, weight=weight)
        y += 25


def _reason(entry: ImageEntry) -> str:
    if not entry.error:
        return f"{entry.name}: {entry.no_pose or counted(entry.verified or 0, 'verified pair')}"
    # Messages of reading begin with the name, `image 'a.jpg' cannot ...`.
    return f"{entry.name}: {entry.error.removeprefix('image ').removeprefix(repr(entry.name)).lstrip(': ')}"
