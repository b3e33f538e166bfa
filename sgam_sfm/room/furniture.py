"""What stands in the room, and where: paintings, a relief, bookcases, a table, chairs, vases, columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from types import MappingProxyType

import numpy as np

from sgam_sfm.room import textures
from sgam_sfm.room.shapes import Ellipsoid, Rectangle, Relief, Shape, Texture, box, turned_profile

WIDTH, DEPTH, HEIGHT = 7.0, 6.0, 2.9  # metres: the room is [0, 7] x [0, 6] x [0, 2.9]

_NAMES = (
    *("wall", "floor", "ceiling", "window", "painting", "relief", "shelf", "book"),
    *("table", "chair", "vase", "carpet", "column", "cabinet", "plant", "lamp", "fruit"),
)
LABELS = MappingProxyType({name: index for index, name in enumerate(_NAMES, start=1)})  # 0 stays void

_X, _Y, _Z = np.eye(3)
_OAK, _WALNUT, _WHITE = (176, 128, 80), (104, 68, 44), (226, 222, 212)


def _seeded(number: int) -> np.random.Generator:
    return np.random.default_rng([20240, number])


def _placed(shapes: Iterable[Shape], degrees: float, x: float, y: float, z: float = 0.0) -> list[Shape]:
    """Shapes turned about the z axis, then moved to (x, y, z)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return [shape.moved(rotation, np.array([x, y, z])) for shape in shapes]


def _wooden(number: int, colour: textures.Colour) -> Texture:
    return Texture.of(textures.wood(_seeded(number), (700, 900), colour), 600)


def _painted(number: int, colour: textures.Colour, strength: float = 9) -> Texture:
    return Texture.of(textures.grainy(_seeded(number), (512, 512), colour, strength=strength), 600)


def _shell() -> list[Shape]:
    def whole(picture: textures.Picture, per_metre: float) -> Texture:
        return Texture.of(textures.darkened_border(picture, 0.35 * per_metre), per_metre)

    bricks = textures.bricks(_seeded(1), (2800, 1160), (96, 31), (168, 92, 70))
    back = whole(textures.whitewashed(_seeded(8), bricks, (214, 202, 180), cover=0.45), 400)
    left = whole(textures.plaster(_seeded(2), (2400, 1160), (150, 172, 178), marks=900), 400)
    right = whole(textures.wallpaper(_seeded(3), (2400, 1160), (222, 212, 184), leaves=620), 400)
    front = whole(textures.plaster(_seeded(4), (1400, 580), (206, 196, 180), marks=300), 200)
    floor = whole(textures.planks(_seeded(5), (2450, 2100), 50, (158, 116, 76)), 350)
    ceiling = whole(textures.plaster(_seeded(6), (1400, 1200), (228, 224, 214), marks=700), 200)
    wall = LABELS["wall"]

    def side(label: int, texture: Texture, corner: Sequence[float], right: np.ndarray, down: np.ndarray) -> Rectangle:
        size = (WIDTH if right[0] else DEPTH, HEIGHT if down[2] else DEPTH)
        return Rectangle(label=label, texture=texture, corner=np.array(corner), right=right, down=down, size=size)

    beam = _wooden(7, _WALNUT)
    beams = [b for x in (1.1, 3.5, 5.9) for b in box(LABELS["ceiling"], beam, (x - 0.09, 0, 2.72), (x + 0.09, 6, 2.91))]
    return [
        side(wall, back, (0, DEPTH, HEIGHT), _X, -_Z),
        side(wall, left, (0, 0, HEIGHT), _Y, -_Z),
        side(wall, right, (WIDTH, DEPTH, HEIGHT), -_Y, -_Z),
        side(wall, front, (WIDTH, 0, HEIGHT), -_X, -_Z),
        side(LABELS["floor"], floor, (0, DEPTH, 0), _X, -_Y),
        side(LABELS["ceiling"], ceiling, (0, 0, HEIGHT), _X, _Y),
        *beams,
    ]


def _picture(canvas: textures.Picture, wide: float, tall: float, number: int, rim: textures.Colour) -> list[Shape]:
    """A framed picture that hangs on the plane y = 0 and faces -y, its middle at the origin."""
    per_metre = canvas.shape[1] / wide
    mounted = textures.framed(_seeded(number), canvas, int(0.04 * per_metre), (238, 232, 220))
    label, frame = LABELS["painting"], _painted(number + 1, rim, 16)
    w, h = wide / 2 + 0.04, tall / 2 + 0.04
    front = Texture.of(mounted, mounted.shape[1] / (2 * w))
    rails = (
        ((-w - 0.045, -0.05, -h - 0.045), (w + 0.045, 0, -h)),
        ((-w - 0.045, -0.05, h), (w + 0.045, 0, h + 0.045)),
        ((-w - 0.045, -0.05, -h), (-w, 0, h)),
        ((w, -0.05, -h), (w + 0.045, 0, h)),
    )
    sides = [side for low, high in rails for side in box(label, frame, low, high)]
    return [*sides, *box(label, frame, (-w, -0.025, -h), (w, 0, h), front=front)]


