"""Shapes that a ray can hit, exactly: rectangles, frusta, ellipsoids and a height-field relief, each with a texture.

A ray is origin + t * direction. Texture coordinates are metres on the surface, so texture sticks to the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

_NEAREST = 1e-3  # metres: closer hits are the surface a ray starts on


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Texture:
    """A picture on a surface, with its pyramid. `glow` > 0: it shines by itself, that strong, instead of being lit.

    levels: square-root encoded RGB, each half as large as the one before.
    """

    levels: tuple[UInt8[np.ndarray, "_ _ 3"], ...]
    texels_per_metre: float
    glow: float = 0.0

    @staticmethod
    def of(pixels: UInt8[np.ndarray, "h w 3"], texels_per_metre: float, glow: float = 0.0) -> Texture:
        levels = [pixels]
        while len(levels) < 2 or (len(levels) < 8 and min(levels[-1].shape[:2]) > 8):
            levels.append(cv2.pyrDown(levels[-1], borderType=cv2.BORDER_REFLECT))
        return Texture(levels=tuple(levels), texels_per_metre=texels_per_metre, glow=glow)

    def sample(self, uv: Float[np.ndarray, "N 2"], footprint: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3"]:
        """Linear RGB in [0, 1] at surface points `uv`, averaged over about `footprint`, both in metres."""
        detail = np.log2(np.maximum(footprint * self.texels_per_metre, 1.0))
        detail = np.minimum(detail, len(self.levels) - 1.001)
        lower = detail.astype(np.int8)
        encoded = np.empty((len(uv), 3), np.float32)
        for level in np.unique(lower):
            rows = np.flatnonzero(lower == level)
            texels = uv[rows] * self.texels_per_metre
            fine = lookup(self.levels[level], texels / 2.0**level)
            coarse = lookup(self.levels[level + 1], texels / 2.0 ** (level + 1))
            weight = (detail[rows] - level).astype(np.float32)[:, None]
            encoded[rows] = fine + weight * (coarse - fine.astype(np.float32))
        return np.square(encoded / 255)


def lookup(grid: np.ndarray, points: Float[np.ndarray, "N 2"]) -> np.ndarray:
    """Bilinear values of `grid` at `points` (N, 2), corner origin, mirrored beyond the border: (N, ...)."""
    if not len(points):
        return np.zeros((0, *grid.shape[2:]), grid.dtype)
    width = 1024  # OpenCV's remap wants an image of points, neither side of it above 32767
    rows = -(-len(points) // width)
    maps = np.zeros((2, rows * width), np.float32)
    maps[:, : len(points)] = points.T - 0.5
    x, y = maps.reshape(2, rows, width)
    values = cv2.remap(grid, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return values.reshape(rows * width, *values.shape[2:])[: len(points)]


def transform(points: Float[np.ndarray, "N 3"], matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "N 3"]:
    """matrix @ point for each point (N, 3), in the points' own precision."""
    # OpenCV's loop: a threaded matrix product of three columns costs more in waiting than in work.
    return cv2.transform(points[:, None], matrix)[:, 0] if len(points) else points


