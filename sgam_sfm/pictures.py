"""Draw what was found for a pair: labels, numbered areas and point matches over the two images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int32, UInt8

from sgam_core.errors import InputError
from sgam_core.types import AreaState, Box, PairResult

Colour = tuple[int, int, int]

_GAP = 6  # pixels between the two images
_MAX_LINES, _MAX_DOTS = 90, 400
_FONT = cv2.FONT_HERSHEY_DUPLEX
_INK, _GROUND, _WHOLE = (240, 240, 240), (24, 26, 30), (235, 235, 235)
_DASHES = {
    AreaState.KEPT: (1, 0),
    AreaState.REJECTED: (12, 9),
    AreaState.UNRESOLVED: (3, 7),
    AreaState.SKIPPED: (2, 14),
}
_MARKS = {AreaState.KEPT: "", AreaState.REJECTED: "x", AreaState.UNRESOLVED: "?", AreaState.SKIPPED: "-"}
_LEGENDS = {
    AreaState.KEPT: "kept (solid)",
    AreaState.REJECTED: "rejected (dashed, x)",
    AreaState.UNRESOLVED: "unresolved (dotted, ?)",
    AreaState.SKIPPED: "skipped (sparse dots, -)",
}


def draw_areas(
    pixels0: UInt8[np.ndarray, "H0 W0 3"],
    pixels1: UInt8[np.ndarray, "H1 W1 3"],
    result: PairResult,
    labels0: Int32[np.ndarray, "h0 w0"] | None = None,
    labels1: Int32[np.ndarray, "h1 w1"] | None = None,
    max_width: int = 1600,
    title: str = "",
) -> UInt8[np.ndarray, "H W 3"]:
    """The two images side by side under a caption: areas numbered and coloured by match, and a sample of the points.

    Args: pixels0, pixels1 RGB. labels0, labels1: shown as a tint; any size with the image's aspect; 0 stays clear.
        max_width: of the whole picture; images are shrunk to fit, never enlarged. title: first words of the caption.
    Returns: RGB picture.
    """
    half = (max_width - _GAP) // 2
    scales = [min(half / pixels.shape[1], 1.0) for pixels in (pixels0, pixels1)]
    panels = [_panel(pixels0, labels0, scales[0]), _panel(pixels1, labels1, scales[1])]
    left = panels[0].shape[1] + _GAP
    picture = np.full((max(len(panel) for panel in panels), left + panels[1].shape[1], 3), _GROUND, np.uint8)
    picture[: len(panels[0]), : left - _GAP] = panels[0]
    picture[: len(panels[1]), left:] = panels[1]
    _draw_matches(picture, result, scales, left)
    for number in sorted(range(len(result.areas)), key=lambda n: result.areas[n].state is AreaState.KEPT):
        area = result.areas[number]
        for box, scale, shift in ((area.area0.box, scales[0], 0), (area.area1.box, scales[1], left)):
            width = panels[0 if shift == 0 else 1].shape[1]
            _draw_box(picture, box.times(scale, scale), (shift, shift + width), number, area.state)
    return np.concatenate([_caption(result, title, picture.shape[1]), picture])


def write_png(path: Path, pixels: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write RGB pixels (H, W, 3).

    Raises: InputError when the file cannot be written.
    """
    _, encoded = cv2.imencode(".png", pixels[..., ::-1])
    try:
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        raise InputError(f"cannot write picture '{path}' ({error.strerror}); expected a folder that exists") from error


def distinct_colour(number: int) -> Colour:
    """A vivid colour; neighbours in number are far apart in hue."""
    hue = (0.08 + number * 0.6180339887) % 1.0  # golden ratio: no two of the first hues are close
    lightness = (0.58, 0.5, 0.68)[number % 3]
    hls = np.array([[[hue * 180, lightness * 255, 0.95 * 255]]]).astype(np.uint8)
    red, green, blue = cv2.cvtColor(hls, cv2.COLOR_HLS2RGB)[0, 0].tolist()
    return red, green, blue