def _paintings() -> list[Shape]:
    gold, black, oak = (170, 132, 66), (52, 46, 44), _OAK
    meadow = _picture(textures.landscape(_seeded(20), (1100, 760)), 1.1, 0.76, 21, gold)
    dusk = _picture(textures.landscape(_seeded(22), (900, 640), dusk=True), 0.9, 0.64, 23, gold)
    discs = _picture(textures.composition(_seeded(24), (800, 960)), 0.75, 0.9, 25, black)
    fields = _picture(textures.blocks(_seeded(26), (760, 760)), 0.7, 0.7, 27, oak)
    sheet = textures.poster(_seeded(28), (700, 960), "EPIPOLAR", (232, 226, 208), (150, 40, 44))
    print_twice = _picture(sheet, 0.62, 0.85, 29, black)  # the same print hangs on two walls
    return [
        *_placed(meadow, 0, 1.35, DEPTH, 1.75),
        *_placed(print_twice, 0, 6.25, DEPTH, 1.6),
        *_placed(dusk, 90, 0, 1.35, 1.6),
        *_placed(print_twice, 90, 0, 5.1, 1.6),
        *_placed(discs, -90, WIDTH, 3.45, 1.6),
        *_placed(fields, -90, WIDTH, 2.2, 1.65),
        *_placed(dusk, -90, WIDTH, 4.95, 1.75),
    ]


def _window() -> list[Shape]:
    """A window in the wall x = 0; the view through it is a picture that shines."""
    label, frame = LABELS["window"], _painted(31, _WHITE, 8)
    outside = textures.landscape(_seeded(30), (1500, 1150))
    pane = Texture.of(outside, 1000, glow=1.0)
    rails = [((-0.8, -0.07, z), (0.8, 0, z + 0.07)) for z in (-0.65, 0.58, 0.12)] + [
        ((x, -0.07, -0.65), (x + 0.07, 0, 0.65)) for x in (-0.8, -0.3, 0.23, 0.73)
    ]
    sill = box(label, frame, (-0.9, -0.2, -0.72), (0.9, 0, -0.65))
    glass = Rectangle(
        label=label, texture=pane, corner=np.array([-0.75, -0.004, 0.6]), right=_X, down=-_Z, size=(1.5, 1.2)
    )
    bars = [side for low, high in rails for side in box(label, frame, low, high)]
    return _placed([*bars, *sill, glass], 90, 0, 3.25, 1.6)


def _relief() -> list[Shape]:
    label = LABELS["relief"]
    stone = textures.marble(_seeded(33), (1040, 800), (214, 204, 184))
    texture = Texture.of(stone, 800)
    corner = np.array([4.0, DEPTH - 0.06, 2.1])
    plate = Rectangle(label=label, texture=texture, corner=corner, right=_X, down=-_Z, size=(1.3, 1.0))
    heights = textures.rosettes((650, 500), _seeded(34)) * np.float32(0.12)
    slab = box(label, texture, (4.0, DEPTH - 0.0599, 1.1), (5.3, DEPTH, 2.1))  # carries the relief, just behind it
    return [Relief(plate=plate, heights=heights), *slab]


def _bookcase(seed: int, wide: float, tall: float, boards: int) -> list[Shape]:
    """A bookcase with its back on the plane y = 0, open towards -y, its middle at x = 0."""
    rng, shelf, wood = _seeded(seed), LABELS["shelf"], _wooden(41, _OAK)
    deep, thick = 0.32, 0.03
    parts: list[Shape] = [
        *box(shelf, wood, (-wide / 2, -deep, 0), (-wide / 2 + thick, 0, tall)),
        *box(shelf, wood, (wide / 2 - thick, -deep, 0), (wide / 2, 0, tall)),
        *box(shelf, wood, (-wide / 2, -0.02, 0), (wide / 2, 0, tall)),
    ]
    levels = np.linspace(0.06, tall - thick, boards)
    for level in levels:
        parts += box(shelf, wood, (-wide / 2, -deep, level), (wide / 2, 0, level + thick))
    for row, level in enumerate(levels[:-1]):
        room = levels[row + 1] - level - thick
        x, stop = -wide / 2 + thick + 0.01, wide / 2 - thick - 0.05
        gap = rng.uniform(-0.3, 0.2) * wide  # where the row of books is broken
        while x < stop:
            thickness, height = rng.uniform(0.025, 0.06), room * rng.uniform(0.66, 0.93)
            if gap < x < gap + 0.14:
                x = gap + 0.14
            parts += _book(rng, x, float(level) + thick, min(thickness, stop + 0.045 - x), height)
            x += thickness + 0.003
    return parts


