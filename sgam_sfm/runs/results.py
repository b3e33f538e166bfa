"""Read the output folder of a run, finished or not: its images, pairs, labels, database and models."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Int32, UInt8

from sgam_core import AreaMatch, PairResult
from sgam_core.errors import InputError
from sgam_sfm.colmap.reading import (
    DatabaseCounts,
    MatchedPoints,
    ModelImage,
    read_counts,
    read_keypoints,
    read_model_image,
    read_model_names,
    read_pair_inliers,
)
from sgam_sfm.images import MAX_IMAGE_SIZE, printable, read_image, read_label_map
from sgam_sfm.label_set import read_label_set
from sgam_sfm.nearest import did_you_mean_run, listing
from sgam_sfm.pairs import Pair
from sgam_sfm.runs.store import PairRecord, PairStore, read_pair_outcomes


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Results:
    """What a run has written so far; arrays are read when they are asked for.

    images: folder with the images. references: folder with those that photos were localized by, None where none were.
    failed_poses: photos without a pose, and why. options: content of options.json. names: images of the collection,
    sorted, those that failed too. failed: images that could not be used, and why. blocks: pairs that were worked on, as
    they are stored, and the block of each. errors: those of them that failed, and why. listed: all pairs of the list
    that is known of, matched or not.
    """

    folder: Path
    images: Path
    references: Path | None
    failed_poses: Mapping[str, str]
    options: Mapping[str, Any]
    names: tuple[str, ...]
    failed: Mapping[str, str]
    blocks: Mapping[Pair, int]
    errors: Mapping[Pair, str]
    listed: frozenset[Pair]

    @property
    def max_image_size(self) -> int:
        """Of the run, pixels of the longer side of an image."""
        return int(self.options.get("max_image_size", MAX_IMAGE_SIZE))

    def require(self, name: str) -> str:
        """The name itself. Raises: InputError, with the nearest name, when no image has it."""
        if name in self.names:
            return name
        homonyms = [other for other in self.names if PurePosixPath(other).name == PurePosixPath(name).name]
        nearest = homonyms or difflib.get_close_matches(name, self.names, n=1, cutoff=0.0)
        hint = f"the nearest name is '{nearest[0]}'" if nearest else "there are none yet"
        raise InputError(f"'{printable(name)}' is not among the {len(self.names)} images of '{self.folder}'; {hint}")

    def usable(self, name: str) -> str:
        """The name itself. Raises: InputError when no image has it, or the run could not use the image."""
        if self.require(name) in self.failed:
            raise InputError(f"image '{name}' could not be used in '{self.folder}': {self.failed[name]}")
        return name

    def partners(self, name: str) -> tuple[str, ...]:
        """The images that an image was listed with, sorted."""
        return tuple(sorted({b if a == name else a for a, b in self.listed if name in (a, b)}))

    def pair(self, name0: str, name1: str) -> Pair:
        """The pair of two images, in this order, when it was matched.

        Raises: InputError when a name is unknown, or the pair was not listed, not matched yet, or failed.
        """
        pair = (self.require(name0), self.require(name1))
        if name0 == name1:
            raise InputError(f"'{name0}' was named twice; a pair is two images")
        reasons = [self.failed.get(name0), self.failed.get(name1), self.errors.get(pair), self.errors.get(pair[::-1])]
        failed = next((reason for reason in reasons if reason), "")
        if failed:
            raise InputError(f"the pair '{name0}' - '{name1}' failed in '{self.folder}': {failed}")
        if not self.listed.intersection((pair, pair[::-1])):
            partners = self.partners(name0)
            raise InputError(
                f"the pair '{name0}' - '{name1}' was not in the list of '{self.folder}'; "
                + (f"'{name0}' was listed with {listing(partners)}" if partners else f"'{name0}' is in no pair")
            )
        if not {pair, pair[::-1]} & self.blocks.keys():
            raise InputError(
                f"the pair '{name0}' - '{name1}' has not been matched yet in '{self.folder}'; start the same run again"
            )
        return pair

    def result(self, pair: Pair) -> PairResult | None:
        """What was found for a pair, its first image as image 0; None when the run has not matched it, or failed to."""
        if not {pair, pair[::-1]} & self.blocks.keys():
            return None
        record = self._record(pair)
        return record.result if record.result is None or record.pair == pair else swapped(record.result)

    def results_of(self, name: str) -> Iterator[tuple[str, PairResult]]:
        """The other image and the result of every matched pair of an image, which is image 0 of each."""
        for block in sorted({block for pair, block in self.blocks.items() if name in pair}):
            for record in self._store().read(block):
                if record.result is not None and name in record.pair:
                    first = record.pair[0] == name
                    yield record.pair[first], record.result if first else swapped(record.result)

    def pixels(self, name: str) -> UInt8[np.ndarray, "H W 3"]:
        """The pixels of an image.

        Raises: InputError when it is no longer where it was.
        """
        folders = (self.images, self.references or self.images)
        path = next((folder / name for folder in folders if (folder / name).is_file()), None)
        if path is None:
            raise InputError(f"image '{name}' is no longer in '{self.images}'; give its folder with --images DIR")
        return read_image(path, self.max_image_size)

    def labels(self, name: str) -> Int32[np.ndarray, "h w"] | None:
        """The label map of an image, None when the run made none."""
        path = self.folder / "labels" / f"{name}.png"
        return read_label_map(path) if path.is_file() else None

    def label_names(self) -> dict[int, str]:
        """The names of labels that have one."""
        return {label.id: label.name for label in read_label_set(self.folder / "labels").labels if label.name}

    def database(self) -> Path:
        """The run's database. Raises: InputError when there is none yet."""
        path = self.folder / "database.db"
        if not path.is_file():
            raise InputError(f"'{self.folder}' has no database.db yet; start the same match again, it writes one")
        return path

    def inliers(self, pair: Pair) -> MatchedPoints | None:
        """The matches that COLMAP's verification left of a pair, None when it has not verified the pair."""
        database = self.folder / "database.db"
        return read_pair_inliers(database, pair) if database.is_file() else None

    def counts(self) -> DatabaseCounts | None:
        """Keypoints of every image and inliers of every verified pair, None when there is no database yet."""
        database = self.folder / "database.db"
        return read_counts(database) if database.is_file() else None

    def keypoints(self, name: str) -> np.ndarray | None:
        """Keypoints (N, 2) of an image in pixels, None when there is no database yet."""
        database = self.folder / "database.db"
        return read_keypoints(database, name) if database.is_file() else None

    def models(self) -> tuple[Path, ...]:
        """Folders of the models, most images first."""
        found = [path for path in (self.folder / "sparse").glob("*") if path.name.isdecimal()]
        return tuple(sorted(found, key=lambda path: int(path.name)))

    def registered(self) -> dict[str, str]:
        """The model of every image that has a pose."""
        return {name: model.name for model in self.models()[::-1] for name in read_model_names(model)}

    def model_image(self, name: str) -> tuple[str, ModelImage] | None:
        """The first model with a pose for the image, and its keypoints there; None when there is none."""
        for model in self.models():
            if name in read_model_names(model):
                return model.name, read_model_image(model, name)
        return None

    def _store(self) -> PairStore:
        return PairStore(folder=self.folder / "pairs", fingerprint="")

    def _record(self, pair: Pair) -> PairRecord:
        block = self.blocks[pair if pair in self.blocks else pair[::-1]]
        return next(record for record in self._store().read(block) if set(record.pair) == set(pair))


