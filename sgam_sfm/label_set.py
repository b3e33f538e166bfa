"""What the ids of label maps mean: labels.json, beside the maps.

labels.json             see `LabelSet`; its `labels` or its `names` alone make a folder from elsewhere speak in names
<image name>.png        ids of 8 or 16 bits, 0 = unknown
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from pydantic import TypeAdapter, ValidationError

from sgam_core.errors import InputError, OptionError
from sgam_sfm.images import ImageFile
from sgam_sfm.nearest import did_you_mean

LARGEST_ID = 65535  # label maps have 16 bits
RECORD = "labels.json"
_MERGED = re.compile(r"(-other)?(-merged)?$")  # COCO's sky is `sky-other` or `sky-other-merged`


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

    segmenter: who made the maps. names: how ids are written and what they mean, as `--label-names` says it. labels:
    those that occur. void: the id of pixels without a label. ignored: ids that form no areas. failed: images without a
    map, and why. facts: what the segmenter reports of itself. made_from: a digest of the options and images that the
    maps of a run follow from.
    """

    version: int = 1
    segmenter: str = "labels"
    names: str = ""
    void: int = 0
    labels: tuple[Label, ...] = ()
    ignored: tuple[int, ...] = ()
    failed: Mapping[str, str] = field(default_factory=dict)
    facts: Mapping[str, object] = field(default_factory=dict)
    made_from: str = ""

    @property
    def by_name(self) -> dict[str, tuple[int, ...]]:
        """Ids by name, in lower case.

        `building` also means `building, edifice`, and `sky` also `sky-other-merged`, unless a label is called just so.
        """
        whole: dict[str, tuple[int, ...]] = {}
        short: dict[str, tuple[int, ...]] = {}
        for label in self.labels:
            if label.name:
                name = label.name.strip().lower()
                whole[name] = (*whole.get(name, ()), label.id)
                for part in {_MERGED.sub("", part.strip()) for part in name.split(",")} - {""}:
                    short[part] = (*short.get(part, ()), label.id)
        return short | whole

    def ids(self, wanted: str, flag: str) -> tuple[int, ...]:
        """The ids of a comma-separated list of names and ids.

        Args: flag: the option that holds the list, for messages.
        Raises: OptionError for a name that no label has, with the nearest one.
        """
        return tuple(found for text in wanted.split(",") if text.strip() for found in self._ids(text.strip(), flag))

    def require_names(self, wanted: str, flag: str) -> None:
        """Raises: OptionError for a name that no label has; ids are not looked at, since maps may have more of them."""
        self.ids(",".join(text for text in wanted.split(",") if not text.strip().isdecimal()), flag)

    def _ids(self, text: str, flag: str) -> Iterator[int]:
        by_name = self.by_name
        if text.lower() in by_name:
            yield from by_name[text.lower()]
            return
        ids = sorted(label.id for label in self.labels)
        known = f" from {ids[0]} to {ids[-1]}" if ids else ""
        if text.isdecimal():
            if ids and int(text) not in ids:
                raise OptionError(f"{flag} '{text}' is no label; ids are{known}, see labels.json")
            yield int(text)
            return
        if all(part.isdecimal() for part in text.split()):
            raise OptionError(f"{flag} '{text}': separate labels by commas, '{','.join(text.split())}'")
        if not by_name:
            own = self.segmenter == "labels"
            hint = ", or --label-names what they are" if own else ", or take a --segmenter that names them, like ade20k"
            raise OptionError(f"{flag} '{text}': labels of '{self.segmenter}' have no names; give ids{known}{hint}")
        near = did_you_mean(text.lower(), by_name)
        listed = ", ".join(sorted({label.name.strip().lower() for label in self.labels if label.name}))
        raise OptionError(f"{flag} '{text}' is no label; {near}known: {listed}")


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


def has_aspect(labels: np.ndarray, image: ImageFile, tolerance: float = 0.0) -> bool:
    """Whether a map has an image's aspect, up to the rounding of its sides and a share of the aspect."""
    if labels.ndim != 2 or not labels.size:
        return False
    rows, columns = labels.shape
    off = abs(rows * image.width - columns * image.height)
    return off <= max(image.width, image.height, tolerance * columns * image.height)
