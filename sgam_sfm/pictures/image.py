"""The picture of one image: its labels, the areas of all its pairs, its keypoints and how long their tracks are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from sgam_core.types import Area, AreaState, PairResult
from sgam_core.wording import counted
from sgam_sfm.colours import distinct_colour
from sgam_sfm.pictures.canvas import (
    INNER,
    LENGTHS,
    NEUTRAL,
    SHADE,
    Bar,
    Canvas,
    ImageView,
    Section,
    Table,
    Tag,
    draw_boxes,
    draw_image,
    evenly,
    header,
    heading,
    row_of,
    stacked,
    table,
)
from sgam_sfm.pictures.legend import label_legend
from sgam_sfm.pictures.pair import DASHES

MAX_BOXES, MAX_ROWS, MAX_DOTS = 40, 20, 800
MAX_LENGTH = 8
"""Images a track where the colours end."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ImagePicture:
    """What is drawn of an image.

    results: of its pairs by the other image's name; the image is image 0 of each. num_listed: its pairs in the list.
    keypoints: (N, 2) pixels, None when there are none yet. track_lengths: (N,) images that see each keypoint's point, 0
    without a point; None when the image is in no model. model: its folder's name. missing: what cannot be drawn, and
    why. label_names: of labels that have one.
    """

    view: ImageView
    results: Mapping[str, PairResult]
    num_listed: int
    keypoints: Float[np.ndarray, "N 2"] | None = None
    track_lengths: Int[np.ndarray, " N"] | None = None
    model: str = ""
    missing: Sequence[str] = ()
    label_names: Mapping[int, str] = field(default_factory=dict)


class AreaUse(NamedTuple):
    """An area of the image, and what became of it in how many of its matches."""

    area: Area
    states: Counter[AreaState]
    partners: tuple[str, ...]

    @property
    def state(self) -> AreaState:
        """The best that became of it."""
        return next(state for state in AreaState if self.states[state])


def draw_single_image(picture: ImagePicture) -> Figure:
    """Draw an image: labels and areas at the left, keypoints at the right, the areas in a table."""
    view, uses = picture.view, area_uses(picture.results)
    lines = [
        f"{view.size[0]} x {view.size[1]} pixels; "
        f"{len(picture.results)} of {counted(picture.num_listed, 'pair')} matched; {_keypoint_fact(picture)}."
    ]
    if picture.missing:
        lines.append(f"Not in this picture: {'; '.join(picture.missing)}.")
    sections = [
        header(view.name, lines),
        heading(
            "Areas and keypoints" if picture.keypoints is not None else "Areas", _facts(picture, uses), _bar(picture)
        ),
        _panels(picture, uses),
        label_legend([view], picture.label_names),
    ]
    if uses:
        sections += [heading("The areas in numbers"), table(_table(uses, picture.label_names))]
    return stacked(sections)


def area_uses(results: Mapping[str, PairResult]) -> list[AreaUse]:
    """The areas of image 0 over all its pairs: those kept most often first, then the larger ones."""
    states: dict[Area, Counter[AreaState]] = {}
    partners: dict[Area, dict[str, None]] = {}
    for partner, result in results.items():
        for match in result.areas:
            states.setdefault(match.area0, Counter())[match.state] += 1
            if match.state is AreaState.KEPT:
                partners.setdefault(match.area0, {})[partner] = None
    uses = [AreaUse(area, counts, tuple(partners.get(area, ()))) for area, counts in states.items()]
    return sorted(uses, key=lambda use: (-use.states[AreaState.KEPT], -use.area.box.area, use.area.box.x0))


def _keypoint_fact(picture: ImagePicture) -> str:
    if picture.keypoints is None:
        return "no keypoints yet"
    count, lengths = len(picture.keypoints), picture.track_lengths
    if lengths is None:
        return counted(count, "keypoint")
    seen = lengths[lengths > 0]
    mean = f", seen by {seen.mean():.1f} images on average" if len(seen) else ""
    return f"{counted(count, 'keypoint')}, {len(seen)} of them with a point in model {picture.model}{mean}"


