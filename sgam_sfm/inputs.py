"""What a run works on: the images that can be used, their cameras, and the pairs among them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from sgam_core.errors import InputError, OptionError
from sgam_sfm.database import CameraInfo, CameraOptions, import_cameras
from sgam_sfm.images import ImageFile, inspect_image, list_images
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import PairList, all_pairs, read_pairs
from sgam_sfm.progress import Stages

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class Inputs:
    """What a run works on.

    images: those that the pairs name, by name. cameras: one for each. failed: images that cannot be used, and why.
    num_other_files: files in the folder that are no images. pairs: those to match, and counts of what was left out.
    """

    images: Mapping[str, ImageFile]
    cameras: Mapping[str, CameraInfo]
    failed: Mapping[str, str]
    num_other_files: int
    pairs: PairList


def read_inputs(options: MatchOptions, stages: Stages) -> Inputs:
    """Decode the images, read or make the pair list, import the cameras into OUT/cameras.db.

    Raises: InputError when nothing is left to match; single images that cannot be used are set aside.
    """
    for flag, folder in (("--mask-path", options.mask_path), ("--labels", options.labels)):
        if folder is not None and not folder.is_dir():
            raise InputError(f"{flag} '{folder}' does not exist; give the folder that holds <image name>.png")
    if options.output.resolve().is_relative_to(options.images.resolve()):
        raise OptionError(f"--output '{options.output}' lies in the image folder; choose one outside of it")
    names, num_other_files = list_images(options.images)
    images: dict[str, ImageFile] = {}
    failed: dict[str, str] = {}
    with stages.stage("Reading images", len(names)) as advance:
        for name in names:
            try:
                images[name] = inspect_image(options.images, name)
            except InputError as error:
                failed[name] = str(error)
            advance(1)
        imported = import_cameras(
            options.output / "cameras.db",
            options.images,
            tuple(images),
            CameraOptions(
                model=options.camera_model,
                params=options.camera_params or None,
                mode=options.camera_mode,
                cameras=options.cameras,
            ),
        )
    for name, reason in imported.failures.items():
        failed[name] = f"'{name}': {reason}"
        del images[name]
    for reason in failed.values():
        _log.warning("%s", reason)
    if not images:
        raise InputError(f"none of the {len(names)} images in '{options.images}' can be used: {min(failed.values())}")
    if options.pairs is None:
        pairs = PairList(pairs=all_pairs(tuple(images)))
    else:
        pairs = read_pairs(options.pairs, tuple(images), tuple(failed))
    if not pairs.pairs:
        raise InputError(f"no pair to match: {len(images)} of {len(names)} images in '{options.images}' can be used")
    used = {name for pair in pairs.pairs for name in pair}
    return Inputs(
        images={name: file for name, file in images.items() if name in used},
        cameras=imported.cameras,
        failed=failed,
        num_other_files=num_other_files,
        pairs=pairs,
    )