_BINDINGS: tuple[textures.Colour, ...] = (
    *((150, 44, 40), (38, 70, 120), (44, 96, 72), (204, 160, 70), (92, 52, 98), (222, 210, 184)),
    *((60, 58, 64), (184, 96, 52), (110, 146, 160)),
)


def _book(rng: np.random.Generator, x: float, z: float, thickness: float, height: float) -> list[Shape]:
    colour = _BINDINGS[rng.integers(len(_BINDINGS))]
    texels = (max(int(thickness * 1100), 12), max(int(height * 1100), 12))
    back = Texture.of(textures.spine(rng, texels, colour), 1100)
    cover = Texture.of(textures.grainy(rng, (64, 96), colour, 20), 300)
    y = -rng.uniform(0.2, 0.3)
    return box(LABELS["book"], cover, (x, y, z), (x + thickness, -0.03, z + height), front=back)


def _table() -> list[Shape]:
    label, wood = LABELS["table"], _wooden(45, _WALNUT)
    top = Texture.of(textures.planks(_seeded(46), (1000, 560), 93, (150, 98, 60), long=(900, 2000)), 600)
    legs = [(x, y) for x in (-0.74, 0.66) for y in (-0.41, 0.33)]
    sides = [side for x, y in legs for side in box(label, wood, (x, y, 0), (x + 0.08, y + 0.08, 0.71))]
    return [*sides, *box(label, top, (-0.8, -0.46, 0.71), (0.8, 0.46, 0.755))]


def _chair(cushion: Texture, wood: Texture) -> list[Shape]:
    """A chair that faces -y (its back towards +y), its seat above the origin."""
    label = LABELS["chair"]
    beams = [((x, y, 0.0), (x + 0.04, y + 0.04, 0.44)) for x in (-0.22, 0.18) for y in (-0.22, 0.18)]
    beams += [((x, 0.18, 0.44), (x + 0.04, 0.22, 0.95)) for x in (-0.22, 0.18)]
    beams += [((-0.18, 0.185, z), (0.18, 0.21, z + 0.055)) for z in (0.53, 0.63)]
    sides = [side for low, high in beams for side in box(label, wood, low, high)]
    seat = box(label, cushion, (-0.225, -0.225, 0.43), (0.225, 0.225, 0.49))
    return [*sides, *seat, *box(label, cushion, (-0.18, 0.175, 0.72), (0.18, 0.225, 0.95))]


def _chairs() -> list[Shape]:
    cloth = textures.fabric(_seeded(50), (420, 420), ((70, 104, 112), (196, 164, 104), (150, 84, 66), (214, 206, 186)))
    chair = _chair(Texture.of(cloth, 900), _wooden(51, (136, 92, 56)))
    spots = ((185, 3.15, 2.85), (168, 4.1, 2.9), (-95, 4.85, 3.7), (62, 2.35, 3.75), (35, 0.75, 5.2), (-28, 6.0, 1.9))
    return [side for degrees, x, y in spots for side in _placed(chair, degrees, x, y)]


def _vase(number: int, glaze: textures.Colour, ink: textures.Colour, scale: float) -> list[Shape]:
    lower = ((0, 0.055), (0.03, 0.075), (0.08, 0.105), (0.13, 0.115))
    profile = (*lower, (0.18, 0.1), (0.22, 0.066), (0.26, 0.042), (0.29, 0.04), (0.32, 0.055))
    texture = Texture.of(textures.ceramic(_seeded(number), (820, 420), glaze, ink), 1100)
    scaled = [(height * scale, radius * scale) for height, radius in profile]
    return list(turned_profile(LABELS["vase"], texture, (0, 0, 0), scaled))


def _vases() -> list[Shape]:
    blue = _vase(60, (224, 228, 230), (40, 66, 140), 1.0)  # three of a kind, and one of its own
    rust = _vase(61, (182, 98, 60), (238, 214, 164), 1.35)
    return [
        *_placed(blue, 0, 3.2, 3.85, 0.755),
        *_placed(blue, 120, 4.15, 3.8, 0.755),
        *_placed(blue, 40, 6.78, 4.35, 0.8),
        *_placed(rust, 200, 6.76, 5.5, 0.8),
    ]


def _fruit() -> list[Shape]:
    label = LABELS["fruit"]
    skins = [_painted(64 + i, c, 22) for i, c in enumerate(((196, 60, 44), (226, 150, 44), (120, 160, 60)))]
    spots = ((3.62, 3.62, 0), (3.73, 3.68, 1), (3.64, 3.74, 2), (3.72, 3.57, 0), (3.4, 3.5, 1), (3.93, 3.52, 2))
    return [
        Ellipsoid(
            label=label,
            texture=skins[skin],
            centre=np.array([x, y, 0.755 + 0.046]),
            radii=(0.05, 0.05, 0.046),
            rotation=np.eye(3),
        )
        for x, y, skin in spots
    ]


