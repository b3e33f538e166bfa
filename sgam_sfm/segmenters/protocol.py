"""What a segmenter is: label maps for a whole collection, in one label space."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int32, UInt8

from sgam_core.errors import SGAMError
from sgam_sfm.images import ImageFile, read_image
from sgam_sfm.label_set import LARGEST_ID, has_aspect


@runtime_checkable
class Segmenter(Protocol):
    """Gives every image of a collection a label map; equal labels mean the same thing in all of them."""

    def segment(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
        """Yield (image, labels) for every image, in order; an image that fails yields its error in place of labels.

        labels: int32, 0 = void; any size with the image's aspect. `advance(share)` is called as work is done; the
        shares add up to len(images).
        """
        ...


def fault_of(made: object, image: ImageFile) -> str:
    """What is wrong with a label map of an image, as "gave ...; expected ..."; empty when nothing is."""
    if not isinstance(made, np.ndarray) or made.dtype.kind not in "iu" or not has_aspect(made, image):
        given = f"{made.dtype} {made.shape}" if isinstance(made, np.ndarray) else type(made).__name__
        expected = f"integers ({image.height}, {image.width}), or another size of the same aspect"
        return f"gave {given} for '{image.name}'; expected {expected}"
    if made.min() < 0 or made.max() > LARGEST_ID:
        between = f"from {made.min()} to {made.max()}"
        return f"gave ids {between} for '{image.name}'; expected 0 (unknown) to {LARGEST_ID}"
    return ""


def one_by_one(
    labels_of: Callable[[UInt8[np.ndarray, "H W 3"]], Int32[np.ndarray, "h w"]],
    images: Sequence[ImageFile],
    advance: Callable[[float], None],
) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
    """`Segmenter.segment` of a network that looks at one image at a time, given its pixels (RGB)."""
    for image in images:
        try:
            labels: Int32[np.ndarray, "H W"] | Exception = labels_of(read_image(image))
        except SGAMError as error:
            labels = error
        advance(1.0)
        yield image, labels
