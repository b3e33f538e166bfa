"""Harder cuts of a collection, so that one that every method solves still tells them apart.

Below the folder of a cut: `pairs.txt`; where images are cut, also `images/`, and `masks/`, `labels/` and `cameras.txt`
where the collection has them, under the names that the images had, so that ground truth fits as it is.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image as PillowImage
from pydantic import TypeAdapter

from sgam_core.errors import InputError, OptionError
from sgam_sfm.colmap.camera_files import write_cameras
from sgam_sfm.colmap.cameras import CameraInfo, KnownCamera, camera_of_part
from sgam_sfm.evaluation.ground_truth import TrueView
from sgam_sfm.files import replacing, write_json
from sgam_sfm.images import ImageFile, read_image, read_label_map, read_mask
from sgam_sfm.inputs import Inputs
from sgam_sfm.label_maps import create_segmenter, write_label_maps
from sgam_sfm.label_set import RECORD
from sgam_sfm.nearest import did_you_mean
from sgam_sfm.options import MatchOptions, fingerprint
from sgam_sfm.pairs import write_pairs
from sgam_sfm.progress import Stages

_RECORD = "cut.json"


@dataclass(frozen=True, kw_only=True, slots=True)
class Cut:
    """A harder cut. The images are numbered by name.

    every: only every so many-th image is kept, with the pairs among them. scale: of the images' sides, at most 1. zoom:
    of every other kept image only the centre is left, so many times less wide and high, at its own resolution. turn:
    every other kept image is turned anticlockwise by so many quarters, as if the camera had been held sideways.
    """

    every: int = 1
    scale: float = 1.0
    zoom: float = 1.0
    turn: int = 0

    @property
    def changes_images(self) -> bool:
        """Whether images are cut, and not only left out."""
        return self.scale != 1 or self.zoom != 1 or self.turn != 0

    def __str__(self) -> str:
        """As it is written on the command line; empty for the whole collection."""
        values = ((option, getattr(self, option.name)) for option in fields(self))
        return " ".join(f"{option.name}={value:g}" for option, value in values if value != option.default)


@dataclass(frozen=True, kw_only=True, slots=True)
class Window:
    """What is left of an image: its part from (x0, y0) on, width x height pixels, resized to `size` (width, height).

    whole: (width, height) of the image. turns: quarter turns anticlockwise of what is left.
    """

    whole: tuple[int, int]
    x0: int
    y0: int
    width: int
    height: int
    size: tuple[int, int]
    turns: int = 0

    def view(self, whole: TrueView) -> TrueView:
        """The true camera of the window, of that of the image at any size."""
        to_image = np.diag([self.whole[0] / whole.width, self.whole[1] / whole.height, 1])
        to_part = np.array([[1, 0, -self.x0], [0, 1, -self.y0], [0, 0, 1]])
        to_size = np.diag([self.size[0] / self.width, self.size[1] / self.height, 1])
        matrix = to_size @ to_part @ to_image @ whole.camera_matrix
        view = replace(whole, width=self.size[0], height=self.size[1], camera_matrix=matrix)
        for _ in range(self.turns):
            view = _turned_view(view)
        return view

    def of(self, pixels: np.ndarray, interpolation: int) -> np.ndarray:
        """The window of an array (H, W) or (H, W, C)."""
        part = pixels[self.y0 : self.y0 + self.height, self.x0 : self.x0 + self.width]
        if self.size != (self.width, self.height):
            part = cv2.resize(part, self.size, interpolation=interpolation)
        return np.ascontiguousarray(np.rot90(part, self.turns))


def _turned_view(view: TrueView) -> TrueView:
    """The camera of an image that is turned anticlockwise by a quarter: (x, y) becomes (y, width - x)."""
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    moved = np.array([[1, 0, 0], [0, 1, view.width], [0, 0, 1]]) @ turn @ view.camera_matrix @ turn.T
    pose = None if view.cam_from_world is None else turn @ view.cam_from_world
    distortion = view.distortion
    if distortion:
        k1, k2, p1, p2, *more = distortion
        distortion = (k1, k2, -p2, p1, *more)
    return replace(
        view, width=view.height, height=view.width, camera_matrix=moved, cam_from_world=pose, distortion=distortion
    )


def cut_folder(output: Path, cut: Cut | str) -> Path:
    """The folder of a cut in a comparison's output; the cut may be as it is written on the command line."""
    return output / ("hard_" + str(cut).replace(" ", "_").replace("=", "-"))


