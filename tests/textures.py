"""A texture that is known at every real coordinate, so that a warped view of it has no interpolation error."""

from __future__ import annotations

import numpy as np

from sgam_core.types import Box, Crop, Image

_WAVES = 160


def view(image_from_texture: np.ndarray, size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """Pixels (h, w, 3) of the texture seen through a homography (3, 3) that maps texture to image pixels."""
    rng = np.random.default_rng(seed)
    wavelengths = np.geomspace(8, 160, _WAVES)
    angles, phases = rng.uniform(0, 2 * np.pi, (2, _WAVES))
    frequencies = 2 * np.pi / wavelengths * np.stack([np.cos(angles), np.sin(angles)])
    amplitudes = wavelengths**0.4 / np.linalg.norm(wavelengths**0.4)

    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    points = transfer(np.linalg.inv(image_from_texture), np.stack([x.ravel(), y.ravel()], -1))
    waves = np.cos((points @ frequencies + phases).astype(np.float32)) @ amplitudes.astype(np.float32)
    gray = 127.5 + 110 * np.tanh(2.5 * waves.reshape(size[1], size[0]))
    return np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=2)


def transfer(homography: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 2) through a homography (3, 3)."""
    mapped = np.c_[points, np.ones(len(points))] @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def similarity(scale: float, degrees: float, shift: tuple[float, float], center: tuple[float, float]) -> np.ndarray:
    """Scaling and rotation about `center`, then a shift, as (3, 3)."""
    angle = np.deg2rad(degrees)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    homography = np.eye(3)
    homography[:2, :2] = linear
    homography[:2, 2] = np.array(center) + shift - linear @ center
    return homography


def whole(pixels: np.ndarray, name: str, mask: np.ndarray | None = None) -> Crop:
    """The whole of an image as one crop."""
    height, width = pixels.shape[:2]
    window = Box(x0=0, y0=0, x1=width, y1=height)
    return Crop(image=Image(name=name, pixels=pixels, mask=mask), window=window, size=(width, height))
