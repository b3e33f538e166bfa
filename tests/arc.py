"""300 points seen from places on an arc: a collection without pixels, with a point matcher that knows the truth.

Quick where what comes after matching is tested: nothing is rendered, no model is run.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image

from sgam_core import Crop, Matches
from sgam_sfm.room.rendering import View
from sgam_sfm.scene import write_ground_truth

WIDTH, HEIGHT, FOCAL, CX, CY = 640, 480, 520.0, 331.0, 229.5  # corner origin
CAMERA = f"PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {CX} {CY}"
POINTS = np.random.default_rng(0).uniform((-2, -1.5, 5), (2, 1.5, 8), (300, 3))


def view(name: str, angle_deg: float) -> View:
    """A camera at an angle on the arc, which looks at its middle."""
    angle = np.radians(angle_deg)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    translation = np.array([0, 0.3 * angle, 6.5]) - rotation @ (0, 0, 6.5)
    return View(
        name=name,
        camera_matrix=np.array([[FOCAL, 0, CX], [0, FOCAL, CY], [0, 0, 1]]),
        cam_from_world=np.column_stack([rotation, translation]),
        width=WIDTH,
        height=HEIGHT,
        light="day",
    )


ARC = {
    name: view(name, angle) for name, angle in zip(map("{}.png".format, "abcdef"), np.linspace(-25, 25, 6), strict=True)
}


@dataclass(frozen=True)
class ArcMatcher:
    """Finds the points that both crops show, with new noise in every pair, and some outliers."""

    views: dict[str, View]
    noise_px: float = 0.1
    outliers: int = 30

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        return [self._match(*pair) for pair in pairs]

    def _match(self, crop0: Crop, crop1: Crop) -> Matches:
        rng = np.random.default_rng(zlib.crc32(repr((crop0.key, crop1.key)).encode()))
        shown = [self.views[crop.image.name].project(POINTS)[0] for crop in (crop0, crop1)]
        seen = crop0.window.contains(shown[0]) & crop1.window.contains(shown[1])
        found = []
        for crop, points in zip((crop0, crop1), shown, strict=True):
            affine = crop.crop_from_image
            inside = points[seen] @ affine[:, :2].T + affine[:, 2]
            wrong = rng.uniform((0, 0), crop.size, (self.outliers, 2))
            found.append(np.concatenate([inside + rng.normal(0, self.noise_px, inside.shape), wrong]))
        kept = np.all(
            [(p > 0).all(axis=1) & (p < c.size).all(axis=1) for p, c in zip(found, (crop0, crop1), strict=True)], axis=0
        )
        return Matches(points0=found[0][kept], points1=found[1][kept], scores=rng.uniform(0.3, 1, kept.sum()))


def write_arc(folder: Path, views: dict[str, View] = ARC) -> Path:
    """A user's folder: images/ without content, cameras.txt, truth/ (a COLMAP model without points). Returns: it."""
    (folder / "truth").mkdir(parents=True)
    for name in views:
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / name)
    (folder / "cameras.txt").write_text(f"* {CAMERA}\n")
    write_ground_truth(folder / "truth", list(views.values()))
    return folder
