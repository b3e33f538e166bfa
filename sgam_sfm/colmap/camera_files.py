"""Files of known cameras: lines of text by image name, or COLMAP's own models."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from sgam_core.errors import InputError
from sgam_sfm.colmap.cameras import KnownCamera, camera_parameters
from sgam_sfm.colmap.reading import read_model
from sgam_sfm.files import replacing

logger = logging.getLogger(__name__)


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
            params = camera_parameters(fields[0], tuple(fields[3:]))
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
    first = next((row for row, line in enumerate(lines) if line.strip()), 0)
    for line in filter(str.strip, lines[first::2]):  # a line of points, which may be empty, follows each
        fields = line.split(maxsplit=9)
        if len(fields) != 10 or fields[8] not in cameras:
            raise InputError(
                f"{images}: '{line}' names no camera of {path}; expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            )
        named[fields[9].strip()] = cameras[fields[8]]
    return named
