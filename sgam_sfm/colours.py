"""Colours for things that are numbered: labels, areas."""

from __future__ import annotations

import colorsys

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""


def distinct_colour(number: int) -> Colour:
    """A vivid colour; neighbours in number are far apart in hue."""
    hue = (0.08 + number * 0.6180339887) % 1.0  # golden ratio: no two of the first hues are close
    red, green, blue = colorsys.hls_to_rgb(hue, (0.58, 0.5, 0.68)[number % 3], 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)