def open_results(folder: Path, images: Path | None = None) -> Results:
    """Open the output folder of a run, finished or not.

    Args: images: folder of the images, where it is not the one that the run was given.
    Raises: InputError when the folder is not the output of a run, or there is no folder of images.
    """
    if not folder.is_dir():
        raise InputError(f"'{folder}' {'is a file' if folder.exists() else 'does not exist'}; {_EXPECTED}")
    options = json_object(folder / "options.json")
    if "images" not in options:
        hint = did_you_mean_run(folder, _EXPECTED)
        raise InputError(f"'{folder}' is no result folder (no options.json of a run in it); {hint}")
    image_folder = images or Path(options["images"])
    if not image_folder.is_dir():
        raise InputError(
            f"the image folder '{image_folder}' does not exist"
            + ("; check --images" if images else ": if it was moved, give the new one with --images DIR")
        )
    inputs, summary = json_object(folder / "inputs.json"), json_object(folder / "summary.json")
    localized = json_object(folder / "localize.json")
    failed = {**summary.get("images", {}).get("failed", {}), **inputs.get("failed", {})}
    stored = tuple(read_pair_outcomes(folder))
    blocks = {outcome.pair: outcome.block for outcome in stored}
    listed = frozenset(blocks) | {(a, b) for key in ("pairs", "left_out") for a, b in inputs.get(key, ())}
    labelled = (path.relative_to(folder / "labels") for path in (folder / "labels").rglob("*.png"))
    names = {name for pair in listed for name in pair} | {*inputs.get("images", ())} | {*failed}
    # Labels know of images that no pair names yet; without inputs.json they are all that a run begun tells.
    names |= set() if inputs else {path.as_posix().removesuffix(".png") for path in labelled}
    return Results(
        folder=folder,
        images=image_folder,
        references=Path(localized["reference_images"]) if "reference_images" in localized else None,
        failed_poses=localized.get("failed", {}),
        options=options,
        names=tuple(sorted(names)),
        failed=failed,
        blocks=blocks,
        errors={outcome.pair: outcome.error for outcome in stored if outcome.error},
        listed=listed,
    )


