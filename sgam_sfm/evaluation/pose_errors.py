"""How far the poses of a model are from the true ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import median

from sgam_core.errors import InputError
from sgam_sfm.colmap.reading import read_poses_and_points
from sgam_sfm.evaluation.sfm_metrics import align, camera_errors


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseErrors:
    """How a model's poses differ from the truth once it is aligned, see `align`. center: in the truth's unit.

    worst: the image whose centre is furthest off.
    """

    num_images: int
    median_center: float
    max_center: float
    median_rotation_deg: float
    max_rotation_deg: float
    worst: str


def compare_poses(model: Path, truth: Path) -> PoseErrors:
    """Align a model to the true one and compare the poses of the images they share.

    Args: model, truth: folders with COLMAP models.
    Raises: InputError when they cannot be read or aligned.
    """
    estimated, true = (read_poses_and_points(folder)[0] for folder in (model, truth))
    similarity = align(estimated, true)
    if similarity is None:
        raise InputError(
            f"'{model}' and '{truth}' share fewer than two images at different places: none can be compared"
        )
    errors = camera_errors(estimated, true, similarity)
    centers = {name: error.centre for name, error in errors.items()}
    rotations = [error.rotation for error in errors.values()]
    return PoseErrors(
        num_images=len(errors),
        median_center=median(centers.values()),
        max_center=max(centers.values()),
        median_rotation_deg=median(rotations),
        max_rotation_deg=max(rotations),
        worst=max(centers, key=centers.__getitem__),
    )
