"""Patch features of a DINOv2 vision transformer, read between two of its blocks, through ONNX Runtime."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import onnx
from google.protobuf.message import DecodeError  # type: ignore[import-untyped, unused-ignore]
from jaxtyping import Float16, Float32, UInt8
from onnx.utils import Extractor

from sgam_core.errors import WeightsError
from sgam_sfm.onnx_session import open_session

PATCH = 14  # pixels a side
_MIN_PATCHES = 4  # a side: the shorter side of a panorama, or of a tiny image, still becomes a grid
# ImageNet's, as DINOv2 was trained.
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)


class PatchFeatures:
    """Features of the 14-pixel patches of an image: the tokens that enter a block of the transformer.

    block: counted from 0. image_size: pixels of the longer side at which the image enters the network. device, threads:
    see `open_session`.

    Raises: WeightsError when the file is not a DINOv2 in ONNX form.
    """

    def __init__(self, weights: Path, *, block: int, image_size: int, device: str = "cpu", threads: int = 0) -> None:
        self._session = open_session(_cut_before(weights, block), f"coseg ('{weights}')", device, threads)
        self._image_size = image_size

    def __call__(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Float16[np.ndarray, "rows columns C"]:
        """Unit-length features (rows, columns, C) on a grid of patches that covers the whole image."""
        network_input = in_whole_patches(pixels, self._image_size, PATCH, _MEAN, _STD)
        (tokens,) = self._session.run(None, {self._session.get_inputs()[0].name: network_input})
        return unit_grid(tokens[0, 1:], network_input, PATCH)  # the first token stands for the whole image


def in_whole_patches(
    pixels: UInt8[np.ndarray, "H W 3"],
    image_size: int,
    patch: int,
    mean: Float32[np.ndarray, " 3"],
    std: Float32[np.ndarray, " 3"],
) -> Float32[np.ndarray, "1 3 h w"]:
    """An image as a vision transformer sees it: `image_size` pixels on its longer side, both whole patches."""
    height, width = pixels.shape[:2]
    scale = image_size / max(height, width) / patch
    rows, columns = (max(_MIN_PATCHES, round(side * scale)) for side in (height, width))
    method = cv2.INTER_AREA if rows * patch < height else cv2.INTER_LINEAR
    resized = cv2.resize(pixels, (columns * patch, rows * patch), interpolation=method)
    scaled: np.ndarray = ((resized.astype(np.float32) / 255 - mean) / std).transpose(2, 0, 1)[None]
    return scaled


def unit_grid(
    tokens: Float32[np.ndarray, "N C"], network_input: Float32[np.ndarray, "1 3 h w"], patch: int
) -> Float16[np.ndarray, "rows columns C"]:
    """The tokens of an image's patches at unit length, on their grid."""
    rows, columns = (side // patch for side in network_input.shape[2:])
    unit: np.ndarray = tokens / np.linalg.norm(tokens, axis=1, keepdims=True)
    return unit.reshape(rows, columns, -1).astype(np.float16)


def _cut_before(weights: Path, block: int) -> bytes:
    """The network up to the tokens that enter `block`, for images of any size in whole patches."""
    try:
        model = onnx.load(weights)
    except (OSError, DecodeError) as error:
        raise WeightsError(f"'{weights}' cannot be read as an ONNX model; give a DINOv2 in ONNX form") from error
    first_norm = f"/layer.{block}/norm1/"
    tokens = next((node.input[0] for node in model.graph.node if first_norm in node.name), None)
    if tokens is None:
        raise WeightsError(f"'{weights}' has no node named '...{first_norm}...'; expected a DINOv2 in ONNX form")
    image = model.graph.input[0]
    # The graph computes its position embedding from the input's shape; only the declared shape is fixed.
    for axis, size in zip(image.type.tensor_type.shape.dim, ("batch", 3, "height", "width"), strict=True):
        axis.Clear()
        setattr(axis, "dim_value" if isinstance(size, int) else "dim_param", size)
    model.graph.value_info.append(onnx.helper.make_tensor_value_info(tokens, onnx.TensorProto.FLOAT, None))
    cut: bytes = Extractor(model).extract_model([image.name], [tokens]).SerializeToString()
    return cut
