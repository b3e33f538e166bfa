"""The legend of the labels in a picture: the pale fills beneath the areas, by how much of the images they cover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.patches import Rectangle

from sgam_sfm.colours import pale_colour
from sgam_sfm.pictures.canvas import (
    INNER,
    MARGIN,
    MUTED,
    RULE,
    SMALL,
    Canvas,
    ImageView,
    Rect,
    Section,
    rgb,
    text_width,
)

MAX_LABELS = 12
_TITLE = "Fills are labels:"


def label_legend(views: Sequence[ImageView], names: Mapping[int, str]) -> Section:
    """The colours of the labels that cover most of the images; nothing where no image has labels."""
    maps = [view.labels for view in views if view.labels is not None]
    if not maps:
        return Section(0, lambda canvas, top: None)
    ids, shares = _shares(maps)
    order = [n for n in np.argsort(-shares, kind="stable").tolist() if ids[n] != 0]
    items = [(int(ids[n]), f"{names.get(int(ids[n]), f'label {ids[n]}')}: {shares[n]:.0%}") for n in order[:MAX_LABELS]]
    start = text_width(_TITLE, SMALL) + 20
    places, left, line = [], start, 0
    for label, text in items:
        width = 24 + text_width(text, SMALL) + 22
        if left + width > INNER:
            left, line = start, line + 1
        places.append((left, line, label, text))
        left += width
    rest = f"; {len(order) - MAX_LABELS} smaller labels are not listed" if len(order) > MAX_LABELS else ""
    void = float(shares[ids == 0].sum())
    note = f"{void:.0%} of the image{'s' * (len(maps) > 1)} has no label{rest}." if void >= 0.005 or rest else ""

    def draw(canvas: Canvas, top: int) -> None:
        axes = canvas.axes(Rect(MARGIN, top, INNER, 26 * (line + 1)), (0, INNER), (26 * (line + 1), 0))
        canvas.text(MARGIN, top + 3, _TITLE, SMALL, MUTED)
        for x, row, label, text in places:
            axes.add_patch(Rectangle((x, 26 * row + 5), 16, 16, facecolor=rgb(pale_colour(label)), edgecolor=RULE))
            canvas.text(MARGIN + x + 24, top + 26 * row + 3, text, SMALL, MUTED)
        canvas.text(MARGIN, top + 26 * (line + 1) + 3, note, SMALL, MUTED)

    return Section(26 * (line + 1 + bool(note)) + 8, draw)


def _shares(maps: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Labels, and how much of the images each covers: a mean over the images, whatever their sizes."""
    ids = np.unique(np.concatenate([np.unique(labels) for labels in maps]))
    return ids, np.mean([[np.mean(labels == label) for label in ids] for labels in maps], axis=0)
