"""How far the poses of a model are from the true ones."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import pycolmap

from sgam_sfm.colmap.process import Progress, run, serve


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseErrors:
    """How a model's poses differ from the truth after a similarity alignment. center: in the truth's unit."""

    num_images: int
    median_center: float
    max_center: float
    median_rotation_deg: float
    max_rotation_deg: float


def compare_poses(model: Path, truth: Path, max_center_error: float = 0.1) -> PoseErrors:
    """Align a model to the true one by their camera centres and compare the poses of the images they share.

    Args: model, truth: folders with COLMAP models. max_center_error: of an inlier of the alignment, in the truth's
        unit.
    Raises: StageError when they cannot be read or aligned.
    """
    job = {"model": str(model), "truth": str(truth), "max_center_error": max_center_error}
    result, _ = run(__name__, "comparison", job, model.parent.parent / "colmap.log")
    rotations, centers = result["rotations_deg"], result["centers"]
    return PoseErrors(
        num_images=len(centers),
        median_center=median(centers),
        max_center=max(centers),
        median_rotation_deg=median(rotations),
        max_rotation_deg=max(rotations),
    )


def _compare(job: dict[str, Any], send: Progress) -> dict[str, Any]:
    """Runs in the child process; see `process`."""
    found = pycolmap.compare_reconstructions(
        pycolmap.Reconstruction(job["model"]),
        pycolmap.Reconstruction(job["truth"]),
        alignment_error="proj_center",
        max_proj_center_error=job["max_center_error"],
    )
    if found is None:
        raise RuntimeError(f"{job['model']} cannot be aligned to {job['truth']}")
    errors = found["errors"]
    return {
        "rotations_deg": [error.rotation_error_deg for error in errors],
        "centers": [error.proj_center_error for error in errors],
    }


if __name__ == "__main__":
    serve(_compare)