_EXPECTED = "give the --output folder of a match run"


def open_plain(folder: Path, images: Path | None = None) -> Results:
    """Open the output of the plain matcher.

    Raises: InputError when it is not a result folder of `--area-matcher none`.
    """
    plain = open_results(folder, images)
    if plain.options.get("area_matcher") != "none":
        raise InputError(
            f"'{folder}' was matched with --area-matcher {plain.options.get('area_matcher')}; --plain expects the "
            "output of --area-matcher none"
        )
    return plain


def find_plain(results: Results, pair: Pair) -> Results | None:
    """The plain matcher's output for a pair among the folders beside a run: same images, same matcher."""
    if results.options.get("area_matcher") == "none":
        return None
    candidates = []
    for path in sorted(results.folder.resolve().parent.glob("*/options.json")):
        options = json_object(path)
        same = options.get("area_matcher") == "none" and options.get("matcher") == results.options.get("matcher")
        if same and Path(options.get("images", "")).resolve() == Path(results.options["images"]).resolve():
            others = sum(options.get(name) != value for name, value in results.options.items())
            candidates.append((others, path.parent))
    for _, folder in sorted(candidates):  # with the fewest other options first
        try:
            plain = open_results(folder, results.images)
            found = plain.result(pair)
        except InputError:  # nobody asked for this folder
            continue
        if found is not None:
            return plain
    return None


def swapped(result: PairResult) -> PairResult:
    """The same result with the two images exchanged."""
    model = result.two_view
    return replace(
        result,
        matches=result.matches.swapped(),
        areas=tuple(_swapped_area(area) for area in result.areas),
        two_view=None if model is None else replace(model, F=model.F.T),
        coverage0=result.coverage1,
        coverage1=result.coverage0,
        whole_scale0=result.whole_scale1,
        whole_scale1=result.whole_scale0,
        turned=-result.turned % 360,
        zoom=1 / result.zoom,
    )


def _swapped_area(area: AreaMatch) -> AreaMatch:
    return replace(area, area0=area.area1, area1=area.area0, scale0=area.scale1, scale1=area.scale0)


def json_object(path: Path) -> dict[str, Any]:
    """The content of a JSON file; empty when it is missing or no object: such a run has just not got so far."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
