"""What all pictures are made of: sections beneath each other, text, tables, images, boxes, colour bars.

Everything is laid out in whole pixels of the picture, from its top left corner. A picture is 1600 pixels wide and is
read at little more than half of that on a page, so that no text is smaller than 16 pixels.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Int, Int32, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, fontManager
from matplotlib.ft2font import FT2Font
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from sgam_core.errors import InputError
from sgam_core.types import Box
from sgam_sfm.colours import Colour, distinct_colour, pale_colour
from sgam_sfm.files import replacing

WIDTH, MARGIN, GAP = 1600, 20, 10
INNER = WIDTH - 2 * MARGIN
TITLE, HEADING, TEXT, SMALL = 26, 21, 18, 16
INK, MUTED, GROUND, RULE, SHADE = "#1f2933", "#5b6773", "#ffffff", "#dde3e9", "#15181c"
NEUTRAL, ALARM = "#cfd6dd", "#c62828"
# From near to far in hues that the colour-blind tell apart as well, all of them light enough for a darkened image.
DISTANCES = LinearSegmentedColormap.from_list("distances", ["#2fd0e6", "#ffe14a", "#f2412e"])
LENGTHS = LinearSegmentedColormap.from_list("lengths", ["#5b7cff", "#2fd0e6", "#ffe14a"])

_DPI = 100
_FONT = "DejaVu Sans"  # comes with matplotlib
_SUFFIXES = ("png", "jpg", "jpeg", "webp", "tif", "tiff", "pdf", "svg")
_MAX_SIDE = 1600  # pixels an image is kept at


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ImageView:
    """An image to draw. size: (width, height) of the image itself. pixels, labels: any size of the same aspect."""

    name: str
    size: tuple[int, int]
    pixels: UInt8[np.ndarray, "h w 3"]
    labels: Int32[np.ndarray, "hl wl"] | None = None

    @staticmethod
    def of(name: str, pixels: UInt8[np.ndarray, "H W 3"], labels: Int32[np.ndarray, "h w"] | None = None) -> ImageView:
        """The view of an image, shrunk to what a picture can show of it."""
        height, width = pixels.shape[:2]
        shrunk = resized(pixels, limited((width, height), _MAX_SIDE))
        return ImageView(name=name, size=(width, height), pixels=shrunk, labels=labels)


class Rect(NamedTuple):
    """A place in the picture, in its pixels."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Canvas:
    """A figure that is drawn on in pixels from its top left corner."""

    figure: Figure
    height: int

    def axes(self, rect: Rect, xlim: tuple[float, float] = (0, 1), ylim: tuple[float, float] = (1, 0)) -> Axes:
        """Bare axes in a place; y grows downwards."""
        bottom = self.height - rect.top - rect.height
        axes = self.figure.add_axes(
            (rect.left / WIDTH, bottom / self.height, rect.width / WIDTH, rect.height / self.height)
        )
        axes.set(xlim=xlim, ylim=ylim, facecolor="none")
        axes.set_axis_off()
        return axes

    def text(self, x: float, top: float, text: str, size: int = TEXT, colour: str = INK, **style: Any) -> None:
        """One line of text; further arguments are those of matplotlib's Text."""
        write(self.figure, x / WIDTH, 1 - (top + 0.95 * size) / self.height, text, size, colour, **style)


class Section(NamedTuple):
    """A part of a picture: its height, and what draws it when it knows where its top is."""

    height: int
    draw: Callable[[Canvas, int], None]


def stacked(sections: Sequence[Section]) -> Figure:
    """A picture of sections beneath each other."""
    height = 2 * MARGIN + sum(section.height for section in sections)
    figure = Figure(figsize=(WIDTH / _DPI, height / _DPI), dpi=_DPI, facecolor=GROUND)
    canvas, top = Canvas(figure=figure, height=height), MARGIN
    for section in sections:
        section.draw(canvas, top)
        top += section.height
    return figure


