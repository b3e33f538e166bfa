"""The pair list of SuperGlue and LoFTR: `image0 image1 rot0 rot1 K0(9) K1(9) T_0to1(16)`, 38 fields a line.

K belongs to the image as it is stored, before the quarter turns rot0 and rot1 that SuperGlue applies: this project does
not turn images, so they are checked and not used. T is cam1_from_cam0. K: whole numbers are pixel centres (0.5 is
added), as for ScanNet's own, which the ScanNet list repeats, and for OANet's (width - 1) / 2, where YFCC's comes from.
Poses are known of the pairs only. Image names are relative to `images`, by default the folder of the list.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.reading import camera_matrix, floats, image_size, rigid, text_lines
from sgam_sfm.evaluation.ground_truth.types import Format, GroundTruth, TrueView, Unit
from sgam_sfm.pairs import Pair

_FIELDS = 38
_EXPECTED = "image0 image1 rot0 rot1 K0 (9 numbers) K1 (9) T_0to1 (16)"


def _detects(path: Path) -> bool:
    if not path.is_file() or path.suffix != ".txt":
        return False
    with path.open(encoding="utf-8", errors="replace") as file:
        return len(file.readline(10_000).split()) == _FIELDS


def read_pair_list(path: Path, images: Path, unit: Unit = "unknown") -> GroundTruth:
    """The list, with the sizes of its images; raises InputError for a wrong line or a missing image."""
    views: dict[str, TrueView] = {}
    relative: dict[Pair, np.ndarray] = {}
    for number, line in text_lines(path):
        if not line or line.startswith("#"):
            continue
        where, tokens = f"{path}, line {number}", line.split()
        if len(tokens) != _FIELDS:
            raise InputError(f"{where}: {len(tokens)} fields; expected {_FIELDS}: {_EXPECTED}")
        if not {*tokens[2:4]} <= {"0", "1", "2", "3"}:
            raise InputError(f"{where}: rotations {tokens[2]} and {tokens[3]}; expected 0, 1, 2 or 3 quarter turns")
        values = floats(tokens[4:], where, _EXPECTED)
        for name, K in zip(tokens[:2], (values[:9], values[9:18]), strict=True):
            view = _view(name, camera_matrix(K, where, origin=0.5), images, where, views.get(name))
            if view is not views.setdefault(name, view):
                raise InputError(f"{where}: another K for '{name}' than on a line before; expected one camera an image")
        relative[tokens[0], tokens[1]] = rigid(values[18:], where)
    return GroundTruth(
        source=path, format="pair-list", views=views, pairs=tuple(relative), relative_poses=relative, unit=unit
    )


def _view(name: str, K: np.ndarray, images: Path, where: str, known: TrueView | None) -> TrueView:
    if known is not None and np.allclose(known.camera_matrix, K):
        return known
    width, height = image_size(images / name, where)
    return TrueView(name=name, width=width, height=height, camera_matrix=K, cam_from_world=None)


FORMAT = Format(
    name="pair-list",
    expects=f"a .txt file of SuperGlue's format, {_EXPECTED}",
    detects=_detects,
    read=lambda path, images: read_pair_list(path, images or path.parent),
)
