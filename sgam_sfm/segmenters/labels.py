"""Label maps made by someone else: a folder of PNG files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Int32

from sgam_core.errors import InputError, SGAMError
from sgam_sfm.images import MAX_IMAGE_SIZE, ImageFile, read_label_map
from sgam_sfm.label_set import at_size_of, read_label_set


class LabelFolder:
    """Reads the labels of `sub/a.jpg` from `<folder>/sub/a.jpg.png` or `<folder>/sub/a.png`.

    8 or 16 bits, any ids, 0 = void; the ids mean the same thing in every image (ScanNet, Cityscapes, KITTI-360, or the
    export of any segmentation model).

    resize: take maps of another size than their image, resized without interpolation. label_set: what the folder's
    labels.json says of the ids.

    Raises: InputError when the folder does not exist, or its labels.json cannot be used.
    """

    def __init__(self, folder: Path, resize: bool = False) -> None:
        if not folder.is_dir():
            raise InputError(f"label folder '{folder}' does not exist; give the folder that holds the label maps")
        self.folder, self.resize = folder, resize
        self.label_set = read_label_set(folder)

    def segment(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
        for image in images:
            try:
                labels: np.ndarray | SGAMError = self._labels(image)
            except SGAMError as error:
                labels = error
            advance(1.0)
            yield image, labels

    def read(self, name: str, max_size: int = MAX_IMAGE_SIZE) -> Int32[np.ndarray, "H W"]:
        """The label map of an image as it is in the folder.

        Raises: InputError when there is none, there are two, or it is broken.
        """
        candidates = (f"{name}.png", PurePosixPath(name).with_suffix(".png").as_posix())
        found = [name for name in dict.fromkeys(candidates) if (self.folder / name).is_file()]
        if not found:
            raise InputError(
                f"no labels for '{name}'; expected '{candidates[0]}' or '{candidates[1]}' in '{self.folder}'"
            )
        if len(found) > 1:
            raise InputError(f"two label maps for '{name}': '{found[0]}' and '{found[1]}'; keep one of them")
        return read_label_map(self.folder / found[0], max_size)

    def _labels(self, image: ImageFile) -> Int32[np.ndarray, "H W"]:
        labels = self.read(image.name, max(image.width, image.height, MAX_IMAGE_SIZE))
        if labels.shape != (image.height, image.width) and not self.resize:
            raise InputError(
                f"labels for '{image.name}' are {labels.shape[0]}x{labels.shape[1]} but the image is "
                f"{image.height}x{image.width} (height x width); export them again at the image's size, or pass "
                "--resize-labels"
            )
        return at_size_of(image, labels)