def save_picture(figure: Figure, path: Path) -> None:
    """Write a picture in the format of the file's suffix; missing folders are made.

    Raises: InputError when the suffix is none of a picture, or the file cannot be written.
    """
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in _SUFFIXES:
        raise InputError(f"cannot write picture '{path}': its name ends in none of .{', .'.join(_SUFFIXES)}")
    try:
        with replacing(path) as partial:
            figure.savefig(partial, format=suffix, dpi=_DPI, facecolor=GROUND)
    except OSError as error:
        raise InputError(f"cannot write picture '{path}' ({error.strerror or error}); choose another file") from error


def header(title: str, lines: Sequence[str]) -> Section:
    """The title of a picture and what there is to say of it."""
    wrapped = [piece for line in lines for piece in wrap(line, TEXT, INNER)]

    def draw(canvas: Canvas, top: int) -> None:
        canvas.text(MARGIN, top, fitted(title, TITLE, INNER, "bold"), TITLE, weight="bold")
        for number, line in enumerate(wrapped):
            canvas.text(MARGIN, top + 42 + 26 * number, line, colour=MUTED)

    return Section(52 + 26 * len(wrapped), draw)


class Bar(NamedTuple):
    """A colour bar. ticks: values and their texts. open: larger values have the last colour."""

    label: str
    norm: Normalize
    colours: LinearSegmentedColormap
    ticks: Mapping[float, str]
    open: bool = True


def heading(title: str, lines: Sequence[str] = (), bar: Bar | None = None) -> Section:
    """The title of a part, with a colour bar at its right."""
    width = INNER - (400 if bar else 0)
    wrapped = [piece for line in lines for piece in wrap(line, SMALL, width)]

    def draw(canvas: Canvas, top: int) -> None:
        canvas.text(MARGIN, top + 14, fitted(title, HEADING, width, "bold"), HEADING, weight="bold")
        for number, line in enumerate(wrapped):
            canvas.text(MARGIN, top + 46 + 23 * number, line, SMALL, MUTED)
        if bar:
            draw_bar(canvas, Rect(WIDTH - MARGIN - 360, top + 36, 340, 12), bar)

    return Section(max(50 + 23 * len(wrapped), 76 if bar else 0), draw)


def draw_bar(canvas: Canvas, rect: Rect, bar: Bar) -> None:
    """A horizontal colour bar, its label above and the texts of its ticks beneath."""
    axes = canvas.axes(rect)
    axes.set_axis_on()
    extend: Literal["max", "neither"] = "max" if bar.open else "neither"
    drawn = canvas.figure.colorbar(
        ScalarMappable(bar.norm, bar.colours), cax=axes, orientation="horizontal", ticks=[], extend=extend
    )
    drawn.minorticks_off()
    axes.set_label("colour bar")
    drawn.outline.set_visible(False)
    canvas.text(rect.left, rect.top - 26, bar.label, SMALL, MUTED)
    for value, text in bar.ticks.items():
        x = rect.left + rect.width * float(bar.norm(value))
        canvas.text(x, rect.top + rect.height + 4, text, SMALL, MUTED, ha="center")


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """Rows of text under column titles. widths: of the columns in pixels. colours: of the first cell of each row."""

    titles: Sequence[str]
    widths: Sequence[int]
    rows: Sequence[Sequence[str]]
    colours: Sequence[Colour]
    rest: str = ""
    right: frozenset[str] = field(default_factory=frozenset)


