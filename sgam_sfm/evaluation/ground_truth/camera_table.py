"""A CSV file with a header and a line an image: `name,width,height,fx,fy,cx,cy,qw,qx,qy,qz,tx,ty,tz`.

name: relative to the image folder, in double quotes where it holds a comma. fx, fy, cx, cy: pixels of the image as it
is, corner origin (the centre of the first pixel is 0.5, 0.5), lens distortion removed. qw..tz: rotation, as a unit
quaternion, and translation from world to camera (x right, y down, z forward), as in COLMAP's images.txt. The unit is
taken as unknown.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.reading import camera_matrix, floats, rigid, text_lines
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView
from sgam_sfm.files import replacing

HEADER = "name,width,height,fx,fy,cx,cy,qw,qx,qy,qz,tx,ty,tz"


def write_camera_table(path: Path, views: Iterable[TrueView]) -> None:
    """Write views with a pose so that they are read back."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(HEADER.split(","))
    for view in views:
        assert view.cam_from_world is not None
        x, y, z, w = Rotation.from_matrix(view.cam_from_world[:, :3]).as_quat()
        K, t = view.camera_matrix, view.cam_from_world[:, 3]
        numbers = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], w, x, y, z, *t)
        rows.writerow([view.name, view.width, view.height, *(f"{value:.17g}" for value in numbers)])
    with replacing(path) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8")


def _read(path: Path, images: Path | None) -> GroundTruth:
    rows = csv.reader(io.StringIO("\n".join(line for _, line in text_lines(path))))
    views: dict[str, TrueView] = {}
    for row in rows:
        where = f"{path}, line {rows.line_num}"
        if rows.line_num == 1:
            if [field.strip() for field in row] != HEADER.split(","):
                raise InputError(f"{where}: the header is '{','.join(row)}'; expected '{HEADER}'")
        elif row:
            view = _view(row, where)
            if view.name in views:
                raise InputError(f"{where}: '{view.name}' has a line already; expected one an image")
            views[view.name] = view
    return GroundTruth(source=path, format="csv", views=views)


def _view(row: list[str], where: str) -> TrueView:
    if len(row) != 14:
        raise InputError(f"{where}: {len(row)} fields; expected 14: {HEADER}")
    values = floats(row[1:], where, HEADER)
    (width, height, fx, fy, cx, cy), q, t = values[:6], values[6:10], values[10:]
    if width < 1 or height < 1 or width % 1 or height % 1:
        raise InputError(f"{where}: the image is {width:g}x{height:g}; expected whole pixels")
    if abs(np.linalg.norm(q) - 1) > 1e-3:
        raise InputError(f"{where}: the quaternion has length {np.linalg.norm(q):.4g}; expected 1")
    R = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    return TrueView(
        name=row[0],
        width=int(width),
        height=int(height),
        camera_matrix=camera_matrix(np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]), where),
        cam_from_world=rigid(np.column_stack([R, t]), where),
    )


FORMAT = Format(
    name="csv",
    expects=f"a .csv file with the header {HEADER}",
    detects=lambda path: path.is_file() and path.suffix.lower() == ".csv",
    read=_read,
)
