"""Cameras of images and of parts of them, as the user gave them and as the database has them.

Pixels have COLMAP's corner origin, as everywhere in this project: nothing is shifted here.
"""

from __future__ import annotations

import math
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float

from sgam_sfm.nearest import unknown

CAMERA_MODELS = tuple(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")


@dataclass(frozen=True, kw_only=True, slots=True)
class KnownCamera:
    """A camera that the user gave. folder: whose images share it with no others, empty for any that have equal ones."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int
    folder: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraInfo:
    """An image of the database and its camera.

    has_prior_focal: the focal length is known, from the user or from EXIF. known: the user gave all parameters.
    """

    image_id: int
    camera_id: int
    model: str
    params: tuple[float, ...]
    width: int
    height: int
    has_prior_focal: bool
    known: bool


def camera_parameters(model: str, params: str | Sequence[float | str] | None) -> tuple[float, ...] | None:
    """The parameters as numbers. Raises: ValueError, with a message for users, when they do not fit the model."""
    if model not in CAMERA_MODELS:
        raise ValueError(unknown("camera model", model, CAMERA_MODELS))
    if params is None:
        return None
    texts = [text for text in params.split(",") if text.strip()] if isinstance(params, str) else list(params)
    expected = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2)
    given = ",".join(map(str, texts))
    if len(texts) != len(expected.params):
        raise ValueError(
            f"camera model {model} has {len(expected.params)} parameters ({expected.params_info}) but {len(texts)} "
            f"were given: '{given}'"
        )
    try:
        values = tuple(map(float, texts))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise ValueError(f"camera parameters '{given}' of {model} ({expected.params_info}) are not all numbers")
    return values


def camera_of_info(info: CameraInfo) -> pycolmap.Camera:
    """COLMAP's own form of an image's camera."""
    return pycolmap.Camera(
        model=info.model,
        width=info.width,
        height=info.height,
        params=info.params,
        has_prior_focal_length=info.has_prior_focal,
    )


def camera_matrix(info: CameraInfo) -> Float[np.ndarray, "3 3"] | None:
    """Pinhole matrix (3, 3), corner origin, for the two-view geometry of matching; lens distortion is ignored.

    Returns: None when the focal length is not known, or the lens (fisheye, panorama) is no pinhole even roughly.
    """
    camera = camera_of_info(info)
    if not info.has_prior_focal or not camera.is_perspective_pinhole():
        return None
    return np.asarray(camera.calibration_matrix(), np.float64)


def camera_of_part(
    info: CameraInfo, origin: tuple[int, int], part: tuple[int, int], size: tuple[int, int], turns: int = 0
) -> KnownCamera:
    """The camera of a part of an image, resized, then turned by quarters anticlockwise.

    Args: origin: (x0, y0) of the part in the image. part, size: its (width, height) there and after resizing.
    """
    camera = camera_of_info(info)
    camera.principal_point_x -= origin[0]
    camera.principal_point_y -= origin[1]
    camera.width, camera.height = part
    camera.rescale(*size)
    for _ in range(turns):
        _turn(camera)
    return KnownCamera(
        model=info.model, params=tuple(map(float, camera.params)), width=camera.width, height=camera.height
    )


def _turn(camera: pycolmap.Camera) -> None:
    """Turn a camera anticlockwise by a quarter, in place: (x, y) becomes (y, width - x)."""
    before = dict(zip(camera.params_info.split(", "), map(float, camera.params), strict=True))
    after = before | {"cx": before["cy"], "cy": camera.width - before["cx"]}
    if "fx" in before:
        after |= {"fx": before["fy"], "fy": before["fx"]}
    if "p1" in before:
        after |= {"p1": -before["p2"], "p2": before["p1"]}
    if "sx1" in before:
        after |= {"sx1": before["sy1"], "sy1": -before["sx1"]}
    camera.params = list(after.values())
    camera.width, camera.height = camera.height, camera.width
