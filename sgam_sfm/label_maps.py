"""Label maps of a collection: made once, kept in OUT/labels at the size that areas are described at."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int32
from PIL import Image as PillowImage

from sgam_core import layout_labels
from sgam_core.errors import InputError
from sgam_sfm import registry
from sgam_sfm.files import replacing, write_json
from sgam_sfm.images import ImageFile, read_label_map
from sgam_sfm.options import MatchOptions
from sgam_sfm.progress import Stages
from sgam_sfm.segmenters.protocol import Segmenter


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelMaps:
    """Where the label maps are. failed: images without one, and why. facts: what the segmenter reports of itself."""

    folder: Path
    failed: Mapping[str, str]
    facts: Mapping[str, object]

    def read(self, name: str) -> Int32[np.ndarray, "H W"]:
        """The label map of an image that is not among the failed."""
        return read_label_map(self.folder / f"{name}.png")


def make_label_maps(options: MatchOptions, images: Mapping[str, ImageFile], stages: Stages) -> LabelMaps:
    """Segment the collection, or take what an earlier start of this run has made."""
    folder = options.output / "labels"
    record = folder / "labels.json"
    if not record.exists():
        segmenter: Segmenter = registry.create(
            "segmenter",
            "labels" if options.labels else options.segmenter,
            folder=options.labels,
            device=options.device,
            threads=options.threads,
            seed=options.seed,
            num_labels=options.num_labels or None,
            cache_folder=options.output / "cache",
        )
        failed: dict[str, str] = {}
        with stages.stage("Segmenting images", len(images)) as advance:
            for file, labels in segmenter.segment(tuple(images.values()), advance):
                if isinstance(labels, Exception):
                    failed[file.name] = str(labels)
                else:
                    _write_label_map(folder / f"{file.name}.png", file.name, layout_labels(labels))
        write_json(record, {"failed": failed, "facts": _facts(segmenter)})
    content = json.loads(record.read_text(encoding="utf-8"))
    return LabelMaps(folder=folder, failed=content["failed"], facts=content["facts"])


def _facts(segmenter: Segmenter) -> dict[str, object]:
    """What a segmenter that learns its labels tells of them."""
    names = ("num_labels_chosen", "stability")
    return {name: getattr(segmenter, name) for name in names if hasattr(segmenter, name)}


def _write_label_map(path: Path, name: str, labels: Int32[np.ndarray, "H W"]) -> None:
    largest = int(labels.max())
    if largest > 65535:
        raise InputError(f"labels of '{name}' go up to {largest}; expected ids of at most 16 bits (65535)")
    depth = np.uint8 if largest < 256 else np.uint16
    with replacing(path) as partial:
        PillowImage.fromarray(labels.astype(depth)).save(partial, format="PNG")
