"""Colours for things that are numbered: vivid ones for areas, pale ones for labels beneath them."""

from __future__ import annotations

import colorsys

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""


def distinct_colour(number: int) -> Colour:
    """A vivid colour; neighbours in number are far apart in hue."""
    hue = (0.08 + number * 0.6180339887) % 1.0  # golden ratio: no two of the first hues are close
    red, green, blue = colorsys.hls_to_rgb(hue, (0.58, 0.5, 0.68)[number % 3], 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)


def pale_colour(number: int) -> Colour:
    """The colour of a label beneath other things: none of the vivid ones, so that it is not taken for theirs."""
    red, green, blue = distinct_colour(number)
    return (red + 3 * 255) // 4, (green + 3 * 255) // 4, (blue + 3 * 255) // 4