@runtime_checkable
class Shape(Protocol):
    """Something that can be seen. `label` is its semantic id."""

    @property
    def label(self) -> int: ...

    @property
    def texture(self) -> Texture: ...

    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Eight points whose convex hull holds the shape."""
        ...

    def hit(self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """The t of the first hit of each ray, infinite where it misses."""
        ...

    def surface(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "... 3"]]:
        """Texture coordinates (N, 2) and unit normals, (N, 3) or one (3,) for all, at points of the surface."""
        ...

    def moved(self, rotation: Float[np.ndarray, "3 3"], offset: Float[np.ndarray, "3"]) -> Shape:
        """This shape after p -> rotation @ p + offset."""
        ...


def _box_corners(low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> np.ndarray:
    pairs = np.stack([low, high])
    return np.array([[pairs[i, 0], pairs[j, 1], pairs[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Rectangle:
    """A flat rectangle: `corner` is its upper left one, `right` and `down` the unit vectors of its sides."""

    label: int
    texture: Texture
    corner: Float[np.ndarray, "3"]
    right: Float[np.ndarray, "3"]
    down: Float[np.ndarray, "3"]
    size: tuple[float, float]

    def corners(self) -> np.ndarray:
        across, along = self.right * self.size[0], self.down * self.size[1]
        four = np.array([self.corner + i * across + j * along for i in (0, 1) for j in (0, 1)])
        return np.concatenate([four, four])

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        axes = np.stack([self.right, self.down, np.cross(self.right, self.down)])
        start = (axes @ (origin - self.corner)).astype(directions.dtype)
        u, v, w = transform(directions, axes).T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -start[2] / w
            u, v = start[0] + t * u, start[1] + t * v
            inside = (t > _NEAREST) & (u >= 0) & (u <= self.size[0]) & (v >= 0) & (v <= self.size[1])
        return np.where(inside, t, np.inf)

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        into = np.cross(self.right, self.down)
        return transform(points - self.corner.astype(points.dtype), np.stack([self.right, self.down, into]))[
            :, :2
        ], into

    def moved(self, rotation: np.ndarray, offset: np.ndarray) -> Rectangle:
        return replace(
            self, corner=rotation @ self.corner + offset, right=rotation @ self.right, down=rotation @ self.down
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Cuboid:
    """A box: `size` along the columns of `axes`, from `corner`."""

    label: int
    texture: Texture
    corner: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size: tuple[float, float, float]

    def corners(self) -> np.ndarray:
        return _box_corners(np.zeros(3), self.size) @ self.axes.T + self.corner

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        enter, leave = _slab(self.axes.T, self.corner, np.array(self.size), origin, directions)
        return np.where(enter < leave, enter, np.inf)

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = transform(points - self.corner.astype(points.dtype), self.axes.T)
        from_faces = np.concatenate([local, self.size - local], axis=1)
        face = np.abs(from_faces).argmin(axis=1)
        across = np.array([1, 0, 0])[face % 3]  # the sides show their height as v, top and bottom their y
        along = np.array([2, 2, 1])[face % 3]
        rows = np.arange(len(points))
        uv = np.stack([local[rows, across], local[rows, along]], axis=1)
        return uv, np.concatenate([-self.axes.T, self.axes.T])[face]

    def moved(self, rotation: np.ndarray, offset: np.ndarray) -> Cuboid:
        return replace(self, corner=rotation @ self.corner + offset, axes=rotation @ self.axes)


def _slab(
    axes: np.ndarray, corner: np.ndarray, size: np.ndarray, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The t at which rays enter and leave a box, whose axes are rows; a ray that misses leaves before it enters."""
    start = (axes @ (origin - corner)).astype(directions.dtype)
    enter, leave = np.full((2, len(directions)), [[_NEAREST], [np.inf]], directions.dtype)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, speed in enumerate(transform(directions, axes).T):
            low, high = -start[axis] / speed, (size[axis].astype(speed.dtype) - start[axis]) / speed
            enter, leave = np.maximum(enter, np.minimum(low, high)), np.minimum(leave, np.maximum(low, high))
    return enter, leave


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Frustum:
    """The open side of an upright truncated cone: radius `radii[0]` at `base`, `radii[1]` `height` metres above.

    slopes: change of radius per metre at both ends, for shading only, so that a stack of frusta looks smooth.
    turn: angle of its texture. origin_height, around: where its texture starts and the radius it is wrapped at, equal
    for all frusta of one stack.
    """

    label: int
    texture: Texture
    base: Float[np.ndarray, "3"]
    radii: tuple[float, float]
    height: float
    slopes: tuple[float, float]
    turn: float = 0.0
    around: float
    origin_height: float = 0.0

    def corners(self) -> np.ndarray:
        r = max(self.radii)
        return _box_corners([-r, -r, 0], [r, r, self.height]) + self.base

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        o = (origin - self.base).astype(directions.dtype)
        slope = (self.radii[1] - self.radii[0]) / self.height
        radius = self.radii[0] + slope * o[2]
        dx, dy, dz = directions.T
        a = dx * dx + dy * dy - (slope * dz) ** 2
        half_b = o[0] * dx + o[1] * dy - slope * radius * dz
        c = o[0] ** 2 + o[1] ** 2 - radius**2
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(half_b * half_b - a * c)
            nearest = np.full(len(directions), np.inf, directions.dtype)
            for t in ((-half_b - root) / a, (-half_b + root) / a):
                z = o[2] + t * dz
                valid = (t > _NEAREST) & (z >= 0) & (z <= self.height)
                nearest = np.where(valid & (t < nearest), t, nearest)
        return nearest

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y, z = (points - self.base.astype(points.dtype)).T
        angle = np.arctan2(y, x)
        share = z / self.height
        slope = self.slopes[0] * (1 - share) + self.slopes[1] * share
        normals = np.stack([np.cos(angle), np.sin(angle), -slope], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        turned = np.mod(angle - self.turn, 2 * np.pi)
        return np.stack([turned * self.around, z + self.origin_height], axis=1), normals

    def moved(self, rotation: np.ndarray, offset: np.ndarray) -> Frustum:
        turn = float(np.arctan2(rotation[1, 0], rotation[0, 0]))  # an upright shape only turns about z
        return replace(self, base=rotation @ self.base + offset, turn=self.turn + turn)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Ellipsoid:
    """An ellipsoid with semi-axes `radii` along the columns of `rotation`."""

    label: int
    texture: Texture
    centre: Float[np.ndarray, "3"]
    radii: tuple[float, float, float]
    rotation: Float[np.ndarray, "3 3"]

    def corners(self) -> np.ndarray:
        radii = np.array(self.radii)
        return _box_corners(-radii, radii) @ self.rotation.T + self.centre

    def hit(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        to_sphere = (self.rotation / self.radii).T
        o = (to_sphere @ (origin - self.centre)).astype(directions.dtype)
        x, y, z = transform(directions, to_sphere).T
        a, half_b, c = x * x + y * y + z * z, o[0] * x + o[1] * y + o[2] * z, o @ o - 1
        with np.errstate(invalid="ignore"):
            t = (-half_b - np.sqrt(half_b * half_b - a * c)) / a
            return np.where(t > _NEAREST, t, np.inf)

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        unit = transform(points - self.centre.astype(points.dtype), (self.rotation / self.radii).T)
        size = max(self.radii)
        longitude, latitude = np.arctan2(unit[:, 1], unit[:, 0]), np.arcsin(np.clip(unit[:, 2], -1, 1))
        normals = transform(unit, self.rotation / self.radii)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return np.stack([(longitude + np.pi) * size, (latitude + np.pi / 2) * size], axis=1), normals

    def moved(self, rotation: np.ndarray, offset: np.ndarray) -> Ellipsoid:
        return replace(self, centre=rotation @ self.centre + offset, rotation=rotation @ self.rotation)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Relief:
    """A carved plate: `heights` (h, w) metres above the rectangle `plate`, on the side that right x down points from.

    A ray is followed in steps through the slab that holds the relief, then bisected; carvings narrower than a step
    could be missed, so heights are smooth.
    """

    plate: Rectangle
    heights: Float[np.ndarray, "h w"]

    @property
    def label(self) -> int:
        return self.plate.label

    @property
    def texture(self) -> Texture:
        return self.plate.texture

    def corners(self) -> np.ndarray:
        flat = self.plate.corners()[:4]
        return np.concatenate([flat, flat + self._outward * self.heights.max()])

    @property
    def _outward(self) -> np.ndarray:
        return -np.cross(self.plate.right, self.plate.down)

    def _height(self, uv: np.ndarray) -> np.ndarray:
        return lookup(self.heights, uv * self._texels)

    @property
    def _texels(self) -> np.ndarray:
        return np.array(self.heights.shape[::-1], np.float32) / np.array(self.plate.size, np.float32)

    def hit(self, origin: np.ndarray, directions: np.ndarray, steps: int = 40, bisections: int = 10) -> np.ndarray:
        axes = np.stack([self.plate.right, self.plate.down, self._outward])
        size = np.array([*self.plate.size, float(self.heights.max())])
        enter, leave = _slab(axes, self.plate.corner, size, origin, directions)
        result = np.full(len(directions), np.inf, directions.dtype)
        rows = np.flatnonzero(enter < leave)
        if not len(rows):
            return result
        start = axes @ (origin - self.plate.corner)
        d, near, far = transform(directions[rows], axes), enter[rows], leave[rows]

        def below(t: np.ndarray, which: np.ndarray | slice = slice(None)) -> np.ndarray:
            p = start + t[:, None] * d[which]
            return p[:, 2] <= self._height(p[:, :2])

        above_t, below_t = near.copy(), np.full(len(rows), np.inf)
        waiting = np.arange(len(rows))
        for step in range(1, steps + 1):
            t = near[waiting] + (far - near)[waiting] * (step / steps)
            under = below(t, waiting)
            below_t[waiting[under]] = t[under]
            above_t[waiting[~under]] = t[~under]
            waiting = waiting[~under]
        found = np.flatnonzero(np.isfinite(below_t))
        above_t, below_t = above_t[found], below_t[found]
        for _ in range(bisections):
            middle = (above_t + below_t) / 2
            under = below(middle, found)
            above_t, below_t = np.where(under, above_t, middle), np.where(under, middle, below_t)
        result[rows[found]] = (above_t + below_t) / 2
        return result

    def surface(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv, _ = self.plate.surface(points)
        step = 0.002  # metres, about a texel of the heights
        slope_u, slope_v = (
            (self._height(uv + shift) - self._height(uv - shift))[:, None] / (2 * step)
            for shift in (np.array([step, 0]), np.array([0, step]))
        )
        normals = self._outward - slope_u * self.plate.right - slope_v * self.plate.down
        return uv, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def moved(self, rotation: np.ndarray, offset: np.ndarray) -> Relief:
        return replace(self, plate=self.plate.moved(rotation, offset))


def box(
    label: int,
    texture: Texture,
    low: Sequence[float],
    high: Sequence[float],
    front: Texture | None = None,
) -> list[Shape]:
    """An upright box from corner `low` to corner `high`; a sheet of `front` covers its side towards -y."""
    corner, size = np.array(low, float), np.array(high, float) - np.array(low, float)
    solid = Cuboid(label=label, texture=texture, corner=corner, axes=np.eye(3), size=tuple(size.tolist()))
    if front is None:
        return [solid]
    x, _, z = np.eye(3)
    upper_left = corner + np.array([0, -0.0005, size[2]])
    return [
        solid,
        Rectangle(label=label, texture=front, corner=upper_left, right=x, down=-z, size=(size[0], size[2])),
    ]


def turned_profile(
    label: int, texture: Texture, base: Sequence[float], profile: Sequence[tuple[float, float]]
) -> list[Frustum]:
    """A turned object (vase, column, lamp) as a stack of frusta; profile: (height, radius) from bottom to top."""
    heights, radii = np.array(profile, float).T
    slopes = np.gradient(radii, heights)
    return [
        Frustum(
            label=label,
            texture=texture,
            base=np.array(base) + np.array([0, 0, heights[i]]),
            radii=(float(radii[i]), float(radii[i + 1])),
            height=float(heights[i + 1] - heights[i]),
            slopes=(float(slopes[i]), float(slopes[i + 1])),
            around=float(radii.max()),
            origin_height=float(heights[i]),
        )
        for i in range(len(heights) - 1)
    ]
