"""Make COLMAP's database of a collection: its images with their cameras, rigs and frames."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pycolmap

from sgam_core.errors import InputError, OptionError
from sgam_sfm.colmap.camera_files import read_cameras
from sgam_sfm.colmap.cameras import CameraInfo, KnownCamera, camera_parameters
from sgam_sfm.colmap.database import backup, replacing_database
from sgam_sfm.colmap.reading import quiet
from sgam_sfm.colmap.rigs import Rigs, apply_rigs, read_rigs
from sgam_sfm.nearest import unknown

CAMERA_MODES = ("auto", "single", "per-folder", "per-image")


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraOptions:
    """How images get their cameras; the defaults are COLMAP's own.

    model: a COLMAP camera model. params: its parameters for all images ("f,cx,cy,k" or numbers), None for the EXIF
    focal length or COLMAP's guess of 1.2 * max(width, height). mode: which images share a camera: auto (COLMAP's
    choice), single, per-folder, per-image. cameras: a file or COLMAP model with known cameras, see `read_cameras`; the
    images it does not name follow the other options. rigs: COLMAP's rig configuration; images of one of its prefixes
    share a camera. database: an existing one; the images it has keep their cameras.
    """

    model: str = "SIMPLE_RADIAL"
    params: str | tuple[float, ...] | None = None
    mode: str = "auto"
    cameras: Path | None = None
    rigs: Path | None = None
    database: Path | None = None

    def __post_init__(self) -> None:
        if self.rigs is not None and self.database is not None:
            raise OptionError("--rigs would change the rigs of --database; apply them there with COLMAP, leave one out")
        if self.mode not in CAMERA_MODES:
            raise OptionError(unknown("camera mode", self.mode, CAMERA_MODES))
        try:
            object.__setattr__(self, "params", camera_parameters(self.model, self.params))
        except ValueError as error:
            raise OptionError(str(error)) from error


@dataclass(frozen=True, kw_only=True, slots=True)
class ImportedImages:
    """What COLMAP made of the images. cameras: by image name. failures: why an image could not be imported."""

    cameras: Mapping[str, CameraInfo]
    failures: Mapping[str, str]

    @property
    def known_camera_ids(self) -> tuple[int, ...]:
        """Cameras that the user gave, which mapping holds fixed unless asked otherwise."""
        return tuple(sorted({info.camera_id for info in self.cameras.values() if info.known}))


def import_cameras(
    database_path: Path, image_folder: Path, names: Sequence[str], options: CameraOptions | None = None
) -> ImportedImages:
    """Make a new database with the images, their cameras, rigs and frames, and GPS positions from EXIF.

    An existing database is replaced. Image ids do not depend on the order of `names`. When the options name a database,
    the new one is a copy of it, with the images that it does not have.

    Raises: InputError when a known camera does not have the size of its image or is not the one that the options'
        database has for it, or the cameras cannot be read.
    """
    options = options or CameraOptions()
    known = read_cameras(options.cameras, names) if options.cameras else {}
    rigs = read_rigs(options.rigs, names) if options.rigs else None
    with replacing_database(database_path) as partial:
        if options.database is not None:
            backup(options.database, partial)
        with pycolmap.Database.open(partial) as database:
            there = {image.name for image in database.read_all_images()}.intersection(names)
        for group, mode, model, params in _import_groups(
            [name for name in names if name not in there], known, options, rigs
        ):
            reader = pycolmap.ImageReaderOptions()
            reader.camera_model, reader.camera_params = model, ",".join(map(repr, params or ()))
            with quiet():  # what COLMAP would print about unreadable images is returned as failures
                pycolmap.import_images(partial, image_folder, mode, group, reader)
        known_names = {*known} if options.params is None else {*names}
        if rigs is not None:
            apply_rigs(partial, rigs)
            known_names |= rigs.with_given_camera(names)
        cameras = _read_cameras_of_images(partial, names, known_names)
        for name in sorted(there):
            _refuse_another(name, cameras[name], known.get(name), options)
        failures, sizes = _failures(image_folder, sorted({*names} - {*cameras}))
        sizes |= {name: (info.width, info.height) for name, info in cameras.items()}
        for name, given in known.items():
            if name in sizes and sizes[name] != (given.width, given.height):
                raise InputError(
                    f"the camera of '{name}' in {options.cameras} is {given.width}x{given.height} but the image is "
                    f"{sizes[name][0]}x{sizes[name][1]} (width x height); give the camera of the image as it is"
                )
    return ImportedImages(cameras=cameras, failures=failures)


def _import_groups(
    names: Sequence[str], known: Mapping[str, KnownCamera], options: CameraOptions, rigs: Rigs | None
) -> Iterator[tuple[list[str], pycolmap.CameraMode, str, Sequence[float] | None]]:
    """Images that are imported together: names, camera mode, model and parameters."""
    single = pycolmap.CameraMode.SINGLE
    by_camera: dict[tuple[KnownCamera, str], list[str]] = {}
    by_folder: dict[str, list[str]] = {}
    by_prefix: dict[str, list[str]] = {}
    for name in sorted(names):
        prefix = rigs.prefix_of(name) if rigs else ""  # its images share a camera, even if another has equal parameters
        if name in known:
            by_camera.setdefault((known[name], prefix), []).append(name)
        elif prefix:
            by_prefix.setdefault(prefix, []).append(name)
        else:
            # COLMAP's own per-folder mode gives images that sort after a subfolder that subfolder's camera.
            folder = str(PurePosixPath(name).parent) if options.mode == "per-folder" else ""
            by_folder.setdefault(folder, []).append(name)
    mode = {
        "auto": pycolmap.CameraMode.AUTO,
        "single": single,
        "per-folder": single,
        "per-image": pycolmap.CameraMode.PER_IMAGE,
    }[options.mode]
    for group in by_folder.values():
        yield group, mode, options.model, options.params  # type: ignore[misc]
    for group in by_prefix.values():
        yield group, single, options.model, options.params  # type: ignore[misc]
    for (camera, _), group in by_camera.items():
        yield group, single, camera.model, camera.params


def _refuse_another(name: str, info: CameraInfo, listed: KnownCamera | None, options: CameraOptions) -> None:
    """A camera that was given for an image must be the one that the existing database has for it."""
    given = (listed.model, listed.params) if listed else (options.model, options.params)
    if given[1] is not None and given != (info.model, info.params):
        raise InputError(
            f"the camera of '{name}' is {info.model} {','.join(map(str, info.params))} in {options.database}, but "
            f"{given[0]} {','.join(map(str, given[1]))} was given; leave out --cameras or --camera-params for images "
            "that the database has"
        )


def _read_cameras_of_images(path: Path, names: Collection[str], known: Collection[str]) -> dict[str, CameraInfo]:
    with pycolmap.Database.open(path) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        images = sorted(database.read_all_images(), key=lambda image: image.name)
    names = frozenset(names)
    return {
        image.name: CameraInfo(
            image_id=image.image_id,
            camera_id=image.camera_id,
            model=cameras[image.camera_id].model_name,
            params=tuple(map(float, cameras[image.camera_id].params)),
            width=cameras[image.camera_id].width,
            height=cameras[image.camera_id].height,
            has_prior_focal=cameras[image.camera_id].has_prior_focal_length,
            known=image.name in known,
        )
        for image in images
        if image.name in names
    }


def _failures(image_folder: Path, names: Sequence[str]) -> tuple[dict[str, str], dict[str, tuple[int, int]]]:
    """Why COLMAP left out these images, and the sizes (width, height) of those it can read."""
    reasons, sizes = {}, {}
    for name in names:
        bitmap = pycolmap.Bitmap.read(image_folder / name, True)
        if bitmap is None:
            reasons[name] = "COLMAP cannot read this file; save the image as JPEG or PNG"
        else:
            sizes[name] = (bitmap.width, bitmap.height)
            reasons[name] = (
                f"it is {bitmap.width}x{bitmap.height} (width x height), another size than the images it would share "
                "a camera with; use --camera-mode auto or per-image"
            )
    return reasons, sizes
