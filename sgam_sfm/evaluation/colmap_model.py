"""The files of a COLMAP model that hold cameras and poses, parsed as they are; points and rigs are passed over."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sgam_core.errors import InputError
from sgam_sfm.evaluation.ground_truth.reading import floats, text_lines

Camera = tuple[str, int, int, np.ndarray]
"""Model, width, height, parameters."""
Image = tuple[str, str, int, np.ndarray]
"""Where it was read, name, camera id, and world-to-camera quaternion (w first) and translation (7 numbers)."""

# COLMAP's id of a camera model: its name, focal lengths, and distortion parameters, which are in OpenCV's order.
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 1, 0),
    1: ("PINHOLE", 2, 0),
    2: ("SIMPLE_RADIAL", 1, 1),
    3: ("RADIAL", 1, 2),
    4: ("OPENCV", 2, 4),
    6: ("FULL_OPENCV", 2, 8),
}


def unsupported(path: Path, model: str) -> InputError:
    """What to raise for a camera model that is not in CAMERA_MODELS."""
    known = ", ".join(name for name, _, _ in CAMERA_MODELS.values())
    return InputError(f"{path}: camera model {model} is not supported; undistort the images, or use one of {known}")


def text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    """Cameras of cameras.txt by id."""
    for number, line in text_lines(path):
        if line and not line.startswith("#"):
            where, tokens = f"{path}, line {number}", line.split()
            if len(tokens) < 5:
                raise InputError(f"{where}: {len(tokens)} fields; expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")
            numbers = floats([tokens[0], *tokens[2:]], where, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")
            yield int(numbers[0]), (tokens[1], int(numbers[1]), int(numbers[2]), numbers[3:])


def text_images(path: Path) -> Iterator[Image]:
    """Images of images.txt."""
    # Two lines an image: a line of points, which may be empty, follows each.
    lines = [(n, line) for n, line in text_lines(path) if not line.startswith("#")]
    while lines and not lines[0][1]:
        lines.pop(0)
    for number, line in lines[::2]:
        if line:
            where, tokens = f"{path}, line {number}", line.split(maxsplit=9)
            if len(tokens) != 10:
                raise InputError(
                    f"{where}: {len(tokens)} fields; expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                )
            numbers = floats(tokens[1:9], where, "QW QX QY QZ TX TY TZ CAMERA_ID")
            yield where, tokens[9], int(numbers[7]), numbers[:7]


def binary_cameras(path: Path, data: bytes) -> Iterator[tuple[int, Camera]]:
    """Cameras of cameras.bin by id; struct.error where it is cut short."""
    at = 8
    for _ in range(*struct.unpack_from("<Q", data)):
        camera_id, model, width, height = struct.unpack_from("<IiQQ", data, at)
        if model not in CAMERA_MODELS:  # how long it is, and so where the next one starts, is not known
            raise unsupported(path, f"number {model}")
        name, focals, distortions = CAMERA_MODELS[model]
        count = focals + 2 + distortions
        yield camera_id, (name, width, height, np.array(struct.unpack_from(f"<{count}d", data, at + 24)))
        at += 24 + 8 * count


def binary_images(path: Path, data: bytes) -> Iterator[Image]:
    """Images of images.bin; struct.error or ValueError where it is cut short."""
    at = 8
    for index in range(*struct.unpack_from("<Q", data)):
        *numbers, camera_id = struct.unpack_from("<7dI", data, at + 4)
        end = data.index(b"\0", at + 64)
        yield f"{path}, image {index + 1}", data[at + 64 : end].decode(), camera_id, np.array(numbers)
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    if at > len(data):
        raise ValueError(f"{path.name} ends within an image")
