"""Ground truth of a collection: one type, whatever it was read from.

Pixels are (x, y) with corner origin: the centre of the first pixel is (0.5, 0.5), as COLMAP has it. A camera looks
along its +z axis, x to the right, y down; cam_from_world (3, 4) takes points of the world into that frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.reading import DepthFile
from sgam_sfm.evaluation.projection import inverse, relative_pose
from sgam_sfm.pairs import Pair

Unit = Literal["metres", "unknown"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TrueView:
    """An image whose camera is known.

    width, height: of the image that camera_matrix (3, 3, corner origin) belongs to. cam_from_world: None where only
    poses of pairs are known. distortion: OpenCV's coefficients (k1, k2, p1, p2, k3, ...), empty for a pinhole.
    """

    name: str
    width: int
    height: int
    camera_matrix: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "3 4"] | None
    distortion: tuple[float, ...] = ()

    def undistorted(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Pixels (N, 2) of the image as those of a pinhole with the same camera_matrix, which the metrics expect."""
        if not self.distortion or not len(points):
            return points
        K, coefficients = self.camera_matrix, np.array(self.distortion)
        # OpenCV's formulas hold for any pixel origin, as long as points and camera matrix share it.
        straight: np.ndarray = cv2.undistortPoints(np.ascontiguousarray(points)[:, None], K, coefficients, P=K)[:, 0]
        return straight


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class GroundTruth:
    """What is known of a collection.

    source, format: where it came from. views: by image name, POSIX paths. pairs: the list that was published with it,
    None when there is none. relative_poses: cam1_from_cam0 (3, 4) by pair, where a list gives nothing else. unit: of
    translations and depth. depth_files, label_files: by image name.
    """

    source: Path
    format: str
    views: Mapping[str, TrueView]
    pairs: tuple[Pair, ...] | None = None
    relative_poses: Mapping[Pair, np.ndarray] = field(default_factory=dict)
    unit: Unit = "unknown"
    depth_files: Mapping[str, DepthFile] = field(default_factory=dict)
    label_files: Mapping[str, Path] = field(default_factory=dict)

    def relative_pose(self, name0: str, name1: str) -> Float[np.ndarray, "3 4"] | None:
        """cam1_from_cam0 (3, 4); None where it is not known."""
        if (name0, name1) in self.relative_poses:
            return self.relative_poses[name0, name1]
        if (name1, name0) in self.relative_poses:
            return inverse(self.relative_poses[name1, name0])
        poses = [view.cam_from_world for name in (name0, name1) if (view := self.views.get(name)) is not None]
        if len(poses) < 2 or poses[0] is None or poses[1] is None:
            return None
        return relative_pose(poses[0], poses[1])

    def depth(self, name: str) -> Float[np.ndarray, "H W"] | None:
        """Depth along the camera's axis in `unit`, 0 where unknown, at the map's own resolution; None without a map."""
        file = self.depth_files.get(name)
        return None if file is None else file.read()

    def labels(self, name: str) -> Path | None:
        """The label map of an image, None when there is none."""
        return self.label_files.get(name)

    def views_of(self, names: Iterable[str]) -> dict[str, TrueView]:
        """The views of images that have one, by image name; see `match_names`."""
        return {name: self.views[view] for name, view in self.match_names(names).items()}

    def match_names(self, names: Iterable[str]) -> dict[str, str]:
        """The view of each image, by image name; images without a view are left out.

        A name matches its equal, else the one view whose path ends with it or that it ends with: `0.jpg` of a folder
        `color` is `scene0707_00/color/0.jpg` of the whole data set.
        Raises: InputError when several views fit.
        """
        by_file: dict[str, list[str]] = {}
        for view in self.views:
            by_file.setdefault(PurePosixPath(view).name, []).append(view)
        found = {}
        for name in names:
            same_file = by_file.get(PurePosixPath(name).name, [])
            fits = [name] if name in self.views else [view for view in same_file if _tails_agree(name, view)]
            if len(fits) > 1:
                raise InputError(
                    f"image '{name}' may be '{fits[0]}' or '{fits[1]}' of {self.source}; give the image folder above, "
                    "so that names tell them apart"
                )
            if fits:
                found[name] = fits[0]
        return found


@dataclass(frozen=True, kw_only=True, slots=True)
class Format:
    """A format of ground truth.

    expects: what it looks like, for messages and --help. detects: whether a file or folder looks like it, without
    reading much. read: (path, folder of the images or None for where the format has them). place: where data in this
    format was taken, empty where it may be anywhere.
    """

    name: str
    expects: str
    detects: Callable[[Path], bool]
    read: Callable[[Path, Path | None], GroundTruth]
    place: Literal["indoor", "outdoor", ""] = ""


def _tails_agree(name0: str, name1: str) -> bool:
    a, b = PurePosixPath(name0).parts, PurePosixPath(name1).parts
    shorter = min(len(a), len(b))
    return a[-shorter:] == b[-shorter:]