def parse_cut(texts: Sequence[str], scene_scale: float = 1.0) -> Cut:
    """The cut of `every=K`, `scale=S`, `zoom=Z`; scene_scale multiplies its scale.

    Raises: OptionError for anything else, and values out of range.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, _, number = text.partition("=")
        if name not in Cut.__dataclass_fields__:
            hint = did_you_mean(name, Cut.__dataclass_fields__)
            raise OptionError(
                f"--hard '{text}': '{name}' is unknown; {hint}expected every=K, scale=S, zoom=Z or turn=Q"
            )
        if name in values:
            raise OptionError(f"--hard '{text}': {name} is given twice")
        try:
            values[name] = float(number)
        except ValueError as error:
            raise OptionError(f"--hard '{text}': '{number}' is not a number") from error
    every = values.get("every", 1.0)
    if every % 1 != 0 or every < 1:  # also nan and infinity
        raise OptionError(f"--hard every={every:g}: expected a whole number of at least 1")
    turn = values.get("turn", 0.0)
    if turn not in range(4):
        raise OptionError(f"--hard turn={turn:g}: expected quarter turns, 1, 2 or 3")
    cut = Cut(
        every=int(every), scale=values.get("scale", 1.0) * scene_scale, zoom=values.get("zoom", 1.0), turn=int(turn)
    )
    if not 0 < cut.scale <= 1:
        raise OptionError(f"images are to be scaled by {cut.scale:g}; expected more than 0 and at most 1")
    if not 1 <= cut.zoom < np.inf:
        raise OptionError(f"--hard zoom={cut.zoom:g}: expected at least 1")
    return cut


def cut_collection(cut: Cut, options: MatchOptions, inputs: Inputs, folder: Path, stages: Stages) -> MatchOptions:
    """Write what the cut leaves of a collection, unless it is there already.

    Cameras that the user gave follow their images; without any, those of EXIF do, and mapping refines them as it does
    with the whole images.

    Returns: the options of `match` on it, with its pair list. Raises: InputError when no pair is left.
    """
    kept = sorted(inputs.images)[:: cut.every]
    pairs = [pair for pair in inputs.pairs.pairs if {*pair} <= {*kept}]
    if not pairs:
        raise InputError(f"--hard {cut} leaves none of the {len(inputs.pairs.pairs)} pairs; cut less")
    folder.mkdir(parents=True, exist_ok=True)
    write_pairs(folder / "pairs.txt", pairs)
    options = replace(options, pairs=folder / "pairs.txt")
    if not cut.changes_images:
        return options
    others = {*kept[1::2]}
    windows = {name: _window(inputs.images[name], cut, other=name in others) for name in kept}
    record = folder / _RECORD
    mark = fingerprint(options, images=inputs.digests, cut=cut)
    if not record.exists() or _read(record)["fingerprint"] != mark:
        record.unlink(missing_ok=True)
        for part in ("images", "masks", "labels"):
            shutil.rmtree(folder / part, ignore_errors=True)
        _write_images(options, inputs, windows, folder, stages)
        write_json(record, {"fingerprint": mark, "windows": windows})
    given = {name: camera for name in kept if (camera := inputs.cameras[name]).known}
    focal = {name: camera for name in kept if (camera := inputs.cameras[name]).has_prior_focal}
    cameras = _cameras(given or focal, windows)
    if cameras:
        write_cameras(folder / "cameras.txt", cameras)
    return replace(
        options,
        images=folder / "images",
        mask_path=None if options.mask_path is None else folder / "masks",
        labels=None if options.labels is None else folder / "labels",
        label_names="",  # the maps there are written in plain ids
        cameras=folder / "cameras.txt" if cameras else None,
        camera_params="",
        # Images of several sizes cannot share the one camera that their folder had.
        camera_mode=options.camera_mode if cut.zoom == 1 and not cut.turn else "per-image",
        refine_intrinsics=options.refine_intrinsics or not given,
    )


def read_windows(folder: Path) -> dict[str, Window]:
    """What a cut left of the images, by name; empty where they are whole."""
    record = folder / _RECORD
    return TypeAdapter(dict[str, Window]).validate_python(_read(record)["windows"]) if record.exists() else {}


def cut_views(views: Mapping[str, TrueView], windows: Mapping[str, Window]) -> dict[str, TrueView]:
    """The true cameras of what is left of images; the images' own where they are whole."""
    return {name: windows[name].view(view) if name in windows else view for name, view in views.items()}


