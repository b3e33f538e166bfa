"""What the ids of label maps mean: labels.json, beside the maps.

labels.json             see `LabelSet`; its `labels` alone make a folder of maps from elsewhere speak in names
<image name>.png        ids of 8 or 16 bits, 0 = unknown
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from pydantic import TypeAdapter, ValidationError

from sgam_core.errors import InputError, OptionError
from sgam_sfm.images import ImageFile
from sgam_sfm.nearest import did_you_mean

RECORD = "labels.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class Label:
    """One label. name: empty when it has none. colour: #rrggbb in overlays. share: of the collection's pixels."""

    id: int
    name: str = ""
    colour: str = ""
    share: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelSet:
    """The content of labels.json; in one written by hand, everything but `labels` may be left out.

    segmenter: who made the maps. labels: those that occur. void: the id of pixels without a label. ignored: ids that
    form no areas. failed: images without a map, and why. facts: what the segmenter reports of itself.
    """

    version: int = 1
    segmenter: str = "labels"
    void: int = 0
    labels: tuple[Label, ...] = ()
    ignored: tuple[int, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, object] = field(default_factory=dict)

    @property
    def names(self) -> dict[str, int]:
        """Ids by name, in lower case."""
        return {label.name.lower(): label.id for label in self.labels if label.name}

    def ids(self, wanted: str, flag: str) -> tuple[int, ...]:
        """The ids of a comma-separated list of names and ids.

        Args: flag: the option that holds the list, for messages.
        Raises: OptionError for a name that no label has, with the nearest one.
        """
        return tuple(self._id(text.strip(), flag) for text in wanted.split(",") if text.strip())

    def _id(self, text: str, flag: str) -> int:
        if text.lower() in self.names:
            return self.names[text.lower()]
        ids = sorted(label.id for label in self.labels)
        known = f" from {ids[0]} to {ids[-1]}" if ids else ""
        if text.isdecimal():
            if ids and int(text) not in ids:
                raise OptionError(f"{flag} '{text}' is no label; ids are{known}, see labels.json")
            return int(text)
        if all(part.isdecimal() for part in text.split()):
            raise OptionError(f"{flag} '{text}': separate labels by commas, '{','.join(text.split())}'")
        if not self.names:
            raise OptionError(f"{flag} '{text}': labels of '{self.segmenter}' have no names; give ids{known}")
        hint = did_you_mean(text.lower(), self.names)
        raise OptionError(f"{flag} '{text}' is no label; {hint}known: {', '.join(sorted(self.names))}")


def read_label_set(folder: Path) -> LabelSet:
    """What labels.json of a folder says; nothing when there is none.

    Raises: InputError when it is not what `LabelSet` describes.
    """
    path = folder / RECORD
    if not path.exists():
        return LabelSet()
    try:
        found = TypeAdapter(LabelSet).validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.strerror
        where = ".".join(map(str, error.errors()[0]["loc"])) if isinstance(error, ValidationError) else ""
        raise InputError(
            f"'{path}' cannot be used ({f'{where}: ' if where else ''}{reason}); "
            'expected {"labels": [{"id": 1, "name": "wall"}, ...]}'
        ) from error
    if found.version != 1:
        raise InputError(f"'{path}' has version {found.version}; this sgam-sfm reads version 1")
    if found.void != 0:
        raise InputError(f"'{path}' has void {found.void}; expected 0: export the maps with 0 where it is unknown")
    return found


def at_size_of(image: ImageFile, labels: np.ndarray) -> np.ndarray:
    """A map (H, W) of ids at the size of its image, never interpolated."""
    size = (image.width, image.height)
    if labels.shape == size[::-1]:
        return labels
    return cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT)