def _panel(pixels: np.ndarray, labels: np.ndarray | None, scale: float) -> np.ndarray:
    size = (round(pixels.shape[1] * scale), round(pixels.shape[0] * scale))
    panel = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(cv2.cvtColor(panel, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    panel = cv2.addWeighted(panel, 0.72, grey, 0.12, 0)  # a calm ground for the colours that mean something
    if labels is None:
        return panel
    ids, index = np.unique(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT), return_inverse=True)
    index = index.reshape(size[::-1])
    tint = np.array([distinct_colour(int(i)) for i in ids], np.uint8)[index]
    mixed = cv2.addWeighted(panel, 0.83, tint, 0.17, 0)
    panel = np.where((ids == 0)[index][..., None], panel, mixed)
    edges = cv2.morphologyEx(index.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
    panel[edges] = (0.65 * panel[edges] + 0.35 * np.array(_INK)).astype(np.uint8)
    return panel


def _draw_matches(picture: np.ndarray, result: PairResult, scales: list[float], left: int) -> None:
    matches = result.matches
    ends0 = matches.points0 * scales[0]
    ends1 = matches.points1 * scales[1] + [left, 0]
    colours = {area: distinct_colour(area) if area >= 0 else _WHOLE for area in np.unique(matches.area_index).tolist()}
    # Evenly through the matches of all areas in turn, so that the sample is the same on every run.
    order = np.argsort(matches.area_index, kind="stable")
    veil = picture.copy()
    for row in order[_evenly(len(order), _MAX_LINES)]:
        colour = colours[int(matches.area_index[row])]
        cv2.line(veil, _fixed(ends0[row]), _fixed(ends1[row]), colour, 1, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(veil, 0.55, picture, 0.45, 0, dst=picture)
    for row in order[_evenly(len(order), _MAX_DOTS)]:
        for end in (ends0[row], ends1[row]):
            cv2.circle(picture, _fixed(end), 52, _GROUND, -1, cv2.LINE_AA, _SHIFT)
            cv2.circle(picture, _fixed(end), 36, colours[int(matches.area_index[row])], -1, cv2.LINE_AA, _SHIFT)


_SHIFT = 4  # OpenCV draws at 1/16 of a pixel


def _fixed(point: np.ndarray) -> tuple[int, int]:
    """A corner-origin point in OpenCV's fixed-point drawing coordinates, whose origin is a pixel's centre."""
    x, y = np.rint((point - 0.5) * (1 << _SHIFT)).astype(int).tolist()
    return x, y


def _evenly(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(int))


def _draw_box(picture: np.ndarray, box: Box, limits: tuple[int, int], number: int, state: AreaState) -> None:
    left, right = limits
    x0, x1 = (round(float(np.clip(x + left, left + 1, right - 2))) for x in (box.x0, box.x1))
    y0, y1 = (round(float(np.clip(y, 1, len(picture) - 2))) for y in (box.y0, box.y1))
    colour, dash, weight = distinct_colour(number), _DASHES[state], 3 if state is AreaState.KEPT else 2
    corners = ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        for a, b in _dashes(np.array(start, float), np.array(end, float), *dash):
            cv2.line(picture, a, b, _GROUND, weight + 2, cv2.LINE_AA)
        for a, b in _dashes(np.array(start, float), np.array(end, float), *dash):
            cv2.line(picture, a, b, colour, weight, cv2.LINE_AA)
    text = f"{number + 1}{_MARKS[state]}"
    (width, height), _ = cv2.getTextSize(text, _FONT, 0.5, 1)
    x0 = min(x0, right - width - 8)
    cv2.rectangle(picture, (x0, y0), (x0 + width + 7, y0 + height + 8), colour, -1)
    cv2.putText(picture, text, (x0 + 4, y0 + height + 3), _FONT, 0.5, _GROUND, 1, cv2.LINE_AA)


def _dashes(
    start: np.ndarray, end: np.ndarray, dash: int, gap: int
) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """The visible pieces of a side; all of it when there is no gap."""
    length = float(np.linalg.norm(end - start))
    pieces = np.arange(0, length, dash + gap) if gap else np.zeros(1)
    for piece in pieces:
        a, b = (
            start + (end - start) * min(at / max(length, 1), 1.0) for at in (piece, piece + dash if gap else length)
        )
        yield (round(a[0]), round(a[1])), (round(b[0]), round(b[1]))


def _caption(result: PairResult, title: str, width: int) -> np.ndarray:
    counts = Counter(area.state for area in result.areas)
    states = ", ".join(f"{counts[state]} {_LEGENDS[state]}" for state in AreaState if counts[state])
    parts = [title] if title else []
    parts.append(f"{len(result.areas)} area matches" + (f": {states}" if states else ""))
    parts.append(f"{len(result.matches)} point matches")
    parts.append(f"coverage {result.coverage0:.0%} / {result.coverage1:.0%}")
    if result.fallback:
        parts.append(f"whole images: {result.fallback}")
    text = "  |  ".join(parts).encode("ascii", "replace").decode()  # the font has no other letters
    scale = min(0.58, 0.58 * (width - 20) / cv2.getTextSize(text, _FONT, 0.58, 1)[0][0])
    strip = np.full((34, width, 3), _GROUND, np.uint8)
    cv2.putText(strip, text, (10, 22), _FONT, scale, _INK, 1, cv2.LINE_AA)
    return strip
