"""The pictures on the room's surfaces, drawn with OpenCV over noise of several octaves: every zoom shows detail.

Every function takes its own generator or seed: the same room comes out on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

Colour = tuple[int, int, int]
Picture = UInt8[np.ndarray, "_ _ 3"]

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_WORDS = ("AREA", "POINT", "EPIPOLE", "ROTATION", "PARALLAX", "TRACK", "BUNDLE", "RANSAC", "SAMPSON", "DEPTH", "CAMERA")


def _texel(point: np.ndarray) -> tuple[int, int]:
    return int(point[0]), int(point[1])


def noise(
    rng: np.random.Generator, size: tuple[int, int], cell: float, octaves: int = 5, gain: float = 0.6
) -> Float[np.ndarray, "h w"]:
    """Value noise of (width, height) texels, about unit variance: `octaves` layers from `cell` texels downwards."""
    width, height = size
    total, power = np.zeros((2, 2), np.float32), 0.0
    for octave in range(octaves):
        step = max(cell / 2**octave, 1.0)
        grid = (int(width / step) + 2, int(height / step) + 2)
        layer = rng.standard_normal(grid[::-1], np.float32)
        total = cv2.resize(total, grid, interpolation=cv2.INTER_CUBIC) + np.float32(gain**octave) * layer
        power += gain ** (2 * octave)
    return cv2.resize(total, size, interpolation=cv2.INTER_CUBIC) * np.float32(1.3 / np.sqrt(power))


def shaded(base: Picture, brightness: Float[np.ndarray, "h w"]) -> Picture:
    """`base` with `brightness` grey levels added to all channels."""
    return cv2.add(base, cv2.merge([brightness.astype(np.int16)] * 3), dtype=cv2.CV_8U)  # saturates


def plain(size: tuple[int, int], colour: Colour) -> Picture:
    """One colour."""
    return np.full((size[1], size[0], 3), colour, np.uint8)


def grainy(
    rng: np.random.Generator, size: tuple[int, int], colour: Colour, cell: float = 60, strength: float = 9
) -> Picture:
    """One colour with noise at all scales: paint, paper, plaster."""
    return shaded(plain(size, colour), strength * noise(rng, size, cell, octaves=7, gain=0.8))


def plaster(rng: np.random.Generator, size: tuple[int, int], colour: Colour, marks: int) -> Picture:
    """A painted wall: blotches, cracks, specks and dabs."""
    picture = grainy(rng, size, colour, cell=250, strength=8)
    for _ in range(marks):
        centre = rng.uniform(0, size, 2)
        tone = np.clip(np.array(colour) + rng.normal(-18, 22), 0, 255)
        kind = rng.integers(3)
        if kind == 0:
            walk = centre + np.cumsum(rng.normal(0, 12, (rng.integers(4, 12), 2)), axis=0)
            cv2.polylines(picture, [walk.astype(np.int32)], False, tone.tolist(), 1, cv2.LINE_AA)
        elif kind == 1:
            axes = _texel(rng.uniform(2, 9, 2))
            cv2.ellipse(picture, _texel(centre), axes, rng.uniform(0, 180), 0, 360, tone.tolist(), -1, cv2.LINE_AA)
        else:
            blot = centre + rng.uniform(-22, 22, (rng.integers(3, 6), 2))
            cv2.fillPoly(picture, [cv2.convexHull(blot.astype(np.int32))], tone.tolist(), cv2.LINE_AA)
    return shaded(picture, 4 * noise(rng, size, 3, octaves=2))


def bricks(rng: np.random.Generator, size: tuple[int, int], brick: tuple[int, int], colour: Colour) -> Picture:
    """A brick wall in running bond, every brick with a tone, chips and pores of its own."""
    width, height = size
    picture = grainy(rng, size, (196, 186, 172), cell=40, strength=10)
    wide, tall = brick
    for row, top in enumerate(range(0, height, tall)):
        for left in range(-(row % 2) * wide // 2, width, wide):
            tone = np.clip(np.array(colour) * rng.normal(1, 0.17) + rng.normal(0, 9, 3), 0, 255)
            jitter = rng.integers(0, 4, 4)
            low = (left + 5 + jitter[0], top + 5 + jitter[1])
            high = (left + wide - 4 - jitter[2], top + tall - 4 - jitter[3])
            cv2.rectangle(picture, low, high, tone.tolist(), -1)
            for _ in range(3):
                spot = _texel(rng.uniform(low, high))
                cv2.circle(picture, spot, int(rng.integers(2, 7)), (tone * rng.uniform(0.75, 1.15)).tolist(), -1)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8)
    return shaded(picture, 9 * noise(rng, size, 30, octaves=5, gain=0.85))


def whitewashed(rng: np.random.Generator, wall: Picture, colour: Colour, cover: float) -> Picture:
    """`wall` under old plaster that has come off in patches; `cover`: about the share that still holds."""
    size = (wall.shape[1], wall.shape[0])
    patches = noise(rng, size, 420, octaves=8, gain=0.55)
    level = np.quantile(patches[::8, ::8], 1 - cover)
    coat = plaster(rng, size, colour, marks=500)
    holds = np.clip((patches - level) / 0.05, 0, 1)[..., None]  # a crisp rim
    shadow = np.clip(1 - np.abs(patches - level + 0.04) / 0.06, 0, 1)
    return shaded((wall * (1 - holds) + coat * holds).astype(np.uint8), -60 * shadow)


def planks(
    rng: np.random.Generator, size: tuple[int, int], wide: int, colour: Colour, long: tuple[int, int] = (350, 900)
) -> Picture:
    """Floor boards along x: tones, grain, knots and nails."""
    width, height = size
    tone, grain = np.zeros((height, width), np.float32), noise(rng, (width // 16 + 1, height), 14, 4, 0.8)
    picture = shaded(plain(size, colour), 9 * cv2.resize(grain, size, interpolation=cv2.INTER_CUBIC))
    for top in range(0, height, wide):
        left = -int(rng.integers(0, long[1]))
        while left < width:
            right = left + int(rng.integers(*long))
            part = (slice(top, top + wide), slice(max(left, 0), max(right, 0)))
            tone[part] = rng.normal(0, 13)
            for _ in range(rng.integers(0, 4)):
                spot = (int(rng.integers(left, right)), top + int(rng.integers(0, wide)))
                axes = (int(rng.integers(5, 16)), int(rng.integers(3, 8)))
                for ring in (1.0, 0.7, 0.4):
                    knot = (np.array(colour) * (0.45 + 0.35 * ring)).tolist()
                    cv2.ellipse(picture, spot, (int(axes[0] * ring), int(axes[1] * ring)), 0, 0, 360, knot, 2)
            for nail in ((right - 8, top + wide // 4), (right - 8, top + 3 * wide // 4)):
                cv2.circle(picture, nail, 3, (52, 44, 40), -1, cv2.LINE_AA)
            tone[top : top + wide, max(right - 2, 0) : max(right, 0)] = -50
            left = right
        tone[top : top + 2] = -50
    return shaded(picture, tone + 5 * noise(rng, size, 120, octaves=7, gain=0.8))


def wallpaper(rng: np.random.Generator, size: tuple[int, int], colour: Colour, leaves: int) -> Picture:
    """Sprigs strewn over a painted ground; no two places look alike."""
    picture = grainy(rng, size, colour, cell=200, strength=5)
    palette = ((94, 128, 92), (146, 164, 110), (186, 112, 84), (72, 98, 104), (206, 170, 96))
    for _ in range(leaves):
        centre, angle = rng.uniform(0, size, 2), rng.uniform(0, 360)
        ink = np.clip(np.array(palette[rng.integers(len(palette))]) + rng.normal(0, 10), 0, 255).tolist()
        length = rng.uniform(18, 46)
        along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        cv2.line(picture, _texel(centre - along * length), _texel(centre + along * length), ink, 2, 16)
        for offset in rng.uniform(-0.9, 0.9, rng.integers(3, 7)):
            spot = _texel(centre + along * length * offset)
            lean = angle + rng.choice([-45, 45])
            axes = (int(rng.uniform(8, 17)), int(rng.uniform(3, 7)))
            cv2.ellipse(picture, spot, axes, lean, 0, 360, ink, -1, cv2.LINE_AA)
    return shaded(picture, 4 * noise(rng, size, 6, octaves=3, gain=0.8))


def carpet(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    """An oriental carpet: borders, a medallion, and knots strewn at random."""
    width, height = size
    picture = plain(size, (122, 32, 38))
    inks = ((226, 196, 140), (36, 52, 92), (190, 92, 56), (232, 220, 196), (60, 96, 88))
    for index, inset in enumerate((20, 44, 60, 130, 146)):
        cv2.rectangle(picture, (inset, inset), (width - inset, height - inset), inks[index % 5], 8 if index % 2 else 14)
    for side in range(0, 2 * (width + height), 62):  # rosettes along the border
        x, y = _along_border(side, width - 190, height - 190)
        ink = inks[rng.integers(5)]
        cv2.circle(picture, (95 + x, 95 + y), int(rng.integers(14, 26)), ink, -1, cv2.LINE_AA)
        cv2.circle(picture, (95 + x, 95 + y), 8, inks[rng.integers(5)], -1, cv2.LINE_AA)
    for _ in range(260):
        spot = np.array([rng.uniform(180, width - 180), rng.uniform(180, height - 180)])
        petals, radius, ink = rng.integers(3, 8), rng.uniform(8, 26), inks[rng.integers(5)]
        angles = rng.uniform(0, 6.28) + np.linspace(0, 2 * np.pi, 2 * petals, endpoint=False)
        reach = radius * np.where(np.arange(2 * petals) % 2, 0.4, 1.0)
        star = spot + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        cv2.fillPoly(picture, [star.astype(np.int32)], ink, cv2.LINE_AA)
    middle = (width // 2, height // 2)
    for scale, ink in (
        (1.0, inks[1]),
        (0.86, inks[0]),
        (0.8, inks[2]),
        (0.55, inks[4]),
        (0.4, inks[3]),
        (0.2, inks[1]),
    ):
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        reach = scale * (1 + 0.12 * np.cos(8 * angles))
        rim = np.stack([width * 0.24 * reach * np.cos(angles), height * 0.3 * reach * np.sin(angles)], axis=1)
        cv2.fillPoly(picture, [(rim + middle).astype(np.int32)], ink, cv2.LINE_AA)
    return shaded(picture, 14 * noise(rng, size, 60, octaves=6, gain=0.95))


def _along_border(distance: int, width: int, height: int) -> tuple[int, int]:
    distance %= 2 * (width + height)
    if distance < width:
        return distance, 0
    if distance < width + height:
        return width, distance - width
    if distance < 2 * width + height:
        return 2 * width + height - distance, height
    return 0, 2 * (width + height) - distance


def wood(rng: np.random.Generator, size: tuple[int, int], colour: Colour) -> Picture:
    """Grain along y, and a few dents."""
    width, height = size
    grain = cv2.resize(noise(rng, (width, height // 24 + 2), 30, 5, 0.8), size, interpolation=cv2.INTER_CUBIC)
    picture = shaded(plain(size, colour), 12 * grain)
    for _ in range(width * height // 9000):
        dent = (np.array(colour) * rng.uniform(0.5, 0.9)).tolist()
        cv2.ellipse(picture, _texel(rng.uniform(0, size, 2)), (2, int(rng.integers(3, 14))), 0, 0, 360, dent, -1)
    return shaded(picture, 5 * noise(rng, size, 40, octaves=6, gain=0.8))


def fabric(rng: np.random.Generator, size: tuple[int, int], colours: Sequence[Colour]) -> Picture:
    """A patchwork of checked cloth."""
    width, height = size
    picture = plain(size, colours[0])
    for _ in range(70):
        low = rng.uniform(-40, size, 2)
        high = low + rng.uniform(15, 90, 2)
        cv2.rectangle(picture, _texel(low), _texel(high), colours[int(rng.integers(len(colours)))], -1)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    weave = 6.0 * np.sign(np.sin(x * 0.7)) * np.sign(np.sin(y * 0.7))
    return shaded(picture, weave.astype(np.float32) + 8 * noise(rng, size, 60, octaves=6, gain=0.8))


def marble(rng: np.random.Generator, size: tuple[int, int], colour: Colour) -> Picture:
    """Veins where a strongly warped noise crosses zero."""
    veins = np.exp(-np.abs(noise(rng, size, 220, octaves=6, gain=0.6)) * 9)
    fine = np.exp(-np.abs(noise(rng, size, 70, octaves=5, gain=0.7)) * 10)
    return shaded(plain(size, colour), -70 * veins - 40 * fine + 5 * noise(rng, size, 12, octaves=4, gain=0.8))


def ceramic(rng: np.random.Generator, size: tuple[int, int], glaze: Colour, ink: Colour) -> Picture:
    """A glazed pot: rings and painted flowers."""
    width, height = size
    picture = grainy(rng, size, glaze, cell=50, strength=7)
    for y in rng.uniform(0, height, 7):
        cv2.line(picture, (0, int(y)), (width, int(y)), ink, int(rng.integers(1, 7)), cv2.LINE_AA)
    for _ in range(width * height // 5000):
        spot, radius = rng.uniform(0, size, 2), rng.uniform(6, 20)
        for angle in np.linspace(0, 2 * np.pi, int(rng.integers(4, 8)), endpoint=False):
            petal = _texel(spot + radius * np.array([np.cos(angle), np.sin(angle)]))
            cv2.ellipse(picture, petal, (int(radius * 0.6), 3), np.degrees(angle), 0, 360, ink, -1, cv2.LINE_AA)
        cv2.circle(picture, _texel(spot), 4, (214, 170, 60), -1, cv2.LINE_AA)
    return shaded(picture, 4 * noise(rng, size, 5, octaves=3, gain=0.8))


def spine(rng: np.random.Generator, size: tuple[int, int], colour: Colour) -> Picture:
    """The back of a book: bands, and a title that runs along it."""
    width, height = size
    picture = grainy(rng, size, colour, cell=30, strength=8)
    ink = (236, 214, 150) if sum(colour) < 380 else (48, 36, 44)
    for share in (0.06, 0.1, rng.uniform(0.8, 0.86), 0.93):
        cv2.line(picture, (0, int(height * share)), (width, int(height * share)), ink, int(rng.integers(1, 5)))
    title = np.zeros((width, int(height * 0.66), 3), np.uint8)
    words = " ".join(rng.choice(_WORDS, 2, replace=False))
    (text_width, text_height), _ = cv2.getTextSize(words, _FONT, 1.0, 2)
    scale = min(title.shape[1] / text_width, 0.6 * width / text_height)
    cv2.putText(title, words, (2, int(width * 0.72)), _FONT, scale, (255, 255, 255), 2, cv2.LINE_AA)
    turned = cv2.rotate(title, cv2.ROTATE_90_CLOCKWISE).astype(np.float32) / 255
    top = int(height * 0.12)
    part = picture[top : top + turned.shape[0]]
    picture[top : top + turned.shape[0]] = (part * (1 - turned) + np.array(ink) * turned).astype(np.uint8)
    return picture


def framed(rng: np.random.Generator, canvas: Picture, border: int, colour: Colour) -> Picture:
    """A canvas in a mount, with brush strokes over all of it."""
    painted = shaded(canvas, 9 * noise(rng, (canvas.shape[1], canvas.shape[0]), 40, octaves=6, gain=0.9))
    return cv2.copyMakeBorder(painted, border, border, border, border, cv2.BORDER_CONSTANT, value=colour)


def landscape(rng: np.random.Generator, size: tuple[int, int], dusk: bool = False) -> Picture:
    """A sky with a sun above ridges, a meadow with trees."""
    width, height = size
    top, low = ((58, 60, 112), (240, 150, 96)) if dusk else ((96, 150, 210), (226, 232, 220))
    share = np.linspace(0, 1, height)[:, None, None] ** 0.7
    sky = np.array(top) * (1 - share) + np.array(low) * share
    picture = np.repeat(sky, width, axis=1).astype(np.uint8)
    clouds = np.maximum(noise(rng, (width, height), width / 4, octaves=6, gain=0.6), 0.2) - 0.2
    picture = shaded(picture, 50 * clouds)
    sun = (int(width * rng.uniform(0.2, 0.8)), int(height * 0.3))
    cv2.circle(picture, sun, height // 11, (255, 236, 170), -1, cv2.LINE_AA)
    for ridge in range(5):
        level = height * (0.42 + 0.13 * ridge)
        line = noise(rng, (width, 8), width / (2 + ridge), octaves=6, gain=0.5)[0] * height * 0.055 + level
        tone = np.array((112, 128, 158)) * (1 - ridge / 5) + np.array((52, 92, 44)) * ridge / 5
        outline = np.stack([np.arange(width), line], axis=1).astype(np.int32)
        below = np.concatenate([outline, [[width, height], [0, height]]]).astype(np.int32)
        cv2.fillPoly(picture, [below], (tone * (0.7 if dusk else 1.0)).tolist(), cv2.LINE_AA)
    for _ in range(60):
        x, y = int(rng.uniform(0, width)), int(rng.uniform(height * 0.72, height))
        crown = int(rng.uniform(0.015, 0.04) * height)
        green = np.clip(np.array((58, 98, 46)) * rng.uniform(0.5, 1.4), 0, 255).tolist()
        cv2.line(picture, (x, y), (x, y + 2 * crown), (70, 50, 36), max(crown // 4, 1))
        cv2.circle(picture, (x, y), crown, green, -1, cv2.LINE_AA)
    return picture


def composition(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    """Discs, arcs, triangles and rules on a warm ground."""
    height = size[1]
    picture = grainy(rng, size, (232, 218, 186), cell=200, strength=8)
    inks = ((196, 52, 40), (30, 66, 132), (236, 178, 40), (28, 28, 34), (64, 132, 108), (212, 120, 150))
    for _ in range(34):
        spot, ink = rng.uniform(0, size, 2), inks[rng.integers(len(inks))]
        radius = int(rng.uniform(0.02, 0.16) * height)
        kind = rng.integers(4)
        if kind == 0:
            cv2.circle(picture, _texel(spot), radius, ink, -1, cv2.LINE_AA)
            cv2.circle(picture, _texel(spot), radius // 2, inks[rng.integers(len(inks))], -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.ellipse(picture, _texel(spot), (radius, radius), rng.uniform(0, 360), 0, 200, ink, 7, cv2.LINE_AA)
        elif kind == 2:
            cv2.fillPoly(picture, [(spot + rng.uniform(-radius, radius, (3, 2))).astype(np.int32)], ink, cv2.LINE_AA)
        else:
            end = spot + rng.uniform(-3 * radius, 3 * radius, 2)
            cv2.line(picture, _texel(spot), _texel(end), ink, int(rng.integers(2, 7)), cv2.LINE_AA)
    return picture


def blocks(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    """Coloured fields between black rules."""
    picture = plain(size, (238, 234, 224))
    inks = ((206, 40, 36), (32, 70, 150), (242, 202, 48), (238, 234, 224), (226, 222, 210), (40, 40, 44))

    def split(x0: int, y0: int, x1: int, y1: int, depth: int) -> None:
        if depth == 0 or min(x1 - x0, y1 - y0) < 90:
            cv2.rectangle(picture, (x0, y0), (x1, y1), inks[rng.integers(len(inks))], -1)
            cv2.rectangle(picture, (x0, y0), (x1, y1), (24, 24, 28), 9)
        elif x1 - x0 > y1 - y0:
            cut = int(x0 + (x1 - x0) * rng.uniform(0.25, 0.75))
            split(x0, y0, cut, y1, depth - 1)
            split(cut, y0, x1, y1, depth - 1)
        else:
            cut = int(y0 + (y1 - y0) * rng.uniform(0.25, 0.75))
            split(x0, y0, x1, cut, depth - 1)
            split(x0, cut, x1, y1, depth - 1)

    split(0, 0, *size, 5)
    return picture


def poster(rng: np.random.Generator, size: tuple[int, int], title: str, ground: Colour, ink: Colour) -> Picture:
    """A printed poster: a title, two crossing views of a shape, lines of small type."""
    width, height = size
    picture = grainy(rng, size, ground, cell=120, strength=5)
    scale = 0.86 * width / cv2.getTextSize(title, _FONT, 1.0, 3)[0][0]
    weight = max(int(4 * scale), 2)
    cv2.putText(picture, title, (int(width * 0.07), int(height * 0.17)), _FONT, scale, ink, weight, cv2.LINE_AA)
    middle = np.array([width * 0.5, height * 0.46])
    for index in range(26):
        angles = np.linspace(0, 2 * np.pi, 6, endpoint=False) + index * 0.09
        ring = middle + width * (0.4 - 0.015 * index) * np.stack([np.cos(angles), 0.7 * np.sin(angles)], axis=1)
        tone = (np.array(ink) * (1 - index / 40) + np.array((230, 190, 90)) * index / 40).tolist()
        cv2.polylines(picture, [ring.astype(np.int32)], True, tone, 3, cv2.LINE_AA)
    for row in range(9):
        words = " ".join(rng.choice(_WORDS, 4)).lower()
        spot = (int(width * 0.08), int(height * (0.77 + 0.024 * row)))
        cv2.putText(picture, words, spot, _FONT, width / 1100, ink, 1, cv2.LINE_AA)
    return picture


def darkened_border(picture: Picture, reach: float, strength: float = 0.4) -> Picture:
    """`picture` darker towards its border: the dim corners of a room. reach: texels."""
    height, width = picture.shape[:2]
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    across, along = (np.minimum(axis, axis[-1] - axis) for axis in (x, y))
    factor = (1 - strength * np.exp(-across / reach))[None] * (1 - strength * np.exp(-along / reach))[:, None]
    return (picture * factor[..., None]).astype(np.uint8)


def rosettes(size: tuple[int, int], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Heights in [0, 1] of a carved panel: a sun with rays, leaves and bosses, falling to 0 at the border."""
    width, height = size
    heights = np.zeros((height, width), np.float32)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))

    def raise_to(bump: np.ndarray) -> None:
        np.maximum(heights, bump, out=heights)

    middle = np.array([width / 2, height / 2])
    dx, dy = x - middle[0], y - middle[1]
    radius, angle = np.hypot(dx, dy) / (0.5 * height), np.arctan2(dy, dx)
    raise_to(np.sqrt(np.clip(1 - (radius / 0.34) ** 2, 0, 1)))
    petals = np.clip(1 - ((radius - 0.58) / 0.24) ** 2, 0, 1) * (0.5 + 0.5 * np.cos(12 * angle))
    raise_to(0.75 * petals.astype(np.float32))
    raise_to(0.55 * np.exp(-(((radius - 0.9) / 0.035) ** 2)))
    for _ in range(46):
        spot = np.array([rng.uniform(0.06, 0.94) * width, rng.uniform(0.08, 0.92) * height])
        if np.hypot(*(spot - middle)) < 0.52 * height:
            continue
        turn, long, wide = rng.uniform(0, np.pi), rng.uniform(0.07, 0.15) * height, rng.uniform(0.03, 0.07) * height
        u = (x - spot[0]) * np.cos(turn) + (y - spot[1]) * np.sin(turn)
        v = -(x - spot[0]) * np.sin(turn) + (y - spot[1]) * np.cos(turn)
        raise_to(rng.uniform(0.4, 0.9) * np.sqrt(np.clip(1 - (u / long) ** 2 - (v / wide) ** 2, 0, 1)))
    border = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y)) / height
    raise_to(0.7 * np.exp(-(((border - 0.035) / 0.018) ** 2)))
    smooth = cv2.GaussianBlur(heights, (0, 0), height / 250)
    return (smooth * np.clip(border / 0.012, 0, 1)).astype(np.float32)
