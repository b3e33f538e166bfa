"""Label maps of a collection: made by a segmenter, kept as PNG with a labels.json, read back by image name."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int32
from PIL import Image as PillowImage

from sgam_core import layout_labels
from sgam_core.errors import InputError, OptionError, SGAMError, StageError
from sgam_sfm import registry
from sgam_sfm.colours import distinct_colour
from sgam_sfm.external import WorkerCommand
from sgam_sfm.files import disk_is_full, replacing, write_json
from sgam_sfm.images import ImageFile, read_label_map
from sgam_sfm.label_set import RECORD, Label, LabelSet, at_size_of, read_label_set
from sgam_sfm.logs import in_one_line
from sgam_sfm.machine import find_device, out_of_memory
from sgam_sfm.options import MatchOptions, SegmentOptions, fingerprint_of_labels
from sgam_sfm.progress import Stages
from sgam_sfm.segmenters.protocol import Segmenter, fault_of

_log = logging.getLogger(__name__)
_PNG_END = b"IEND\xaeB`\x82"
_MAX_LABELS_OF_IMAGE = 1000  # areas are counted label by label


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelMaps:
    """The label maps of a collection, as they are on disk."""

    folder: Path
    set: LabelSet

    def read(self, name: str) -> Int32[np.ndarray, "H W"]:
        """The label map of an image that is not among the failed."""
        return read_label_map(self.folder / f"{name}.png")

    def mask(self, image: ImageFile, without: Collection[int]) -> Bool[np.ndarray, "H W"] | None:
        """Where the image (H, W) has none of these labels; None when it has no label map or no label is given."""
        if not without or image.name in self.set.failed:
            return None
        return at_size_of(image, np.isin(self.read(image.name), tuple(without), invert=True).astype(np.uint8)).astype(
            bool
        )


def segmenter_of_run(options: MatchOptions) -> Segmenter | None:
    """The segmenter that a run begins with, None when it has made its label maps already."""
    made = (options.output / "labels" / RECORD).exists()
    return None if made else create_segmenter(options, options.output / "cache")


def make_label_maps(
    options: MatchOptions, images: Mapping[str, ImageFile], stages: Stages, segmenter: Segmenter | None = None
) -> LabelMaps:
    """The label maps of a run in OUT/labels, at the size that areas are described at; made once for the same options.

    Args: segmenter: of these options; where there is none, it is made when it is needed.
    """
    folder = options.output / "labels"
    mark = fingerprint_of_labels(options, images={name: file.digest for name, file in images.items()})
    if not _are_whole(folder, images, mark):
        segmenter = segmenter or create_segmenter(options, options.output / "cache")
        name = "labels" if options.labels else options.segmenter
        write_label_maps(segmenter, name, images, folder, stages, full_size=False, made_from=mark)
    return LabelMaps(folder=folder, set=read_label_set(folder))


def _are_whole(folder: Path, images: Collection[str], mark: str) -> bool:
    """Whether label maps have been made from the same, and the disk has kept all of them."""
    if not (folder / RECORD).exists():
        return False
    try:
        made = read_label_set(folder)
        if made.made_from != mark:
            return False
        failed = made.failed
        for name in images:
            if name not in failed:
                with (folder / f"{name}.png").open("rb") as file:
                    file.seek(-len(_PNG_END), os.SEEK_END)
                    if file.read() != _PNG_END:
                        raise InputError(f"'{file.name}' is cut short")
    except (OSError, InputError) as error:
        _log.warning("label maps are damaged (%s), and are made again", error)
        return False
    return True


def create_segmenter(options: MatchOptions | SegmentOptions, cache_folder: Path) -> Segmenter:
    """The segmenter of the options: a folder of maps when --labels is given.

    Raises: SGAMError when it cannot be made; OptionError when maps are described that are not given, or when a label is
        named that it does not know, or when its labels have no names.
    """
    if options.label_names and not options.labels:
        raise OptionError(f"--label-names '{options.label_names}' says how --labels are written; give --labels too")
    segmenter: Segmenter = registry.create(
        "segmenter",
        "labels" if options.labels else options.segmenter,
        folder=options.labels,
        resize=options.resize_labels,
        label_names=options.label_names,
        device=str(find_device(options.device, "--device")),
        threads=options.threads,
        seed=options.seed,
        num_labels=options.num_labels or None,
        cache_folder=cache_folder,
        worker=WorkerCommand.of(options, "segmenter", options.segmenter),
    )
    name = "labels" if options.labels else options.segmenter
    known = replace(getattr(segmenter, "label_set", LabelSet()), segmenter=name)
    for flag in ("ignore_labels", "mask_matches"):
        known.require_names(getattr(options, flag, ""), f"--{flag.replace('_', '-')}")
    return segmenter


def write_label_maps(
    segmenter: Segmenter,
    name: str,
    images: Mapping[str, ImageFile],
    folder: Path,
    stages: Stages,
    *,
    full_size: bool,
    ignored: str = "",
    made_from: str = "",
) -> LabelSet:
    """Segment the collection; labels.json, written last, says that it is whole.

    Args: name: of the segmenter. full_size: at the size of the images, else at the size that areas are described at
        (of which the full size is an exact enlargement, where the image is not smaller). ignored: names or ids.
        made_from: see `LabelSet`.
    """
    failed: dict[str, str] = {}
    pixels: Counter[int] = Counter()
    usable: set[str] = set()
    with stages.stage("Segmenting images", len(images)) as advance:
        for file, made in _segmented(segmenter, images, advance):
            if reason := _unusable(file, made, type(segmenter).__name__):
                failed[file.name] = reason
                _log.warning("%s", reason)
                continue
            made = np.asarray(made, np.int32)
            labels = layout_labels(made)
            counts = dict(zip(*(part.tolist() for part in np.unique(labels, return_counts=True)), strict=True))
            if len(counts) > _MAX_LABELS_OF_IMAGE:
                failed[file.name] = (
                    f"label map of '{file.name}' has {len(counts)} different ids; expected at most "
                    f"{_MAX_LABELS_OF_IMAGE}: give ids of kinds of things, not of single pixels or objects"
                )
                continue
            pixels.update(counts)
            _write_label_map(folder / f"{file.name}.png", at_size_of(file, made) if full_size else labels)
            usable.add(file.name)
    for missing in images.keys() - failed.keys() - usable:
        failed[missing] = f"the segmenter {type(segmenter).__name__} gave nothing for '{missing}'"
    if images and not usable:
        raise InputError(f"none of the {len(images)} images has a label map that can be used: {min(failed.items())[1]}")
    given: LabelSet = getattr(segmenter, "label_set", LabelSet())
    known = {label.id: label for label in given.labels}
    total = max(sum(pixels.values()), 1)
    # Labels that no image has are kept with their names: to mask cars is no mistake where there are none.
    labels_known = tuple(
        Label(
            id=label_id,
            name=known[label_id].name if label_id in known else "",
            colour="#{:02x}{:02x}{:02x}".format(*distinct_colour(label_id)),
            share=round(pixels[label_id] / total, 6),
        )
        for label_id in sorted({*pixels, *known} - {0})
    )
    everything = LabelSet(segmenter=name, labels=labels_known)
    found = LabelSet(
        segmenter=name,
        labels=labels_known,
        ignored=tuple(sorted({*given.ignored, *everything.ids(ignored, "--ignore-labels")})),
        failed=failed,
        facts=_facts(segmenter),
        made_from=made_from,
    )
    write_json(folder / RECORD, asdict(found))
    return read_label_set(folder)


def _segmented(
    segmenter: Segmenter, images: Mapping[str, ImageFile], advance: Callable[[float], None]
) -> Iterator[tuple[ImageFile, object]]:
    """What a segmenter gives for each image. Raises: StageError for a fault in it, somebody's plugin or not."""
    name = type(segmenter).__name__
    try:
        for given in segmenter.segment(tuple(images.values()), advance):
            if not (isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], ImageFile)):
                raise StageError(f"the segmenter {name} gave {type(given).__name__}; expected (image, label map)")
            yield given
    except Exception as error:
        if isinstance(error, SGAMError) or disk_is_full(error) or out_of_memory(error):
            raise
        _log.info("the segmenter %s failed", name, exc_info=error)
        raise StageError(f"the segmenter {name} failed: {in_one_line(error)}; the log has the traceback") from error


def _facts(segmenter: Segmenter) -> dict[str, object]:
    """What a segmenter that learns its labels tells of them."""
    names = ("num_labels_chosen", "stability")
    return {name: getattr(segmenter, name) for name in names if hasattr(segmenter, name)}


def _unusable(file: ImageFile, made: object, segmenter: str) -> str:
    """Why what a segmenter gave for an image is no label map of it; empty when it is one."""
    if isinstance(made, Exception):
        return str(made)
    fault = fault_of(made, file)
    return f"the segmenter {segmenter} {fault}" if fault else ""


def _write_label_map(path: Path, labels: Int32[np.ndarray, "H W"]) -> None:
    depth = np.uint8 if int(labels.max()) < 256 else np.uint16
    with replacing(path) as partial:
        PillowImage.fromarray(labels.astype(depth)).save(partial, format="PNG")
