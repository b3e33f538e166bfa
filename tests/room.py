"""The rendered room, in small, with a point matcher that knows the truth."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image

from sgam_core import Box, Crop, Image, Matches
from sgam_sfm.pairs import write_pairs
from sgam_sfm.scene import Rendering, View, correspond, demo_views, overlap, render, write_label_names

WIDTH = 640


@dataclass(frozen=True)
class Room:
    """Views of the room by name, rendered, and as images of the core."""

    views: dict[str, View]
    renderings: dict[str, Rendering]
    images: dict[str, Image]

    def overlap(self, name0: str, box0: Box, name1: str, box1: Box) -> float:
        """Area overlap ratio, mean of both ways."""
        sides = ((name0, box0), (name1, box1))
        forth, back = (
            overlap(self.views[a], self.renderings[a], box_a, self.views[b], self.renderings[b], box_b, stride=2)
            for (a, box_a), (b, box_b) in (sides, sides[::-1])
        )
        return (forth + back) / 2


def small_room() -> Room:
    """Six views: five neighbours along the arc, and a close-up of the relief."""
    views = {view.name: view for index, view in enumerate(demo_views(WIDTH)) if index in (2, 3, 4, 5, 6, 10)}
    renderings = {name: render(view) for name, view in views.items()}
    images = {
        name: Image(name=name, pixels=renderings[name].pixels, camera_matrix=view.camera_matrix)
        for name, view in views.items()
    }
    return Room(views=views, renderings=renderings, images=images)


@dataclass(frozen=True)
class TrueMatcher:
    """Finds what both crops really show, with noise in the crop's own pixels and a share of random outliers.

    Where the crops share nothing it finds random pairs, as real matchers do on look-alikes. Each pair of crops is
    looked at once.
    """

    room: Room
    points: int = 300
    noise_px: float = 0.3
    outliers: float = 0.1
    known: dict = field(default_factory=dict)

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        for crop0, crop1 in pairs:
            if (crop0.key, crop1.key) not in self.known:
                self.known[crop0.key, crop1.key] = self._match(crop0, crop1)
        return [self.known[crop0.key, crop1.key] for crop0, crop1 in pairs]

    def _match(self, crop0: Crop, crop1: Crop) -> Matches:
        rng = np.random.default_rng(zlib.crc32(repr((crop0.key, crop1.key)).encode()))
        view0, view1 = self.room.views[crop0.image.name], self.room.views[crop1.image.name]
        inside0 = rng.uniform((0, 0), crop0.size, (self.points, 2))
        points1, visible = correspond(crop0.to_image(inside0), view0, view1)
        visible &= crop1.window.contains(points1)
        true0, affine = inside0[visible], crop1.crop_from_image
        true1 = points1[visible] @ affine[:, :2].T + affine[:, 2]
        wrong = max(round(self.outliers * len(true0)), 20)
        random0, random1 = (rng.uniform((0, 0), crop.size, (wrong, 2)) for crop in (crop0, crop1))
        found0 = np.concatenate([true0 + rng.normal(0, self.noise_px, true0.shape), random0])
        found1 = np.concatenate([true1 + rng.normal(0, self.noise_px, true1.shape), random1])
        return Matches(points0=found0, points1=found1, scores=rng.uniform(0.3, 1, len(found0)))


def write_room(room: Room, folder: Path) -> Path:
    """The room as a user's folder: images/, labels/, pairs.txt (all pairs) and cameras.txt. Returns: the folder."""
    for name, image in room.images.items():
        for sub, pixels in (("images", image.pixels), ("labels", room.renderings[name].labels.astype(np.uint8))):
            path = folder / sub / (name if sub == "images" else f"{name}.png")
            path.parent.mkdir(parents=True, exist_ok=True)
            PIL.Image.fromarray(pixels).save(path, quality=95)
    write_label_names(folder / "labels")
    write_pairs(folder / "pairs.txt", combinations(room.images, 2))
    matrix = next(iter(room.views.values())).camera_matrix
    params = " ".join(f"{value:.6f}" for value in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    (folder / "cameras.txt").write_text(f"* PINHOLE {WIDTH} {WIDTH * 3 // 4} {params}\n")
    return folder
