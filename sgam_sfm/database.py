"""COLMAP's database: import images and cameras, write keypoints and matches.

Pixels have COLMAP's corner origin, as everywhere in this project: nothing is shifted here.
"""

from __future__ import annotations

import logging
import math
import sqlite3
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from jaxtyping import Float

from sgam_core.errors import InputError, OptionError, ShapeError, StageError
from sgam_sfm.colmap_reading import quiet, read_model
from sgam_sfm.files import replacing, require_space
from sgam_sfm.pairs import Pair
from sgam_sfm.rigs import Rigs, apply_rigs, read_rigs

logger = logging.getLogger(__name__)

_SMALLEST_DATABASE = 2**20  # bytes, generously

CAMERA_MODELS = tuple(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
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
            raise OptionError(f"camera mode '{self.mode}' is unknown; choose one of {', '.join(CAMERA_MODES)}")
        try:
            object.__setattr__(self, "params", _parameters(self.model, self.params))
        except ValueError as error:
            raise OptionError(str(error)) from error


@dataclass(frozen=True, kw_only=True, slots=True)
class KnownCamera:
    """A camera that the user gave. folder: whose images share it with no others, empty for any that have equal ones."""

    model: str
    params: tuple[float, ...]
    width: int
    height: int
    folder: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraInfo:
    """An image of the database and its camera.

    has_prior_focal: the focal length is known, from the user or from EXIF. known: the user gave all parameters.
    """

    image_id: int
    camera_id: int
    model: str
    params: tuple[float, ...]
    width: int
    height: int
    has_prior_focal: bool
    known: bool


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
    with _replacing(database_path) as partial:
        if options.database is not None:
            _copy(options.database, partial)
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


def camera_of_info(info: CameraInfo) -> pycolmap.Camera:
    """COLMAP's own form of an image's camera."""
    return pycolmap.Camera(
        model=info.model,
        width=info.width,
        height=info.height,
        params=info.params,
        has_prior_focal_length=info.has_prior_focal,
    )


def camera_matrix(info: CameraInfo) -> Float[np.ndarray, "3 3"] | None:
    """Pinhole matrix (3, 3), corner origin, for the two-view geometry of matching; lens distortion is ignored.

    Returns: None when the focal length is not known, or the lens (fisheye, panorama) is no pinhole even roughly.
    """
    camera = camera_of_info(info)
    if not info.has_prior_focal or not camera.is_perspective_pinhole():
        return None
    return np.asarray(camera.calibration_matrix(), np.float64)


def camera_of_part(
    info: CameraInfo, origin: tuple[int, int], part: tuple[int, int], size: tuple[int, int], turns: int = 0
) -> KnownCamera:
    """The camera of a part of an image, resized, then turned by quarters anticlockwise.

    Args: origin: (x0, y0) of the part in the image. part, size: its (width, height) there and after resizing.
    """
    camera = camera_of_info(info)
    camera.principal_point_x -= origin[0]
    camera.principal_point_y -= origin[1]
    camera.width, camera.height = part
    camera.rescale(*size)
    for _ in range(turns):
        _turn(camera)
    return KnownCamera(
        model=info.model, params=tuple(map(float, camera.params)), width=camera.width, height=camera.height
    )


def _turn(camera: pycolmap.Camera) -> None:
    """Turn a camera anticlockwise by a quarter, in place: (x, y) becomes (y, width - x)."""
    before = dict(zip(camera.params_info.split(", "), map(float, camera.params), strict=True))
    after = before | {"cx": before["cy"], "cy": camera.width - before["cx"]}
    if "fx" in before:
        after |= {"fx": before["fy"], "fy": before["fx"]}
    if "p1" in before:
        after |= {"p1": -before["p2"], "p2": before["p1"]}
    if "sx1" in before:
        after |= {"sx1": before["sy1"], "sy1": -before["sx1"]}
    camera.params = list(after.values())
    camera.width, camera.height = camera.height, camera.width


def write_cameras(path: Path, cameras: Mapping[str, KnownCamera]) -> None:
    """Write cameras by image name to a text file that `read_cameras` reads."""
    lines = (
        f"{name}\t{camera.model} {camera.width} {camera.height} {' '.join(map(repr, camera.params))}\n"
        for name, camera in cameras.items()
    )
    with replacing(path) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def read_cameras(path: Path, names: Sequence[str]) -> dict[str, KnownCamera]:
    """Read known cameras: a text file, or a folder with a COLMAP model (text or binary) whose images have our names.

    A line of the text file is `name MODEL width height params...`, hloc's list of images with intrinsics: the image's
    name, `folder/*` for the images of a folder and its sub-folders, or `*` for every image, where no line is closer to
    it; a tab after a name that contains spaces; `#` comments and blank lines are skipped. Images with equal cameras
    share one, but for those of different `folder/*` lines.

    COLMAP's own cameras.txt is understood too: a single camera is that of all images; which image has which of several
    is read from images.txt beside it.

    Args: names: the images of the collection; cameras of other images are left out, with a warning.
    Raises: InputError when the file or a line cannot be used, or no camera belongs to any of the images.
    """
    cameras = _model_cameras(path) if path.is_dir() else _listed_cameras(path)
    if cameras and all(name.isdecimal() for name in cameras):
        cameras = _numbered_cameras(path, cameras)
    everyone = cameras.pop("*", None)
    folders = {name[:-1]: replace(cameras.pop(name), folder=name[:-1]) for name in sorted(cameras) if name[-2:] == "/*"}
    for name in names:
        within = [folder for folder in folders if name.startswith(folder)]
        if within and name not in cameras:
            cameras[name] = folders[max(within, key=len)]
    others = sorted(set(cameras) - set(names))
    if others:
        logger.warning("%s names %d images that are not in the collection, such as '%s'", path, len(others), others[0])
    chosen = {name: camera for name in names if (camera := cameras.get(name, everyone)) is not None}
    if not chosen:
        raise InputError(
            f"{path} has no camera for any of the {len(names)} images; its names are relative to the image folder"
        )
    return chosen


def write_database(
    path: Path, imported: Path, keypoints: Mapping[str, np.ndarray], matches: Mapping[Pair, np.ndarray]
) -> None:
    """Write a database that is ready to be verified and mapped; it appears at `path` only when it is complete.

    Arrays are asked for one at a time.

    Args: imported: database of `import_cameras`, whose images and cameras are copied (it may be `path` itself).
        keypoints: (N, 2) pixels by image name, corner origin; an image left out gets none. matches: (M, 2) indices of
        keypoints by pair, one-to-one.
    Raises: ShapeError when an array has another shape, an index is out of range or used twice; InputError when a name
        is not in the database.
    """
    with changing_copy(imported, path) as database:
        database.clear_two_view_geometries()
        database.clear_matches()
        database.clear_descriptors()
        database.clear_keypoints()
        ids = {image.name: image.image_id for image in database.read_all_images()}
        unknown = ({*keypoints} | {name for pair in matches for name in pair}) - {*ids}
        if unknown:
            raise InputError(f"image '{min(unknown)}' is not in {imported}; import its camera first")
        counts = dict.fromkeys(ids, 0)
        with pycolmap.DatabaseTransaction(database):
            for name, image_id in sorted(ids.items(), key=lambda item: item[1]):
                points = keypoints.get(name, np.zeros((0, 2), np.float32))
                check_keypoints(name, points)
                counts[name] = len(points)
                database.write_keypoints(image_id, np.ascontiguousarray(points, np.float32))
            for pair in sorted(matches, key=lambda pair: sorted(ids[name] for name in pair)):
                if pair[::-1] in matches:
                    raise InputError(f"the pair {pair} has matches in both directions; give them in one")
                indices = matches[pair]
                check_matches(pair, indices, (counts[pair[0]], counts[pair[1]]))
                database.write_matches(ids[pair[0]], ids[pair[1]], np.ascontiguousarray(indices, np.uint32))


@contextmanager
def changing_copy(source: Path, target: Path) -> Iterator[pycolmap.Database]:
    """A copy of a database to change; it takes the place of `target` (which may be the source) when all went well."""
    with _replacing(target) as partial:
        _copy(source, partial)
        with pycolmap.Database.open(partial) as database:
            yield database


def _parameters(model: str, params: str | Sequence[float | str] | None) -> tuple[float, ...] | None:
    """The parameters as numbers. Raises: ValueError, with a message for users, when they do not fit the model."""
    if model not in CAMERA_MODELS:
        raise ValueError(f"camera model '{model}' is unknown; choose one of {', '.join(CAMERA_MODELS)}")
    if params is None:
        return None
    texts = [text for text in params.split(",") if text.strip()] if isinstance(params, str) else list(params)
    expected = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2)
    given = ",".join(map(str, texts))
    if len(texts) != len(expected.params):
        raise ValueError(
            f"camera model {model} has {len(expected.params)} parameters ({expected.params_info}) but {len(texts)} "
            f"were given: '{given}'"
        )
    try:
        values = tuple(map(float, texts))
    except ValueError:
        values = (math.nan,)
    if not all(map(math.isfinite, values)):
        raise ValueError(f"camera parameters '{given}' of {model} ({expected.params_info}) are not all numbers")
    return values