def table(content: Table) -> Section:
    """A table, with a line for the rows that are left out."""
    lefts = [MARGIN + sum(content.widths[:column]) for column in range(len(content.widths))]

    def draw_row(canvas: Canvas, top: int, cells: Sequence[str], **style: Any) -> None:
        for title, left, width, cell in zip(content.titles, lefts, content.widths, cells, strict=True):
            at_right = title in content.right
            x = left + width - 24 if at_right else left + 8
            canvas.text(x, top + 3, fitted(cell, SMALL, width - 16), SMALL, ha="right" if at_right else "left", **style)

    def draw(canvas: Canvas, top: int) -> None:
        draw_row(canvas, top, content.titles, colour=MUTED)
        for number, (cells, colour) in enumerate(zip(content.rows, content.colours, strict=True), start=1):
            axes = canvas.axes(Rect(MARGIN, top + 26 * number, INNER, 26), (0, INNER), (26, 0))
            axes.axhline(0, color=RULE, linewidth=0.8)
            axes.add_patch(Rectangle((0, 3), content.widths[0] - 8, 20, facecolor=rgb(colour)))
            # The number stands on its colour, as it does in the images.
            canvas.text(lefts[0] + 8, top + 26 * number + 3, cells[0], SMALL, ink_on(colour), weight="bold")
            draw_row(canvas, top + 26 * number, ("", *cells[1:]))
        if content.rest:
            canvas.text(MARGIN, top + 26 * (len(content.rows) + 1) + 6, content.rest, SMALL, MUTED)

    return Section(26 * (len(content.rows) + 1) + (32 if content.rest else 6), draw)


def row_of(sizes: Sequence[tuple[int, int]], max_height: int = 760) -> list[Rect]:
    """Where images of these sizes (width, height) go beside each other: all as high, as wide as there is room.

    Returns: places with top 0, centred.
    """
    aspects = [width / height for width, height in sizes]
    room = INNER - GAP * (len(sizes) - 1)
    height = min(room / sum(aspects), max_height)
    widths = [max(int(height * aspect), 1) for aspect in aspects]
    left = MARGIN + (room - sum(widths)) // 2
    places = []
    for width in widths:
        places.append(Rect(left, 0, width, int(height)))
        left += width + GAP
    return places


def draw_image(canvas: Canvas, view: ImageView, rect: Rect, *, tint: bool = False, calm: bool = True) -> Axes:
    """An image, darkened (calm) so that what is drawn over it stands out, or under pale fills of its labels (tint).

    Returns: axes in the image's own pixels.
    """
    axes = canvas.axes(rect, (0, view.size[0]), (view.size[1], 0))
    panel = resized(view.pixels, (rect.width, rect.height))
    if tint and view.labels is not None:
        panel = _filled(panel, view.labels)
    elif calm:
        panel = _calm(panel)
    # Pixels have the corner origin: the first one covers 0..1, where matplotlib alone would centre it on 0.
    extent = (0, view.size[0], view.size[1], 0)
    axes.imshow(panel, extent=extent, aspect="auto", interpolation="nearest")
    return axes


class Tag(NamedTuple):
    """A box over an image: a text in its corner, a colour, the pattern of its line (None: solid), its weight."""

    box: Box
    text: str
    colour: Colour
    dashes: tuple[float, ...] | None
    weight: float


def draw_boxes(axes: Axes, rect: Rect, size: tuple[int, int], tags: Sequence[Tag]) -> None:
    """Boxes over an image of this size (width, height), with their texts where these hide each other least."""
    scale = (rect.width / size[0], rect.height / size[1])
    for tag in tags:
        # Half a line inside the image where a box ends with it.
        x0, x1 = (float(np.clip(x, 1.5 / scale[0], size[0] - 1.5 / scale[0])) for x in (tag.box.x0, tag.box.x1))
        y0, y1 = (float(np.clip(y, 1.5 / scale[1], size[1] - 1.5 / scale[1])) for y in (tag.box.y0, tag.box.y1))
        axes.add_patch(
            Rectangle(
                (x0, y0),
                x1 - x0,
                y1 - y0,
                fill=False,
                edgecolor=rgb(tag.colour),
                linewidth=tag.weight,
                linestyle=line_style(tag.dashes),
                path_effects=[withStroke(linewidth=tag.weight + 1.6, foreground=SHADE)],
            )
        )
    corners = place_tags([tag.box.times(*scale) for tag in tags], [tag.text for tag in tags], (rect.width, rect.height))
    for tag, (x, y) in zip(tags, corners, strict=True):
        width, height = tag_size(tag.text)
        box = Rectangle((x / scale[0], y / scale[1]), width / scale[0], height / scale[1], facecolor=rgb(tag.colour))
        axes.add_artist(box)
        at = ((x + 4) / scale[0], (y + height - 5) / scale[1])
        write(axes, *at, tag.text, TEXT, ink_on(tag.colour), weight="bold", clip_on=True)


