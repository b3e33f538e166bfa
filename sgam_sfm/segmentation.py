"""Label maps of a folder of photos, with overlays to look at."""

from __future__ import annotations

from pathlib import Path

import PIL.Image

from sgam_core.errors import InputError
from sgam_sfm.files import replacing
from sgam_sfm.images import ImageFile, read_image, read_label_map
from sgam_sfm.inputs import read_images
from sgam_sfm.label_maps import create_segmenter, write_label_maps
from sgam_sfm.label_set import LabelSet
from sgam_sfm.machine import use_threads
from sgam_sfm.options import SegmentOptions
from sgam_sfm.pictures.overlay import draw_labels
from sgam_sfm.progress import Stages


def segment_collection(options: SegmentOptions, stages: Stages) -> LabelSet:
    """Write the label maps of all images at their size, overlays, and labels.json.

    Raises: SGAMError for what cannot be used at all; single images that fail are named in the result.
    """
    use_threads(options.threads)
    segmenter = create_segmenter(options, options.output / "cache")
    found = read_images(options.images, options.output, stages, options.max_image_size)
    if not found.images:
        raise InputError(f"no image in '{options.images}' can be used: {min(found.failed.values())}")
    name = "labels" if options.labels else options.segmenter
    labels = write_label_maps(
        segmenter, name, found.images, options.output, stages, full_size=True, ignored=options.ignore_labels
    )
    if options.overlay_size:
        drawn = [image for name, image in found.images.items() if name not in labels.failed]
        with stages.stage("Drawing overlays", len(drawn)) as advance:
            for image in drawn:
                _write_overlay(image, labels, options.output, options.overlay_size)
                advance(1)
    return labels


def _write_overlay(image: ImageFile, labels: LabelSet, folder: Path, long_side: int) -> None:
    names = {label.id: label.name for label in labels.labels}
    ids = read_label_map(folder / f"{image.name}.png", max(image.width, image.height))
    picture = draw_labels(read_image(image), ids, names, long_side)
    with replacing(folder / "overlays" / f"{image.name}.jpg") as partial:
        PIL.Image.fromarray(picture).save(partial, format="JPEG", quality=88)
