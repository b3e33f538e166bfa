"""The demo collection, and the truth of the tests: a rendered room with exact poses, depth and labels.

Pixels are (x, y) with corner origin; depth is along the camera's z axis; metres.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.ExifTags
import PIL.Image
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from sgam_core.errors import OptionError
from sgam_core.types import Box
from sgam_sfm.room import furnished_room
from sgam_sfm.room.furniture import LABELS
from sgam_sfm.room.rendering import Rendering, View, looking, render
from sgam_sfm.room.shapes import lookup
from sgam_sfm.threads import in_order, num_cores

__all__ = ["Rendering", "View", "correspond", "demo_views", "depth_at", "overlap", "render", "write_scene"]

_FOCAL_35MM = 28  # of every camera, as its EXIF says; a sensor is 36 mm wide


def demo_views(width: int = 1280, count: int = 14) -> tuple[View, ...]:
    """Cameras of the demo: an arc through the room, then four close-ups; every third one in the evening.

    Args: width of the images in pixels (4:3); count of views, at least 8.
    Raises: OptionError when there are too few views for both parts.
    """
    if count < 8:
        raise OptionError(f"demo with {count} views; expected at least 8: four along the arc and four close-ups")
    close_ups = (
        ((4.35, 4.25, 1.75), (4.6, 6.0, 1.5)),  # relief
        ((2.5, 3.95, 1.55), (2.95, 6.0, 1.25)),  # bookcase
        ((1.1, 3.75, 1.6), (1.35, 6.0, 1.5)),  # painting
        ((3.75, 1.9, 1.65), (3.6, 3.75, 0.8)),  # table
    )
    arc = []
    for s in np.linspace(0, 1, count - len(close_ups)):
        sideways = np.sin(np.pi * s)
        position = (1.15 + 4.7 * s, 1.5 - sideways, 1.5 + 0.2 * np.sin(3 * np.pi * s))
        arc.append((position, (4.3 - 1.6 * s, 5.0, 1.15)))
    return tuple(
        _view(f"view{index:02d}.jpg", position, target, width, "evening" if index % 3 == 2 else "day")
        for index, (position, target) in enumerate([*arc, *close_ups])
    )


def _view(name: str, position: Sequence[float], target: Sequence[float], width: int, light: str) -> View:
    height = width * 3 // 4
    focal = width * _FOCAL_35MM / 36
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    pose = looking(np.array(position), np.array(target))
    return View(name=name, camera_matrix=matrix, cam_from_world=pose, width=width, height=height, light=light)


# --- exact truth -----------------------------------------------------------------------------------------------------


def correspond(
    points0: Float[np.ndarray, "N 2"], view0: View, view1: View
) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, " N"]]:
    """Where points of view 0 are in view 1, by casting rays at the points themselves, so exact at any fraction.

    Args: points0 (N, 2) pixels inside view 0.
    Returns: points1 (N, 2) pixels; visible (N,), True where view 1 sees the same point of the room.
    """
    points_in_world = view0.centre + depth_at(points0, view0)[:, None] * view0.rays(points0)
    points1, depth1 = view1.project(points_in_world)
    visible = (depth1 > 0) & _frame(view1).contains(points1)
    visible[visible] = _agree(depth_at(points1[visible], view1), depth1[visible])
    return points1, visible


def depth_at(points: Float[np.ndarray, "N 2"], view: View) -> Float[np.ndarray, " N"]:
    """Depth (N,) in metres of what a view shows at pixels (N, 2), by casting a ray for each."""
    directions = view.rays(points)
    depth = np.full(len(points), np.inf)
    for shape in furnished_room():
        depth = np.minimum(depth, shape.hit(view.centre, directions))
    return depth


def overlap(
    view0: View, rendering0: Rendering, box0: Box, view1: View, rendering1: Rendering, box1: Box, stride: int = 1
) -> float:
    """Area overlap ratio: share of the points of box 0 that box 1 shows, seen and not hidden; one way.

    Args: stride: every stride-th pixel of box 0 along x and y is a point.
    Returns: a share in [0, 1]; 0 when box 0 has no pixel inside its image.
    Source: paper, Sec. IV-B (AOR).
    """
    columns = np.arange(max(round(box0.x0), 0), min(round(box0.x1), view0.width), stride)
    rows = np.arange(max(round(box0.y0), 0), min(round(box0.y1), view0.height), stride)
    if not (len(columns) and len(rows)):
        return 0.0
    x, y = (axis.ravel() for axis in np.meshgrid(columns, rows))
    rays = view0.rays(np.stack([x, y], axis=1) + 0.5)
    points1, depth1 = view1.project(view0.centre + rendering0.depth[y, x][:, None] * rays)
    inside = (depth1 > 0) & box1.contains(points1) & _frame(view1).contains(points1)
    expected, there = depth1[inside], points1[inside]
    x1, y1 = there.astype(int).T
    # Inverse depth is linear on a plane, so interpolating it is right on surfaces, and the pixel itself at their rims.
    between = 1 / lookup(1 / rendering1.depth, there)
    seen = (np.abs(between - expected) < 0.01 * expected) | (
        np.abs(rendering1.depth[y1, x1] - expected) < 0.01 * expected
    )
    return float(np.count_nonzero(seen) / len(x))


def _agree(seen: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.abs(seen - expected) < 1e-3 * expected


def _frame(view: View) -> Box:
    return Box(x0=0, y0=0, x1=view.width, y1=view.height)


# --- files -----------------------------------------------------------------------------------------------------------


def write_scene(
    folder: Path,
    views: Sequence[View],
    min_overlap: float = 0.4,
    advance: Callable[[View], None] = lambda view: None,
) -> None:
    """Render views into a folder: images/, labels/ (maps and labels.json), ground_truth/ (a COLMAP model), pairs.txt.

    Args: pairs.txt holds the pairs whose images share at least `min_overlap` of what they show (mean of both ways).
        advance(view) is called as soon as a view is written. pairs.txt comes last: with it the folder is complete.
    """
    for name in ("images", "labels", "ground_truth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    shown = []
    for view, rendering in zip(views, in_order(render, views, min(num_cores(), 4)), strict=True):
        _write_view(folder, view, rendering)
        shown.append((view, rendering))
        advance(view)
    write_label_names(folder / "labels")
    write_ground_truth(folder / "ground_truth", views)
    pairs = [
        f"{first[0].name} {second[0].name}\n"
        for first, second in combinations(shown, 2)
        if _mutual_overlap(first, second) >= min_overlap
    ]
    (folder / "pairs.txt").write_text("".join(pairs))


def _write_view(folder: Path, view: View, rendering: Rendering) -> None:
    exif = PIL.Image.Exif()
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = _FOCAL_35MM
    picture = PIL.Image.fromarray(rendering.pixels)
    picture.save(folder / "images" / view.name, quality=95, subsampling=0, exif=exif)
    PIL.Image.fromarray(rendering.labels.astype(np.uint8)).save(folder / "labels" / f"{view.name}.png")


def write_label_names(folder: Path) -> None:
    """What the ids of the room's label maps mean, as `sgam_sfm.label_set` reads it."""
    labels = [{"id": label, "name": name} for name, label in LABELS.items()]
    (folder / "labels.json").write_text(json.dumps({"labels": labels}, indent=2) + "\n")