def _model_cameras(folder: Path) -> dict[str, KnownCamera]:
    model = read_model(folder)
    cameras = {
        camera_id: KnownCamera(
            model=camera.model_name,
            params=tuple(map(float, camera.params)),
            width=camera.width,
            height=camera.height,
        )
        for camera_id, camera in model.cameras.items()
    }
    return {image.name: cameras[image.camera_id] for image in model.images.values()}


def _listed_cameras(path: Path) -> dict[str, KnownCamera]:
    try:
        lines = path.read_text(encoding="utf-8-sig").split("\n")
    except OSError as error:
        raise InputError(f"cannot read the cameras in {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"the cameras in {path} are neither UTF-8 text nor a folder with a COLMAP model") from error
    cameras: dict[str, KnownCamera] = {}
    for number, line in enumerate(map(str.strip, lines), start=1):
        if not line or line.startswith("#"):
            continue
        name, _, rest = line.partition("\t") if "\t" in line else line.partition(" ")
        fields = rest.split()
        try:
            if len(fields) < 3 or not (fields[1].isdecimal() and fields[2].isdecimal()):
                raise ValueError("expected 'name MODEL width height params...', a tab after a name with spaces")
            if name in cameras:
                raise ValueError(f"'{name}' has a camera already")
            params = _parameters(fields[0], tuple(fields[3:]))
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}") from error
        cameras[name] = KnownCamera(model=fields[0], params=params or (), width=int(fields[1]), height=int(fields[2]))
    return cameras