def tag_size(text: str) -> tuple[int, int]:
    """Width and height of a tag in pixels."""
    return round(text_width(text, TEXT, "bold")) + 8, 23


def place_tags(boxes: Sequence[Box], texts: Sequence[str], limits: tuple[int, int]) -> list[tuple[float, float]]:
    """Top left corners of the tags of boxes, in the pixels of a panel of (width, height): each along its box's sides.

    A tag takes the first place where it hides no tag before it, or else its box's top left corner.
    """
    placed: list[tuple[float, float, int, int]] = []
    for box, text in zip(boxes, texts, strict=True):
        width, height = tag_size(text)
        left, right = box.x0, max(box.x1 - width, box.x0)
        top, bottom = box.y0, max(box.y1 - height, box.y0)
        spots = [(float(x), top) for x in np.arange(left, right + 1, 12)]
        spots += [(x, float(y)) for y in np.arange(top, bottom + 1, 12) for x in (left, right)]
        spots += [(float(x), bottom) for x in np.arange(left, right + 1, 12)]
        inside = [
            (min(max(x, 0.0), limits[0] - width), min(max(y, 0.0), limits[1] - height))
            for x, y in spots or [(left, top)]
        ]
        free = (
            (x, y)
            for x, y in inside
            if all(x >= a + w or a >= x + width or y >= b + h or b >= y + height for a, b, w, h in placed)
        )
        x, y = next(free, inside[0])
        placed.append((x, y, width, height))
    return [(x, y) for x, y, _, _ in placed]


