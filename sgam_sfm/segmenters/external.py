"""A segmenter that runs in another Python environment, as a worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Int32
from pydantic import TypeAdapter, ValidationError

from sgam_core.errors import SGAMError, StageError
from sgam_sfm.external import Worker, WorkerCommand
from sgam_sfm.images import ImageFile, read_image
from sgam_sfm.label_set import Label, LabelSet
from sgam_sfm.segmenters.protocol import fault_of


class ExternalSegmenter:
    """Segmenter (`sgam_sfm.segmenters.protocol.Segmenter`): what a worker makes of one image at a time, checked.

    Raises: see `Worker`; also when the worker's names of labels are none.
    """

    def __init__(self, *, worker: WorkerCommand, device: str = "cpu", seed: int = 0) -> None:
        self._worker = Worker(worker, {"device": device, "seed": seed})
        try:
            names = TypeAdapter(dict[int, str]).validate_python(self._worker.hello.get("labels", {}))
        except ValidationError as error:
            raise self._worker.unusable("has labels that are no names by id; expected {1: 'wall', ...}") from error
        self.label_set = LabelSet(labels=tuple(Label(id=number, name=names[number]) for number in sorted(names)))

    def segment(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
        for image in images:
            try:
                labels: Int32[np.ndarray, "H W"] | Exception = self._labels(image)
            except StageError:
                raise
            except SGAMError as error:
                labels = error
            advance(1.0)
            yield image, labels

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def _labels(self, image: ImageFile) -> Int32[np.ndarray, "h w"]:
        pixels = read_image(image)

        def read(arrays: list[np.ndarray]) -> Int32[np.ndarray, "h w"]:
            if len(arrays) != 1 or arrays[0].dtype != np.int32:
                given = ", ".join(f"{array.dtype} {array.shape}" for array in arrays) or "nothing"
                raise self._worker.wrong(f"gave {given} for '{image.name}'; expected one label map, of int32")
            if fault := fault_of(arrays[0], image):
                raise self._worker.wrong(fault)
            return arrays[0]

        return self._worker.ask({"type": "segment"}, [pixels], read, 1)
