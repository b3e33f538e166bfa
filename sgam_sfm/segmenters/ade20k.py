"""Names for what photos show: DeepLabV3 on MobileNetV2, the 31 commonest classes of ADE20K (Zhou et al., CVPR 2017).

MLPerf Mobile's network: fast on a CPU, coarse. Buildings come out whole, so it gives few areas on facades; its names
(sky, person, car) are what `--ignore-labels` and `--mask-matches` want.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int32, UInt8

from sgam_core.errors import WeightsError
from sgam_sfm.images import ImageFile
from sgam_sfm.label_set import Label, LabelSet
from sgam_sfm.segmenters.protocol import one_by_one
from sgam_sfm.weights import ADE20K, find_weights

CLASSES = (
    *("wall", "building", "sky", "floor", "tree", "ceiling", "road", "bed", "window", "grass", "cabinet", "sidewalk"),
    *("person", "earth", "door", "table", "mountain", "plant", "curtain", "chair", "car", "water", "painting", "sofa"),
    *("shelf", "house", "sea", "mirror", "rug", "field", "armchair"),
)
"""The first 31 of ADE20K in its own order: labels 1, 2, ...; 0 is everything else."""


class ADE20K31:
    """Segmenter (`sgam_sfm.segmenters.protocol.Segmenter`): one image at a time, labels 1..31 by `CLASSES`.

    weights: the TFLite file; looked for in the torch-hub cache when omitted. threads: 0 for all cores.
    """

    label_set = LabelSet(
        segmenter="ade20k", labels=tuple(Label(id=number, name=name) for number, name in enumerate(CLASSES, start=1))
    )

    def __init__(self, *, weights: Path | None = None, threads: int = 0) -> None:
        from ai_edge_litert.interpreter import Interpreter

        path = find_weights(ADE20K, weights)
        try:
            self._network = Interpreter(model_path=str(path), num_threads=threads or os.cpu_count())
            self._network.allocate_tensors()
        except (ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise WeightsError(f"ade20k ('{path}') cannot be loaded ({reason}); get its file again") from error
        (self._input,), (self._output,) = self._network.get_input_details(), self._network.get_output_details()

    def segment(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
        return one_by_one(self._labels, images, advance)

    def _labels(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Int32[np.ndarray, "h w"]:
        """The map at the network's resolution; the image keeps its aspect, beside it the square is black."""
        _, rows, columns, _ = (int(length) for length in self._input["shape"])
        scale = min(columns / pixels.shape[1], rows / pixels.shape[0])
        width, height = (max(round(scale * length), 1) for length in (pixels.shape[1], pixels.shape[0]))
        frame = np.zeros((1, rows, columns, 3), np.uint8)
        frame[0, :height, :width] = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
        self._network.set_tensor(self._input["index"], frame)
        self._network.invoke()
        labels: np.ndarray = self._network.get_tensor(self._output["index"])
        return labels.reshape(rows, columns)[:height, :width].astype(np.int32)
