"""Read the pieces that ground truth is made of, and refuse what cannot be right, with file and line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float
from PIL import Image as PillowImage

from sgam_core.errors import InputError
from sgam_sfm.images import read_label_map

# Files give rotations with 5 digits or more; a wrong convention or a wrong column is off by far more.
_ORTHOGONAL = 1e-3


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthFile:
    """A depth map: an image of 16 bits, or an h5 file with a data set `depth`. scale: its unit per value."""

    path: Path
    scale: float = 1.0

    def read(self) -> Float[np.ndarray, "H W"]:
        """Raises: InputError when the file is missing or broken."""
        if self.path.suffix == ".h5":
            values = read_h5(self.path, "depth")["depth"]
        else:
            try:
                values = read_label_map(self.path)
            except InputError as error:
                raise InputError(f"depth map '{self.path}' cannot be used: {error}") from error
        if values.ndim != 2:
            raise InputError(f"depth map '{self.path}' has shape {values.shape}; expected (height, width)")
        return values.astype(np.float64) * self.scale


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines of a text file with their numbers, stripped; raises InputError when it cannot be read."""
    try:
        content = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"'{path}' cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"'{path}' is not a text file") from error
    yield from enumerate(map(str.strip, content.split("\n")), start=1)


def floats(tokens: list[str], where: str, expected: str, *, finite: bool = True) -> Float[np.ndarray, " N"]:
    """Numbers; raises InputError with `where` and `expected` for anything else, and for NaN or infinity."""
    try:
        values = np.array([float(token) for token in tokens])
    except ValueError as error:
        raise InputError(f"{where}: {str(error).split(': ')[-1]} is not a number; expected {expected}") from error
    if finite and not np.isfinite(values).all():
        raise InputError(
            f"{where}: {tokens[int(np.argmin(np.isfinite(values)))]} among the numbers; expected {expected}"
        )
    return values


def read_numbers(path: Path, count: int, expected: str, *, finite: bool = True) -> Float[np.ndarray, " N"]:
    """All numbers of a text file, which must be `count`."""
    parts = [floats(line.split(), f"{path}, line {n}", expected, finite=finite) for n, line in text_lines(path) if line]
    values = np.concatenate([np.zeros(0), *parts])
    if len(values) != count:
        raise InputError(f"{path}: {len(values)} numbers; expected {count}: {expected}")
    return values


def read_h5(path: Path, *keys: str) -> dict[str, np.ndarray]:
    """The data sets of an h5 file that are named and there; raises InputError when the first is missing."""
    try:
        with h5py.File(path, "r") as file:
            found = {key: np.asarray(file[key]) for key in keys if key in file}
    except (OSError, RuntimeError, TypeError) as error:
        raise InputError(f"'{path}' cannot be read as an h5 file ({str(error).splitlines()[0]})") from error
    if keys[0] not in found:
        raise InputError(f"'{path}' has no data set '{keys[0]}'; expected {', '.join(keys)}")
    return found


def rigid(values: np.ndarray, where: str) -> Float[np.ndarray, "3 4"]:
    """A pose (3, 4) from 12 or 16 numbers, row by row, with the nearest true rotation.

    Raises: InputError with `where` when it is not finite or no rotation, or the last row is not 0 0 0 1.
    """
    if np.size(values) not in (12, 16):
        raise InputError(f"{where}: {np.size(values)} numbers of a pose; expected 3 or 4 rows of 4")
    matrix = np.asarray(values, np.float64).reshape(-1, 4)
    R = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: the pose has NaN or infinity; expected finite numbers")
    if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise InputError(f"{where}: the last row of the pose is {matrix[3].tolist()}; expected 0 0 0 1")
    if np.abs(R.T @ R - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(R) < 0:
        raise InputError(
            f"{where}: the pose has no rotation matrix (determinant {np.linalg.det(R):.3g}); expected orthonormal "
            "columns and determinant 1"
        )
    U, _, Vt = np.linalg.svd(R)
    return np.column_stack([U @ Vt, matrix[:3, 3]])


def camera_matrix(values: np.ndarray, where: str, origin: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """A pinhole matrix (3, 3) with corner origin.

    Args: values: 9 numbers, row by row. origin: where they have the centre of the first pixel subtracted from 0.5: 0.5
        is added for files whose pixel centres are whole numbers, 0 for files with corner origin.
    Raises: InputError with `where` when the matrix is not finite, singular, or no pinhole.
    """
    if np.size(values) != 9:
        raise InputError(f"{where}: {np.size(values)} numbers of K; expected 3 rows of 3")
    K = np.array(values, np.float64).reshape(3, 3)
    form = np.isfinite(K).all() and K[1, 0] == 0 and np.array_equal(K[2], [0, 0, 1])
    if not (form and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(f"{where}: K is {K.tolist()}; expected fx s cx / 0 fy cy / 0 0 1 with positive focal lengths")
    K[:2, 2] += origin
    return K


def scaled(K: Float[np.ndarray, "3 3"], sx: float, sy: float) -> Float[np.ndarray, "3 3"]:
    """K (corner origin) of the image resized by sx and sy."""
    resized: np.ndarray = np.diag([sx, sy, 1.0]) @ K
    return resized


def image_size(path: Path, where: str = "") -> tuple[int, int]:
    """(width, height) of an image as it is stored; raises InputError, opening with `where`, when it cannot be read."""
    lead = f"{where}: " if where else ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about many pixels, none of which is decoded here
            with PillowImage.open(path) as picture:
                return picture.size
    except (OSError, ValueError, PillowImage.DecompressionBombError) as error:  # ValueError: a name with a NUL
        reason = getattr(error, "strerror", None) or "not an image of a known format"
        raise InputError(f"{lead}image '{path}' cannot be read ({reason}); its size is needed") from error


def first_existing(*paths: Path) -> Path | None:
    """The first path that exists."""
    return next((path for path in paths if path.exists()), None)