def _numbered_cameras(path: Path, cameras: Mapping[str, KnownCamera]) -> dict[str, KnownCamera]:
    """The cameras of COLMAP's cameras.txt by image name."""
    if len(cameras) == 1:
        return {"*": next(iter(cameras.values()))}
    images = path.with_name("images.txt")
    if not images.is_file():
        raise InputError(
            f"{path} has {len(cameras)} cameras, and no images.txt beside it says which image has which; put it there, "
            "or write lines `name MODEL width height params...` with names, `folder/*` or `*`"
        )
    named = {}
    lines = [line for line in images.read_text(encoding="utf-8-sig").splitlines() if not line.startswith("#")]
    for line in filter(str.strip, lines[::2]):  # a line of points, which may be empty, follows each
        fields = line.split(maxsplit=9)
        if len(fields) != 10 or fields[8] not in cameras:
            raise InputError(
                f"{images}: '{line}' names no camera of {path}; expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            )
        named[fields[9].strip()] = cameras[fields[8]]
    return named


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


def check_keypoints(name: str, points: np.ndarray) -> None:
    """Raises: ShapeError for anything but finite pixels (N, 2)."""
    # COLMAP accepts more columns than it documents and ends the process when it verifies them.
    if points.ndim != 2 or points.shape[1] != 2 or points.dtype.kind != "f":
        raise ShapeError(f"keypoints of '{name}' are {points.dtype} {points.shape}; expected float32 (N, 2)")
    if not np.isfinite(points).all():
        raise ShapeError(f"keypoints of '{name}' contain values that are not finite")


def check_matches(pair: Pair, indices: np.ndarray, counts: tuple[int, int]) -> None:
    """Raises: ShapeError for anything but one-to-one matches (M, 2) of so many keypoints."""
    # COLMAP checks none of this: out-of-range indices read foreign memory, repeated ones bend the geometry.
    if indices.ndim != 2 or indices.shape[1] != 2 or indices.dtype.kind not in "iu":
        raise ShapeError(f"matches of {pair} are {indices.dtype} {indices.shape}; expected uint32 (M, 2)")
    for side in (0, 1):
        column = indices[:, side]
        if len(column) and (column.min() < 0 or column.max() >= counts[side]):
            raise ShapeError(
                f"matches of {pair} name keypoint {column.max() if column.min() >= 0 else column.min()} of "
                f"'{pair[side]}', which has {counts[side]}"
            )
        if len(column) and np.bincount(column).max() > 1:
            raise ShapeError(f"matches of {pair} use a keypoint of '{pair[side]}' more than once; expected one-to-one")


def copy_database(source: Path, target: Path) -> None:
    """Copy a database with what is still in its journal; an older `target` is replaced once the copy is whole.

    Raises: InputError when there is none; StageError when it cannot be read.
    """
    with _replacing(target) as partial:
        _copy(source, partial)


def is_whole(path: Path) -> bool:
    """Whether a database has all its pages, as one that was cut short has not."""
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            (num_images,) = database.execute("SELECT COUNT(*) FROM images").fetchone()
            return num_images > 0 and database.execute("PRAGMA quick_check(1)").fetchone() == ("ok",)
    except sqlite3.Error:
        return False


def _copy(source: Path, target: Path) -> None:
    """Copy an SQLite file with what is still in its journal."""
    if not source.is_file():
        raise InputError(f"there is no database at {source}")
    try:
        with closing(sqlite3.connect(source)) as old, closing(sqlite3.connect(target)) as new:
            old.backup(new)
    except sqlite3.Error as error:
        raise StageError(f"cannot copy the database {source}: {error}") from error


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A database beside `path` that takes its place, without the journals of either, when all went well."""
    require_space(path, _SMALLEST_DATABASE)  # COLMAP would not say why it cannot open one
    with replacing(path) as partial:
        try:
            yield partial
            _remove_journals(path)  # the old one's would be applied to the new one
        finally:
            _remove_journals(partial)


def _remove_journals(path: Path) -> None:
    for suffix in ("-wal", "-shm", "-journal"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
