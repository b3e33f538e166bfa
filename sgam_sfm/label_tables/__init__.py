"""How label maps of public data sets are written and what their ids mean: `--label-names`.

The text files beside this module are the classes of the data sets by the ids of their publishers, a tab between.
A map decodes to those ids, 0 where there is no label, whatever its files count from.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Int32

from sgam_core.errors import InputError, OptionError
from sgam_sfm.images import MAX_IMAGE_SIZE, read_label_map, read_segments
from sgam_sfm.nearest import did_you_mean

INSTANCES = 1000  # a pixel of Cityscapes' and KITTI-360's instance maps is class * 1000 + instance
# The 19 classes that are scored, in the order in which networks are trained.
_TRAIN_IDS = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)
# Classes of COCO's panoptic task among all of COCO: things that are annotated, stuff that is not merged, the merged.
_NO_THINGS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83, 91)
_PANOPTIC_STUFF = (
    *(92, 93, 95, 100, 107, 109, 112, 118, 119, 122, 125, 128, 130, 133, 138, 141, 144, 145, 147, 148, 149, 151, 154),
    *(155, 156, 159, 161, 166, 168, 171, 175, 176, 177, 178, 180, 181, *range(184, 201)),
)
PANOPTIC = (*(thing for thing in range(1, 92) if thing not in _NO_THINGS), *_PANOPTIC_STUFF)

DESCRIPTIONS = {
    "nyu40": "ids 1 to 40 of NYU40, as ScanNet's are after mapping",
    "ade20k": "ADE20K (scene parsing), 1 to 150",
    "coco": "COCO's own ids, 1 to 200: things, stuff and the merged stuff of the panoptic task",
    "coco-stuff": "COCO-Stuff's stuffthingmaps: COCO's ids less one, 255 without a label",
    "seem": "SEEM, and others trained on COCO panoptic: its 133 classes counted from 0, 255 without a label",
    "cityscapes": "labelIds or instanceIds of Cityscapes",
    "cityscapes-train": "the 19 train ids of Cityscapes, counted from 0, 255 without a label",
    "kitti360": "semantic or instance maps of KITTI-360",
}
APART = "instances"
"""`cityscapes:instances`: every instance is a label of its own, named as its class."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelTable:
    """The classes of a data set and how its maps are written.

    choice: what the user called it. names: of classes by id. ids: class of every value that a map may hold (0: no
    label), None where values are the classes themselves. instances: `merged` or `apart` where values of 1000 and more
    are class * 1000 + instance, else empty. segments: of COCO's panoptic PNGs, by file name, the class of every
    segment; None where maps hold no segments.
    """

    choice: str
    names: Mapping[int, str]
    ids: Mapping[int, int] | None = None
    instances: str = ""
    segments: Mapping[str, Mapping[int, int]] | None = field(default=None, repr=False)

    def read(self, path: Path, max_size: int = MAX_IMAGE_SIZE) -> Int32[np.ndarray, "H W"]:
        """The label map of a file, in the ids of `names`, or instances of them where those are kept apart.

        Args: max_size: in pixels; a map with a longer side is refused.
        Raises: InputError when the file cannot be read, or is not written as the table says.
        """
        if self.segments is None:
            values = read_label_map(path, max_size)
            classes = np.where(values >= INSTANCES, values // INSTANCES, values) if self.instances else values
            found = self._classes(classes, path)
            return np.where(found > 0, values, 0) if self.instances == APART else found
        if path.name not in self.segments:
            raise InputError(f"'{path.name}' is not in '{self.choice}'; give the JSON that belongs to these maps")
        table = replace(self, ids={0: 0, **self.segments[path.name]}, segments=None)
        return table._classes(read_segments(path, max_size), path)

    def _classes(self, values: Int32[np.ndarray, "H W"], path: Path) -> Int32[np.ndarray, "H W"]:
        ids = {0: 0, **{value: value for value in self.names}} if self.ids is None else self.ids
        present, index = np.unique(values, return_inverse=True)
        unknown = [int(value) for value in present if int(value) not in ids]
        if unknown:
            raise InputError(
                f"label map '{path}' holds {unknown[0]}, which '{self.choice}' does not know; choose the --label-names "
                f"that the maps are written in: {', '.join(DESCRIPTIONS)}, or a file"
            )
        return np.array([ids[int(value)] for value in present], np.int32)[index].reshape(values.shape)

    def name_of(self, label: int) -> str:
        """What a label of a decoded map is called."""
        return self.names.get(label if label in self.names else label // INSTANCES, "")


def find_table(choice: str, folder: Path = Path()) -> LabelTable:
    """The table of a name, or of a file: ScanNet's labels (.tsv) or COCO's panoptic annotations (.json).

    Args: folder: where the file is looked for.
    Raises: OptionError for an unknown name; InputError for a file that is no such table.
    """
    name, _, variant = choice.partition(":")
    suffix = Path(name).suffix.lower()
    if suffix == ".tsv":
        return _scannet(folder / name, choice, variant)
    if suffix == ".json" and not variant:
        return _panoptic(folder / name, choice)
    if name not in DESCRIPTIONS:
        hint = did_you_mean(name, DESCRIPTIONS)
        raise OptionError(
            f"--label-names '{choice}' is unknown; {hint}known: {', '.join(DESCRIPTIONS)}; or a file: ScanNet's "
            "scannetv2-labels.combined.tsv, the JSON of COCO's panoptic maps"
        )
    has_instances = name in ("cityscapes", "kitti360")
    if variant and (variant != APART or not has_instances):
        allowed = f"'{name}' or '{name}:{APART}'" if has_instances else f"'{name}'"
        raise OptionError(f"--label-names '{choice}': expected {allowed}")
    merged = "merged" if has_instances else ""
    names = _names({"coco-stuff": "coco", "seem": "coco", "cityscapes-train": "cityscapes"}.get(name, name))
    return LabelTable(choice=choice, names=names, ids=_written(name, names), instances=variant or merged)


def _written(name: str, names: Mapping[int, str]) -> Mapping[int, int] | None:
    """The class of every value in the maps of a data set, where they are not written in its own ids."""
    nothing = {255: 0}
    if name == "coco-stuff":
        return {label - 1: label for label in range(1, 183)} | nothing
    if name == "seem":
        return dict(enumerate(PANOPTIC)) | nothing
    if name == "cityscapes-train":
        return dict(enumerate(_TRAIN_IDS)) | nothing
    if name == "cityscapes":
        return {0: 0, **{label: label for label in names}} | nothing  # a licence plate is -1, which 8 bits cannot hold
    return None


def _names(name: str) -> dict[int, str]:
    lines = (Path(__file__).parent / f"{name}.txt").read_text(encoding="utf-8").splitlines()
    return {int(number): text for number, text in (line.split("\t") for line in lines)}


def _scannet(path: Path, choice: str, variant: str) -> LabelTable:
    """ScanNet's raw ids, as they are or as classes of NYU40."""
    if variant not in ("", "raw", "nyu40"):
        raise OptionError(
            f"--label-names '{choice}': expected '{path.name}', or '{path.name}:nyu40' to merge into NYU40"
        )
    columns = ("id", "nyu40id", "nyu40class") if variant == "nyu40" else ("id", "id", "raw_category")
    try:
        rows = list(csv.DictReader(_text(path).splitlines(), delimiter="\t", quoting=csv.QUOTE_NONE))
        wanted = [tuple(row[column] for column in columns) for row in rows]
        table = [(int(raw), int(label or 0), name) for raw, label, name in wanted]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"--label-names '{path}' cannot be used ({type(error).__name__}: {error}); expected ScanNet's "
            f"scannetv2-labels.combined.tsv with the columns {', '.join(dict.fromkeys(columns))}"
        ) from error
    return LabelTable(
        choice=choice,
        names={label: name for _, label, name in table if label},
        ids={0: 0, **{raw: label for raw, label, _ in table}},
    )


def _panoptic(path: Path, choice: str) -> LabelTable:
    """COCO's panoptic annotations: PNGs of segment ids, whose classes the JSON tells."""
    try:
        content = json.loads(_text(path))
        names = {int(category["id"]): str(category["name"]) for category in content["categories"]}
        segments = {
            PurePosixPath(image["file_name"]).with_suffix(".png").name: {
                int(segment["id"]): int(segment["category_id"]) for segment in image["segments_info"]
            }
            for image in content["annotations"]
        }
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"--label-names '{path}' cannot be used ({type(error).__name__}: {error}); expected the JSON of COCO's "
            "panoptic maps, with annotations (file_name, segments_info) and categories"
        ) from error
    return LabelTable(choice=choice, names=names, segments=segments)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"--label-names '{path}' cannot be read ({error.strerror}); check the name") from error