def _columns() -> list[Shape]:
    label = LABELS["column"]
    profile = (
        (0.12, 0.2),
        (0.17, 0.21),
        (0.22, 0.17),
        (0.27, 0.155),
        (1.4, 0.15),
        (2.5, 0.14),
        (2.6, 0.2),
        (2.9, 0.23),
    )
    parts: list[Shape] = []
    for number, (x, y) in enumerate(((1.75, 3.3), (5.55, 3.15))):
        stone = Texture.of(textures.marble(_seeded(70 + number), (800, 1450), (206, 196, 188)), 500)
        parts += turned_profile(label, stone, (x, y, 0), profile)
        parts += box(label, stone, (x - 0.22, y - 0.22, 0), (x + 0.22, y + 0.22, 0.12))
    return parts


def _cabinet() -> list[Shape]:
    """A low cabinet with its back on the plane y = 0, facing -y."""
    label, wood = LABELS["cabinet"], _wooden(75, (128, 84, 60))
    door = _wooden(76, (188, 146, 98))
    doors = [
        side
        for x in (-0.76, -0.25, 0.26)
        for side in box(label, door, (x, -0.44, 0.1), (x + 0.48, -0.42, 0.74), front=door)
    ]
    return _placed([*box(label, wood, (-0.8, -0.42, 0.05), (0.8, 0, 0.8)), *doors], -90, WIDTH, 4.9)


def _carpet() -> list[Shape]:
    pattern = Texture.of(textures.carpet(_seeded(80), (1500, 1080)), 450)
    low, high = (-1.667, -1.2, 0.0), (1.667, 1.2, 0.012)
    return _placed(box(LABELS["carpet"], pattern, low, high), 4, 3.6, 3.35)


def _plant(number: int, leaves: int) -> list[Shape]:
    """A pot with long leaves that lean outwards."""
    rng, label = _seeded(number), LABELS["plant"]
    clay = _painted(number + 1, (176, 104, 72), 14)
    green = [_painted(number + 2 + i, c, 20) for i, c in enumerate(((62, 112, 52), (96, 142, 66), (44, 88, 60)))]
    parts: list[Shape] = list(turned_profile(label, clay, (0, 0, 0), ((0, 0.13), (0.27, 0.19), (0.31, 0.2))))
    for leaf in range(leaves):
        around, lean = 2.4 * leaf, np.radians(rng.uniform(8, 58))
        long, wide = rng.uniform(0.22, 0.42), rng.uniform(0.045, 0.075)
        along = np.array([np.cos(around) * np.sin(lean), np.sin(around) * np.sin(lean), np.cos(lean)])
        across = np.cross(along, [np.cos(around + 0.5), np.sin(around + 0.5), -0.3])
        across /= np.linalg.norm(across)
        parts.append(
            Ellipsoid(
                label=label,
                texture=green[leaf % 3],
                centre=np.array([0, 0, 0.28]) + along * (long + rng.uniform(0, 0.18)),
                radii=(long, wide, 0.008),
                rotation=np.stack([along, across, np.cross(along, across)], axis=1),
            )
        )
    return parts


def _lamp() -> list[Shape]:
    """A pendant lamp over the table."""
    shade = textures.ceramic(_seeded(90), (900, 300), (240, 214, 160), (176, 84, 48))
    label, cord = LABELS["lamp"], _painted(91, (40, 38, 36))
    glowing = Texture.of(shade, 700, glow=0.85)
    return [
        *turned_profile(label, glowing, (3.6, 3.7, 1.95), ((0, 0.27), (0.1, 0.22), (0.2, 0.13), (0.25, 0.05))),
        *turned_profile(label, cord, (3.6, 3.7, 2.2), ((0, 0.008), (0.7, 0.008))),
    ]


@cache
def furnished_room() -> tuple[Shape, ...]:
    """Every shape of the room; the same values on every call."""
    return (
        *_shell(),
        *_paintings(),
        *_window(),
        *_relief(),
        *_placed(_bookcase(40, 1.15, 2.1, 6), 0, 3.0, DEPTH),
        *_placed(_bookcase(42, 0.75, 1.05, 3), 0, 5.75, DEPTH),
        *_carpet(),
        *_placed(_table(), 0, 3.6, 3.7),
        *_placed(_plant(100, 26), 0, 6.55, 3.1),
        *_placed(_plant(110, 26), 0, 0.45, 2.05),
        *_chairs(),
        *_vases(),
        *_fruit(),
        *_columns(),
        *_cabinet(),
        *_lamp(),
    )
