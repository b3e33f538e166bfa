"""Scenes with ground truth, as options of `sgam-sfm`; the scripts beside this file share them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image


def scene_options(scene: Path) -> list[str]:
    """Photos, true cameras and ground truth of a Strecha or ScanNet scene.

    Args: scene: a folder with images/K.txt and gt_dense_cameras, or with color/, pose/ and intrinsics.
    """
    if not (scene / "gt_dense_cameras").is_dir():
        return ["--images", str(scene / "color"), "--ground-truth", str(scene)]
    K = np.loadtxt(scene / "images" / "K.txt").reshape(3, 3)
    params = ",".join(str(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    camera = ["--camera-model", "PINHOLE", "--camera-params", params, "--camera-mode", "single"]
    return ["--images", str(scene / "images"), "--ground-truth", str(scene / "gt_dense_cameras"), *camera]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class StrechaView:
    """A photo of a Strecha scene.

    pixels: (H, W, 3). K: (3, 3), whole numbers are pixel centres. camera_to_world: (3, 3) rotation. centre: (3,).
    """

    name: str
    pixels: np.ndarray
    K: np.ndarray
    camera_to_world: np.ndarray
    centre: np.ndarray

    def seen(self, pixels: np.ndarray, K: np.ndarray, turn: np.ndarray | None = None) -> StrechaView:
        """The same as another camera in its place sees it. Args: turn: (3, 3), from this camera to the other."""
        turned = self.camera_to_world if turn is None else self.camera_to_world @ turn.T
        return replace(self, pixels=pixels, K=K, camera_to_world=turned)

    def write(self, scene: Path) -> None:
        """Add it to the scene; the last one gives the scene its K.txt."""
        images, cameras = scene / "images", scene / "gt_dense_cameras"
        for folder in (images, cameras):
            folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(self.pixels).save(images / self.name, quality=98)
        height, width = self.pixels.shape[:2]
        rows = [*self.K, np.zeros(3), *self.camera_to_world, self.centre, np.array([width, height])]
        lines = [" ".join(f"{value:.10g}" for value in row) for row in rows]
        (cameras / f"{self.name}.camera").write_text("\n".join(lines) + "\n")
        np.savetxt(images / "K.txt", self.K)


def strecha_views(scene: Path) -> Iterator[StrechaView]:
    """The photos of a scene, by name."""
    for path in sorted((scene / "gt_dense_cameras").glob("*.camera")):
        values = np.loadtxt(path.read_text().split())
        name = path.name.removesuffix(".camera")
        yield StrechaView(
            name=name,
            pixels=np.asarray(Image.open(scene / "images" / name)),
            K=values[:9].reshape(3, 3),
            camera_to_world=values[12:21].reshape(3, 3),
            centre=values[21:24],
        )


def split_options(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments of a script before `--`, and those after it, which it passes on to `sgam-sfm`."""
    at = arguments.index("--") if "--" in arguments else len(arguments)
    return list(arguments[:at]), list(arguments[at + 1 :])
