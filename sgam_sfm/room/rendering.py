"""Cast rays through the room: pictures with texture, light and soft shadow, exact depth and labels.

Pixels are (x, y) with corner origin; depth is along the camera's z axis; metres.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, Int32, UInt8

from sgam_core.types import Box
from sgam_sfm.room.furniture import furnished_room
from sgam_sfm.room.shapes import Shape, lookup, transform

_SAMPLES = 2  # colour samples along each side of a pixel
_BAND = 2**16  # rays cast at a time: what fits the processor's cache
_NOISE = 1.5  # grey levels, standard deviation


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class View:
    """A pinhole camera in the room. camera_matrix: corner origin. light: a key of `LIGHTS`."""

    name: str
    camera_matrix: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "3 4"]
    width: int
    height: int
    light: str

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """The camera's position in the room."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]

    def rays(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """World directions (N, 3) through pixels, so long that centre + depth * ray is what the pixel shows."""
        inverse = self.cam_from_world[:, :3].T @ np.linalg.inv(self.camera_matrix)
        homogeneous = np.column_stack([points, np.ones(len(points))])
        return transform(homogeneous, inverse)

    def project(
        self, points_in_world: Float[np.ndarray, "N 3"]
    ) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, " N"]]:
        """Pixels (N, 2) and depths (N,) of world points; the pixels mean nothing where the depth is not positive."""
        points_in_camera = transform(points_in_world, self.cam_from_world[:, :3]) + self.cam_from_world[:, 3]
        depth = points_in_camera[:, 2]
        safe = np.where(depth > 0, depth, 1.0)
        return transform(points_in_camera / safe[:, None], self.camera_matrix)[:, :2], depth


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Rendering:
    """What a view shows: pixels RGB; depth in metres and labels at the pixels' centres."""

    pixels: UInt8[np.ndarray, "H W 3"]
    depth: Float[np.ndarray, "H W"]
    labels: Int32[np.ndarray, "H W"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Light:
    """A lamp that casts shadows around `towards`, and light from all sides; both linear RGB."""

    position: Float[np.ndarray, "3"]
    towards: Float[np.ndarray, "3"]
    lamp: Float[np.ndarray, "3"]
    ambient: Float[np.ndarray, "3"]


LIGHTS = {
    "day": Light(
        position=np.array([0.35, 3.2, 1.9]),
        towards=np.array([3.8, 3.6, 0.6]),
        lamp=np.array([1.0, 1.0, 0.95]),
        ambient=np.array([0.5, 0.52, 0.56]),
    ),
    "evening": Light(
        position=np.array([3.6, 3.7, 1.93]),
        towards=np.array([3.6, 3.71, 0.0]),
        lamp=np.array([1.1, 0.88, 0.62]),
        ambient=np.array([0.33, 0.27, 0.22]),
    ),
}


def render(view: View) -> Rendering:
    """Render one view of the room; the same view gives the same values on every call."""
    shapes = furnished_room()
    labels_of_shapes = np.array([shape.label for shape in shapes], np.int32)
    depth, labels = np.empty((view.height, view.width)), np.empty((view.height, view.width), np.int32)
    for rows, hits in _bands(view, shapes, np.float64):
        depth[rows], labels[rows] = hits.depth, labels_of_shapes[hits.shape]
    fine = _times(view, _SAMPLES)
    colours = np.empty((view.height, view.width, 3), np.float32)
    for rows, hits in _bands(fine, shapes, np.float32):
        size = (view.width, hits.depth.shape[0] // _SAMPLES)
        shaded = _shade(fine, shapes, hits).reshape(*hits.depth.shape, 3)
        colours[rows.start // _SAMPLES : rows.stop // _SAMPLES] = cv2.resize(shaded, size, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(zlib.crc32(view.name.encode())).standard_normal(colours.shape, np.float32)
    levels = 255 * np.sqrt(_soft_clip(colours)) + np.float32(_NOISE) * noise
    return Rendering(pixels=np.clip(np.rint(levels), 0, 255).astype(np.uint8), depth=depth, labels=labels)


def _times(view: View, factor: int) -> View:
    """The same camera with `factor` times as many pixels along each side."""
    matrix = np.diag([factor, factor, 1.0]) @ view.camera_matrix
    return replace(view, camera_matrix=matrix, width=view.width * factor, height=view.height * factor)


def _soft_clip(linear: np.ndarray) -> np.ndarray:
    """Linear light to [0, 1): highlights are compressed as film does, instead of being cut."""
    knee = np.float32(0.7)
    return np.where(linear < knee, linear, 1 - (1 - knee) ** 2 / (np.maximum(linear, knee) + 1 - 2 * knee))


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """The first hits of a band of rays: their directions, depth and number of the shape."""

    directions: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    shape: Int32[np.ndarray, "h w"]


def _bands(view: View, shapes: Sequence[Shape], dtype: type[np.floating]) -> Iterator[tuple[slice, _Hits]]:
    """Cast the rays of a view, a band of rows after the other; a shape is tried only inside its window on screen."""
    windows = _windows(view, shapes)
    columns = np.arange(view.width) + 0.5
    height = max(_BAND // view.width // _SAMPLES, 1) * _SAMPLES
    for top in range(0, view.height, height):
        bottom = min(top + height, view.height)
        points = np.stack(np.meshgrid(columns, np.arange(top, bottom) + 0.5), axis=-1).reshape(-1, 2)
        directions = view.rays(points).astype(dtype).reshape(bottom - top, view.width, 3)
        depth = np.full(directions.shape[:2], np.inf, dtype)
        nearest = np.full(directions.shape[:2], -1, np.int32)
        for number in np.flatnonzero((windows[:, 1] < bottom) & (windows[:, 3] > top)).tolist():
            left, upper, right, lower = windows[number]
            part = slice(max(upper - top, 0), lower - top), slice(left, right)
            t = shapes[number].hit(view.centre, directions[part].reshape(-1, 3)).reshape(depth[part].shape)
            closer = t < depth[part]
            depth[part][closer] = t[closer]
            nearest[part][closer] = number
        yield slice(top, bottom), _Hits(directions, depth, nearest)


def _windows(view: View, shapes: Sequence[Shape]) -> Int32[np.ndarray, "S 4"]:
    """The pixels [x0, x1) x [y0, y1) that each shape may cover, as rows x0, y0, x1, y1; x0 = x1 when there are none."""
    points, depth = view.project(np.concatenate([shape.corners() for shape in shapes]))
    points, depth = points.reshape(-1, 8, 2), depth.reshape(-1, 8)
    size = np.array([view.width, view.height])
    low = np.clip(np.floor(points.min(axis=1)), 0, size)
    high = np.clip(np.ceil(points.max(axis=1)), 0, size)
    around = np.any(depth < 0.05, axis=1)  # reaches behind the camera: its corners do not bound it on screen
    low[around], high[around] = 0, size
    nothing = np.all(depth <= 0, axis=1) | np.any(low >= high, axis=1)
    low[nothing] = high[nothing] = 0
    return np.concatenate([low, high], axis=1).astype(np.int32)


def _shade(view: View, shapes: Sequence[Shape], hits: _Hits) -> Float[np.ndarray, "N 3"]:
    """Linear RGB (N, 3) of all hits: texture, times a Lambert lamp with soft shadow and the light from all around."""
    light = LIGHTS[view.light]
    directions, depth, numbers = hits.directions.reshape(-1, 3), hits.depth.ravel(), hits.shape.ravel()
    points = view.centre.astype(np.float32) + depth[:, None] * directions
    to_lamp = light.position.astype(np.float32) - points
    distance = np.sqrt(np.einsum("ni,ni->n", to_lamp, to_lamp))
    lamp = _visibility(view.light, points) / (distance * (0.6 + 0.16 * distance * distance))
    colours = np.empty((len(points), 3), np.float32)
    order = np.argsort(numbers, kind="stable")
    starts = np.flatnonzero(np.diff(numbers[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        shape = shapes[numbers[rows[0]]]
        uv, normals = shape.surface(points[rows])
        normals = np.broadcast_to(normals.astype(np.float32), (len(rows), 3))
        facing = np.einsum("ni,ni->n", normals, directions[rows])
        oblique = np.abs(facing) / np.linalg.norm(directions[rows], axis=1)
        footprint = depth[rows] / view.camera_matrix[0, 0] / np.sqrt(np.maximum(oblique, 0.05))
        albedo = shape.texture.sample(uv.astype(np.float32), footprint.astype(np.float32))
        if shape.texture.glow:
            colours[rows] = albedo * np.float32(shape.texture.glow)
            continue
        normals = np.where(facing[:, None] > 0, -normals, normals)  # towards the camera
        cosine = np.maximum(np.einsum("ni,ni->n", normals, to_lamp[rows]), 0)
        above = 0.85 + 0.15 * normals[:, 2]
        colours[rows] = albedo * (
            (cosine * lamp[rows])[:, None] * light.lamp.astype(np.float32)
            + above[:, None] * light.ambient.astype(np.float32)
        )
    return colours


@cache
def _shadow_map(light_name: str) -> tuple[View, Float[np.ndarray, "h w 2"]]:
    """What a lamp sees: a wide view from it, with blurred distances and squared distances."""
    light, size = LIGHTS[light_name], 720
    focal = size / 2 / np.tan(np.radians(70))
    matrix = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    pose = looking(light.position, light.towards)
    view = View(name="lamp", camera_matrix=matrix, cam_from_world=pose, width=size, height=size, light=light_name)
    shapes = [shape for shape in furnished_room() if not shape.texture.glow]
    distances = np.concatenate(
        [hits.depth * np.linalg.norm(hits.directions, axis=2) for _, hits in _bands(view, shapes, np.float32)]
    )
    return view, cv2.GaussianBlur(np.stack([distances, distances**2], axis=2), (0, 0), 2.0)


def _visibility(light_name: str, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Share of the lamp's light that reaches each point, 1 outside the part of the room that its shadow map covers.

    Source: Donnelly & Lauritzen, Variance shadow maps, 2006.
    """
    lamp, moments = _shadow_map(light_name)
    pixels, depth = lamp.project(points)
    mean, square = lookup(moments, pixels).T
    distance = np.linalg.norm(points - lamp.centre.astype(np.float32), axis=1) - 0.03  # a surface does not shade itself
    beyond = np.maximum(distance - mean, 0)
    variance = np.maximum(square - mean**2, 1e-4)
    lit = variance / (variance + beyond**2)
    lit = np.clip((lit - 0.25) / 0.75, 0, 1)  # less light leaks where shadows overlap
    covered = (depth > 0) & Box(x0=2, y0=2, x1=lamp.width - 2, y1=lamp.height - 2).contains(pixels)
    return np.where((beyond > 0) & covered, lit, 1.0).astype(np.float32)


def looking(position: np.ndarray, target: np.ndarray) -> Float[np.ndarray, "3 4"]:
    """Pose of an upright camera at `position` that looks at `target`."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.column_stack([rotation, -rotation @ position])
