"""Label maps made by someone else: a folder of PNG files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Int32

from sgam_core.errors import InputError, SGAMError
from sgam_sfm.images import MAX_IMAGE_SIZE, ImageFile, read_label_map
from sgam_sfm.label_set import Label, LabelSet, at_size_of, has_aspect, read_label_set
from sgam_sfm.label_tables import APART, LabelTable, find_table

_SAME_ASPECT = 0.02  # ScanNet has maps of 1296x968 for images of 640x480


class LabelFolder:
    """Reads the labels of `sub/a.jpg` from `<folder>/sub/a.jpg.png` or `<folder>/sub/a.png`.

    8 or 16 bits, any ids, 0 = void; the ids mean the same thing in every image (ScanNet, Cityscapes, KITTI-360, or the
    export of any segmentation model). Of Cityscapes' `a_leftImg8bit.png` the maps keep their names, too.

    resize: take maps of another size than their image, resized without interpolation. label_names: how the maps are
    written, see `sgam_sfm.label_tables`; when empty, what the folder's labels.json says of it.

    Raises: InputError when the folder does not exist, or its labels.json or table of names cannot be used; OptionError
        for a table that is none.
    """

    def __init__(self, folder: Path, resize: bool = False, label_names: str = "") -> None:
        if not folder.is_dir():
            raise InputError(f"--labels '{folder}' does not exist; give the folder that holds <image name>.png")
        self.folder = folder
        self._given = read_label_set(folder)
        self.resize = resize or bool(self._given.made_from)  # those of a run have the size that areas are described at
        self._table: LabelTable | None = None
        if label_names or self._given.names:
            self._table = find_table(label_names) if label_names else find_table(self._given.names, folder)
        self._seen: set[int] = set()  # instances, which no table lists

    @property
    def label_set(self) -> LabelSet:
        """What is known of the ids; among them the instances, where they are kept apart, of the maps read so far."""
        if self._table is None:
            return self._given
        ids = sorted({*self._table.names, *self._seen} - {0})
        by_id = {label: Label(id=label, name=self._table.name_of(label)) for label in ids}
        return replace(self._given, labels=(*(by_id | {label.id: label for label in self._given.labels}).values(),))

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
        candidates: tuple[str, ...] = (f"{name}.png", PurePosixPath(name).with_suffix(".png").as_posix())
        if (base := PurePosixPath(name).with_suffix("").as_posix()).endswith("_leftImg8bit"):
            kind = "instanceIds" if self._table and self._table.instances == APART else "labelIds"
            candidates = (*candidates, f"{base.removesuffix('_leftImg8bit')}_gtFine_{kind}.png")
        found = [name for name in dict.fromkeys(candidates) if (self.folder / name).is_file()]
        if not found:
            expected = " or ".join(f"'{candidate}'" for candidate in candidates)
            raise InputError(f"no labels for '{name}'; expected {expected} in '{self.folder}'")
        if len(found) > 1:
            raise InputError(f"two label maps for '{name}': '{found[0]}' and '{found[1]}'; keep one of them")
        path = self.folder / found[0]
        labels = read_label_map(path, max_size) if self._table is None else self._table.read(path, max_size)
        if self._table is not None and self._table.instances == APART:
            self._seen.update(np.unique(labels).tolist())
        return labels

    def _labels(self, image: ImageFile) -> Int32[np.ndarray, "H W"]:
        labels = self.read(image.name, max(image.width, image.height, MAX_IMAGE_SIZE))
        if labels.shape != (image.height, image.width) and not self.resize:
            raise InputError(
                f"labels for '{image.name}' are {labels.shape[0]}x{labels.shape[1]} but the image is "
                f"{image.height}x{image.width} (height x width); export them again at the image's size, or pass "
                "--resize-labels"
            )
        if not has_aspect(labels, image, _SAME_ASPECT):
            raise InputError(
                f"labels for '{image.name}' are {labels.shape[0]}x{labels.shape[1]} but the image is "
                f"{image.height}x{image.width} (height x width), of another aspect; export them again, turned as the "
                "image is stored"
            )
        return at_size_of(image, labels)