def _mutual_overlap(first: tuple[View, Rendering], second: tuple[View, Rendering]) -> float:
    (view0, rendering0), (view1, rendering1) = first, second
    stride = max(view0.width // 80, 1)
    forth = overlap(view0, rendering0, _frame(view0), view1, rendering1, _frame(view1), stride)
    back = overlap(view1, rendering1, _frame(view1), view0, rendering0, _frame(view0), stride)
    return (forth + back) / 2


def write_ground_truth(folder: Path, views: Sequence[View]) -> None:
    """The views as a COLMAP text model without points."""
    cameras, images = [], []
    for index, view in enumerate(views, start=1):
        k, (x, y, z, w) = view.camera_matrix, Rotation.from_matrix(view.cam_from_world[:, :3]).as_quat()
        size, t = (view.width, view.height), view.cam_from_world[:, 3]
        cameras.append(_line(index, "PINHOLE", *size, k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        images.append(_line(index, w, x, y, z, *t, index, view.name) + "\n")
    (folder / "cameras.txt").write_text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n" + "".join(cameras))
    (folder / "images.txt").write_text("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n" + "".join(images))
    (folder / "points3D.txt").write_text("# POINT3D_ID X Y Z R G B ERROR TRACK[]\n")


def _line(*values: object) -> str:
    return " ".join(f"{value:.17g}" if isinstance(value, float) else str(value) for value in values) + "\n"