def _facts(picture: ImagePicture, uses: Sequence[AreaUse]) -> list[str]:
    hidden = len(uses) - MAX_BOXES
    areas = f"{counted(len(uses), 'area')} (outlines) over all pairs, solid where one of their matches was kept" + (
        f"; {hidden} of them are not drawn." if hidden > 0 else "."
    )
    if picture.keypoints is None:
        return [areas]
    shown, count = min(MAX_DOTS, len(picture.keypoints)), len(picture.keypoints)
    rings = "; rings: those without a point" if picture.track_lengths is not None else ""
    return [areas, f"Dots: {shown} of {counted(count, 'keypoint')}{rings}."]


def _bar(picture: ImagePicture) -> Bar | None:
    if picture.track_lengths is None or not picture.track_lengths.any():
        return None
    norm, longest = _norm(picture), int(picture.track_lengths.max())
    ticks = {float(n): str(n) for n in range(2, int(norm.vmax or 0) + 1)}
    if longest > MAX_LENGTH:
        ticks[MAX_LENGTH] = f"{MAX_LENGTH}+"
    return Bar("images that see the point", norm, LENGTHS, ticks, longest > MAX_LENGTH)


def _norm(picture: ImagePicture) -> Normalize:
    longest = 0 if picture.track_lengths is None else int(picture.track_lengths.max(initial=0))
    return Normalize(2, min(max(longest, 3), MAX_LENGTH))


def _panels(picture: ImagePicture, uses: Sequence[AreaUse]) -> Section:
    view = picture.view
    rects = row_of([view.size] * (1 if picture.keypoints is None else 2))

    def draw(canvas: Canvas, top: int) -> None:
        axes = draw_image(canvas, view, rects[0]._replace(top=top), tint=True)
        drawn = list(enumerate(uses[:MAX_BOXES]))
        tags = [
            Tag(
                box=use.area.box,
                text=str(number + 1),
                colour=distinct_colour(number),
                dashes=DASHES[use.state],
                weight=2.4 if use.state is AreaState.KEPT else 1.8,
            )
            for number, use in sorted(drawn, key=lambda item: item[1].state is AreaState.KEPT)
        ]
        draw_boxes(axes, rects[0], view.size, tags)
        if picture.keypoints is not None:
            axes = draw_image(canvas, view, rects[1]._replace(top=top))
            rows = evenly(len(picture.keypoints), MAX_DOTS)
            points = picture.keypoints[rows]
            lengths = np.zeros(len(rows), int) if picture.track_lengths is None else picture.track_lengths[rows]
            with_point = lengths > 0
            colours = LENGTHS(_norm(picture)(lengths[with_point]))
            (x0, y0), (x1, y1) = points[~with_point].T, points[with_point].T
            filling = NEUTRAL if picture.track_lengths is None else "none"
            axes.scatter(x0, y0, s=16, facecolors=filling, edgecolors=NEUTRAL, linewidths=1.0)
            axes.scatter(x1, y1, s=24, c=colours, edgecolors=SHADE, linewidths=0.6)

    return Section(rects[0].height + 8, draw)


def _table(uses: Sequence[AreaUse], names: Mapping[int, str]) -> Table:
    widths = (74, 150, 210, 190, 100, 120, 130, 110)
    rest = len(uses) - MAX_ROWS
    return Table(
        titles=("", "kind", "label", "size", "kept", "rejected", "unresolved", "skipped", "kept with"),
        widths=(*widths, INNER - sum(widths)),
        right=frozenset({"kept", "rejected", "unresolved", "skipped"}),
        rows=[
            (
                str(number + 1),
                use.area.kind,
                "several" if use.area.label is None else names.get(use.area.label, str(use.area.label)),
                f"{use.area.box.width:.0f} x {use.area.box.height:.0f}",
                *(str(use.states[state]) for state in AreaState),
                ", ".join(use.partners),
            )
            for number, use in enumerate(uses[:MAX_ROWS])
        ],
        colours=[distinct_colour(number) for number in range(len(uses[:MAX_ROWS]))],
        rest=f"{counted(rest, 'more area')}." if rest > 0 else "",
    )