def _window(image: ImageFile, cut: Cut, *, other: bool) -> Window:
    zoom = cut.zoom if other else 1.0
    width, height = (max(1, round(side / zoom)) for side in (image.width, image.height))
    return Window(
        whole=(image.width, image.height),
        x0=(image.width - width) // 2,
        y0=(image.height - height) // 2,
        width=width,
        height=height,
        size=(max(1, round(width * cut.scale)), max(1, round(height * cut.scale))),
        turns=cut.turn if other else 0,
    )


def _write_images(
    options: MatchOptions, inputs: Inputs, windows: Mapping[str, Window], folder: Path, stages: Stages
) -> None:
    """The windows of the images, and of their masks and label maps."""
    whole = folder / "whole_labels"
    if options.labels is not None:
        images = {name: inputs.images[name] for name in windows}
        segmenter = create_segmenter(options, folder)
        write_label_maps(segmenter, "labels", images, whole, Stages(quiet=True), full_size=True)
        (folder / "labels").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(whole / RECORD, folder / "labels" / RECORD)
    if options.mask_path is not None:
        (folder / "masks").mkdir(parents=True, exist_ok=True)
    with stages.stage("Cutting images", len(windows)) as advance:
        for name, window in windows.items():
            file = inputs.images[name]
            _save(folder / "images" / name, window.of(read_image(file), cv2.INTER_AREA))
            mask = None if options.mask_path is None else read_mask(options.mask_path, file)
            if mask is not None:
                part = window.of(mask.astype(np.uint8), cv2.INTER_NEAREST_EXACT)
                _save(folder / "masks" / f"{name}.png", 255 * part)
            if (whole / f"{name}.png").exists():
                labels = read_label_map(whole / f"{name}.png").astype(np.uint16)
                part = window.of(labels, cv2.INTER_NEAREST_EXACT)
                _save(folder / "labels" / f"{name}.png", part)
            advance(1)
    shutil.rmtree(whole, ignore_errors=True)


def _read(record: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(record.read_text(encoding="utf-8"))
    return content


def _save(path: Path, pixels: np.ndarray) -> None:
    """An image by the format of its name, with next to no loss where the format has any."""
    kind = PillowImage.registered_extensions()[path.suffix.lower()]
    with replacing(path) as partial:
        PillowImage.fromarray(pixels).save(partial, format=kind, quality=100, subsampling=0)


def _cameras(cameras: Mapping[str, CameraInfo], windows: Mapping[str, Window]) -> dict[str, KnownCamera]:
    return {
        name: camera_of_part(camera, (window.x0, window.y0), (window.width, window.height), window.size, window.turns)
        for name, camera in cameras.items()
        for window in (windows[name],)
    }
