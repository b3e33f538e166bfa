"""What a run works on: the images that can be used, their cameras, and the pairs among them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sgam_core.errors import InputError, OptionError
from sgam_core.wording import counted
from sgam_sfm.colmap.appending import require_no_descriptors
from sgam_sfm.colmap.cameras import CameraInfo
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.images import MAX_IMAGE_SIZE, ImageFile, image_format, inspect_image, list_images, printable, read_mask
from sgam_sfm.nearest import listing
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import PairList, all_pairs, read_pairs, set_aside
from sgam_sfm.progress import Stages

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class Inputs:
    """What a run works on.

    images: those that the pairs name, by name. cameras: one for each. failed: images that cannot be used, and why.
    num_other_files: files in the folder that are no images. pairs: those to match, and counts of what was left out.
    num_same_content: usable images of the folder whose file equals another one's byte by byte.
    """

    images: Mapping[str, ImageFile]
    cameras: Mapping[str, CameraInfo]
    failed: Mapping[str, str]
    num_other_files: int
    pairs: PairList
    num_same_content: int = 0

    @property
    def digests(self) -> dict[str, str]:
        """Of the images' files, by name."""
        return {name: file.digest for name, file in self.images.items()}


def read_inputs(options: MatchOptions, stages: Stages) -> Inputs:
    """Decode the images, read or make the pair list, import the cameras into OUT/cameras.db.

    Raises: InputError when nothing is left to match; single images that cannot be used are set aside.
    """
    if options.mask_path is not None and not options.mask_path.is_dir():
        raise InputError(f"--mask-path '{options.mask_path}' does not exist; give the folder that holds <name>.png")
    cameras = CameraOptions(
        model=options.camera_model,
        params=options.camera_params or None,
        mode=options.camera_mode,
        cameras=options.cameras,
        rigs=options.rigs,
        database=options.database,
    )
    listed = None
    if options.pairs is not None:  # before the images are decoded, which takes longer
        names, _ = list_images(options.images)
        listed = read_pairs(options.pairs, tuple(map(printable, names)))
    found = read_images(options.images, options.output, stages, options.max_image_size, options.mask_path)
    images, failed = found.images, found.failed
    num_listed = len(images) + len(failed)
    _check_any(images, failed, options.images)
    with stages.stage("Reading cameras", None):
        imported = import_cameras(options.output / "cameras.db", options.images, tuple(images), cameras)
    for name, reason in imported.failures.items():
        failed[name] = f"'{name}' ({image_format(images[name].path)}): {reason}"
        del images[name]
        _log.warning("%s", failed[name])
    if options.database is not None:
        _check_existing(options.database, images, imported.cameras)
        if not options.append:
            require_no_descriptors(options.database, options.output / "cameras.db", images)
    same = same_content(images.values())
    if same:
        _log.warning("%d images have the same content as another, such as '%s' and '%s'", len(same), *same[:2])
    _check_any(images, failed, options.images)
    pairs = set_aside(listed, failed) if listed else PairList(pairs=all_pairs(tuple(images)))
    if not pairs.pairs:
        why = "each listed pair names another one" if options.pairs else "a pair needs two"
        raise InputError(
            f"no pair to match: {len(images)} of {num_listed} images in '{options.images}' can be used, and {why}"
        )
    used = {name for pair in pairs.pairs for name in pair}
    if unused := sorted(images.keys() - used):
        _log.warning("in no pair, so without a pose: %d of %d images, %s", len(unused), len(images), listing(unused))
    return Inputs(
        images={name: file for name, file in images.items() if name in used},
        cameras=imported.cameras,
        failed=failed,
        num_other_files=found.num_other_files,
        pairs=pairs,
        num_same_content=len(same),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class FoundImages:
    """The images of a folder: those that can be used, and why others cannot; how many files are no images."""

    images: dict[str, ImageFile]
    failed: dict[str, str]
    num_other_files: int


def read_images(
    folder: Path, output: Path, stages: Stages, max_size: int = MAX_IMAGE_SIZE, mask_path: Path | None = None
) -> FoundImages:
    """Decode every image of a folder once, and its mask.

    Args: max_size: in pixels; images with a longer side are not decoded, and count as failed. mask_path: the folder of
        masks; an image whose mask cannot be used counts as failed.
    Raises: OptionError when results would go into the folder; InputError when it holds no image, or the other no mask.
    """
    refuse_among_images(output, folder)
    names, num_other_files = list_images(folder)
    images: dict[str, ImageFile] = {}
    failed: dict[str, str] = {}
    without_mask: list[str] = []
    with stages.stage("Reading images", len(names)) as advance:
        for name in names:
            try:
                image = inspect_image(folder, name, max_size)
                if mask_path is not None and read_mask(mask_path, image) is None:
                    without_mask.append(name)
                images[name] = image
            except InputError as error:
                failed[printable(name)] = str(error)
                _log.warning("%s", error)
            advance(1)
    if mask_path is not None and without_mask:
        _tell_of_masks(mask_path, without_mask, len(images))
    return FoundImages(images=images, failed=failed, num_other_files=num_other_files)


def _tell_of_masks(mask_path: Path, without: Sequence[str], num_images: int) -> None:
    """Say which images have no mask. Raises: InputError when none has one."""
    name = next((name for name in without if (mask_path / name).with_suffix(".png").exists()), without[0])
    named_otherwise = (mask_path / name).with_suffix(".png")
    hint = f"; '{named_otherwise.name}' is there, and must be renamed" if named_otherwise.exists() else ""
    expected = f"COLMAP's name for the mask of '{name}' is '{name}.png'{hint}"
    if len(without) == num_images:
        raise InputError(f"--mask-path '{mask_path}' holds no mask of {counted(num_images, 'image')}; {expected}")
    _log.warning("no mask in '%s' for %d of %d images; %s", mask_path, len(without), num_images, expected)


def _check_existing(database: Path, images: Mapping[str, ImageFile], cameras: Mapping[str, CameraInfo]) -> None:
    for name, file in images.items():
        camera = cameras[name]
        if (camera.width, camera.height) != (file.width, file.height):
            raise InputError(
                f"'{name}' is {camera.width}x{camera.height} in --database '{database}' but {file.width}x{file.height} "
                "(width x height) in the image folder; give the images that the database was made from"
            )


def _check_any(images: Mapping[str, ImageFile], failed: Mapping[str, str], folder: Path) -> None:
    if not images:
        raise InputError(f"none of the {len(failed)} images in '{folder}' can be used: {min(failed.values())}")


def refuse_among_images(output: Path, folder: Path, flag: str = "--output") -> None:
    """Results among the images would be taken for images. Raises: OptionError, which names the flag."""
    if output.resolve().is_relative_to(folder.resolve()):
        raise OptionError(f"{flag} '{output}' lies in the image folder; choose one outside of it")


def same_content(images: Iterable[ImageFile]) -> tuple[str, ...]:
    """The names of images whose files are equal, equal ones side by side."""
    names: dict[str, list[str]] = {}
    for image in images:
        names.setdefault(image.digest, []).append(image.name)
    return tuple(name for group in names.values() if len(group) > 1 for name in group)