def evenly(count: int, wanted: int) -> Int[np.ndarray, " K"]:
    """At most `wanted` of the rows 0..count-1, evenly, the same every time."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(int))


def limited(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """A size (width, height) shrunk to a longest side; small ones stay."""
    scale = min(longest / max(size), 1.0)
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)


def resized(pixels: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """An image in another size (width, height)."""
    shrinks = size[0] < pixels.shape[1]
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def ink_on(colour: Colour) -> str:
    """Dark or light, what reads better on a colour."""
    red, green, blue = colour
    return SHADE if 0.299 * red + 0.587 * green + 0.114 * blue > 110 else GROUND


def line_style(dashes: tuple[float, ...] | None) -> Any:
    """A pattern of a line as matplotlib wants it; None: solid."""
    return "solid" if dashes is None else (0, dashes)


def rgb(colour: Colour) -> tuple[float, float, float]:
    """A colour as matplotlib wants it."""
    return colour[0] / 255, colour[1] / 255, colour[2] / 255


def write(target: Axes | Figure, x: float, y: float, text: str, size: int, colour: str, **style: Any) -> None:
    """Text of a size in pixels as it is: `$` and `_` mean nothing, and what no font can draw is written as its code."""
    text, families = _drawable(text)
    target.text(
        x, y, text, fontsize=size * 72 / _DPI, color=colour, family=families, parse_math=False, usetex=False, **style
    )


def text_width(text: str, size: int, weight: str = "normal") -> float:
    """Width of a line of text in pixels."""
    return size * sum(_advance(char, weight) for char in _drawable(text)[0])


def fitted(text: str, size: int, width: float, weight: str = "normal") -> str:
    """The text, or as much of it as fits, an ellipsis in the middle: names differ most at their ends."""
    if text_width(text, size, weight) <= width:
        return text
    for kept in range(len(text) - 1, 1, -1):
        shorter = f"{text[: kept // 2]}…{text[len(text) - (kept - kept // 2) :]}"
        if text_width(shorter, size, weight) <= width:
            return shorter
    return "…"


def wrap(text: str, size: int, width: float) -> list[str]:
    """The text in lines that fit; no line for an empty text."""
    lines: list[str] = []
    for word in text.split(" ") if text else ():
        if lines and text_width(f"{lines[-1]} {word}", size) <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(fitted(word, size, width))
    return lines


@lru_cache(8192)
def _advance(char: str, weight: str) -> float:
    """Width of a character in its size; one of another font counts as a square."""
    font = _sized_font(weight)
    if not font.get_char_index(ord(char)):
        return 1.0
    return font.load_char(ord(char)).linearHoriAdvance / 65536 / 100


@lru_cache(2)
def _sized_font(weight: str) -> FT2Font:
    font = FT2Font(findfont(FontProperties(family=[_FONT], weight=weight)))
    font.set_size(100, 72)
    return font


@lru_cache(1024)
def _drawable(text: str) -> tuple[str, list[str]]:
    """The text, characters that no installed font has as `\\uXXXX`, and the fonts that draw it."""
    families, chars = [_FONT], []
    for char in text:
        family = _family(char) if char.isprintable() else None
        chars.append(char if family else char.encode("unicode_escape", "surrogatepass").decode())
        if family and family not in families:
            families.append(family)
    return "".join(chars), families


@lru_cache(8192)
def _family(char: str) -> str | None:
    """A font that has the character: ours, or an installed one where it is known by its name."""
    if _has(_font_file(), char):
        return _FONT
    for font in fontManager.ttflist:
        # Last Resort has frames for all characters, in place of their shapes.
        usable = font.weight == 400 and font.style == "normal" and not font.name.startswith("Last Resort")
        # The file that matplotlib would choose for the family may be another one than the one listed.
        if usable and _has(font.fname, char) and _has(findfont(FontProperties(family=[font.name])), char):
            return str(font.name)
    return None


@lru_cache(1)
def _font_file() -> str:
    return str(findfont(FontProperties(family=[_FONT])))


@lru_cache(65536)
def _has(file: str, char: str) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return bool(FT2Font(file).get_char_index(ord(char)))
        except (OSError, RuntimeError):
            return False


def _calm(pixels: np.ndarray) -> np.ndarray:
    grey = cv2.cvtColor(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    return np.asarray(cv2.addWeighted(pixels, 0.68, grey, 0.12, 0))


def _filled(pixels: UInt8[np.ndarray, "H W 3"], labels: Int32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "H W 3"]:
    """An image as a bright drawing without colours of its own, under pale fills of its labels; 0 stays grey."""
    colours, void, edges = _label_colours(labels, (pixels.shape[1], pixels.shape[0]), pale_colour)
    light = 0.4 + 0.6 / 255 * cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)[..., None]
    filled: np.ndarray = light * np.where(void, 225, colours)
    filled[edges] = 255
    return filled.astype(np.uint8)


def tinted(
    pixels: UInt8[np.ndarray, "H W 3"], labels: Int32[np.ndarray, "h w"], strength: float
) -> UInt8[np.ndarray, "H W 3"]:
    """An image with a tint for every label but 0, and lines where labels meet; labels may have another size."""
    tint, void, edges = _label_colours(labels, (pixels.shape[1], pixels.shape[0]), distinct_colour)
    mixed = np.where(void, pixels, cv2.addWeighted(pixels, 1 - strength, tint, strength, 0))
    mixed[edges] = (0.65 * mixed[edges] + 0.35 * 240).astype(np.uint8)
    return np.asarray(mixed)


def _label_colours(
    labels: Int32[np.ndarray, "h w"], size: tuple[int, int], colour_of: Callable[[int], Colour]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel the colour of its label, whether it has none (0), and whether labels meet there.

    Args: size: (width, height) of what is returned.
    Returns: (H, W, 3), (H, W, 1) and (H, W).
    """
    ids, index = np.unique(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT), return_inverse=True)
    index = index.reshape(size[::-1])
    colours = np.array([colour_of(int(i)) for i in ids], np.uint8)[index]
    edges = cv2.morphologyEx(index.astype(np.float32), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
    return colours, (ids == 0)[index][..., None], edges
