"""The options of a run: defaults, then a preset, then a file, then flags; what a run was made with, as JSON."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_type_hints

import tyro
from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from sgam_core import PRESETS, SGAMOptions
from sgam_core.errors import OptionError, SGAMError
from sgam_core.options import (
    CollectionOptions,
    CovisibleOptions,
    CropOptions,
    GeometryOptions,
    GuidanceOptions,
    LookOptions,
    PredictionOptions,
    RejectionOptions,
    SemanticOptions,
    TileOptions,
)
from sgam_sfm.files import content_digest
from sgam_sfm.machine import Precision
from sgam_sfm.merging.keypoints import KeypointOptions
from sgam_sfm.nearest import unknown
from sgam_sfm.runs.shards import Shard

Preset = Literal["default", "fast", "paper", "scannet", "outdoor"]
_STAGES = tuple(stage.name for stage in fields(SGAMOptions))
_CROP = tuple(option.name for option in fields(CropOptions))


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """From photos to a COLMAP model, matching by semantic areas (SGAM).

    Reads --images, matches the pairs, writes OUT/database.db and OUT/sparse/0. The same command started again
    continues where it stopped.
    """

    images: Path
    """Folder of photos; sub-folders are searched too."""
    output: Path
    """Folder for all results; made when missing."""
    pairs: Path | None = None
    """Text file with `nameA nameB` a line (a tab between names with spaces). Without it: all pairs, up to 60 images."""
    config: Path | None = None
    """TOML or JSON file with any of these options (an options.json of an earlier run is one); flags win over it."""
    preset: Preset = "default"
    """Values of the algorithm's options below; --config and flags win over it."""

    matcher: str = "xfeat-star"
    """Point matcher. Semi-dense: xfeat-star, loftr, coarse-loftr; sparse: sift, aliked-lightglue, disk-lightglue,
    xfeat-lighterglue; or another that `sgam-sfm models` lists: vismatch:NAME, external (a script of yours)."""
    weights: Path | None = None
    """File with the point matcher's weights, where it does not find its own; for loftr also outdoor or indoor_new, for
    a matcher of several files their folder."""
    accept_licence: str = ""
    """Models whose licence forbids commercial use and allows yours, comma-separated names: superpoint-lightglue."""
    matcher_script: Path | None = None
    """With --matcher external: the Python script that matches, in an environment of its own (docs/workers.md)."""
    matcher_python: Path | None = None
    """The Python that runs it, /path/env/bin/python (without: this one)."""
    matcher_args: str = ""
    """What the script gets as arguments, quoted as in a shell; also with vismatch:NAME."""
    area_matcher: str = "sgam"
    """sgam: semantic areas. Baselines without labels: tiles, a grid paired by a first match of the whole images;
    covisible, the part that this match shows in both, matched again; none, whole images only."""
    segmenter: str = "coseg"
    """Who makes label maps: coseg learns regions from the collection itself, without a list of classes
    (coseg:facebook/dinov2-base, or another DINOv2 or DINOv3, with a larger network than the one that is installed);
    ade20k knows 31 by name (sky, person, car, ...); hf:MODEL is a segmentation model of the Hugging Face hub or a
    folder with one."""
    segmenter_script: Path | None = None
    """With --segmenter external: the Python script that segments, in an environment of its own (docs/workers.md)."""
    segmenter_python: Path | None = None
    """The Python that runs it, /path/env/bin/python (without: this one)."""
    segmenter_args: str = ""
    """What the script gets as arguments, quoted as in a shell."""
    num_labels: int = 0
    """Regions that coseg looks for (0: as many as are stable over seeds)."""
    labels: Path | None = None
    """Folder of label maps, <image name>.png with ids of 8 or 16 bits (made by `sgam-sfm segment` or elsewhere); wins
    over --segmenter. Its labels.json, when there is one, gives them names."""
    label_names: str = ""
    """How --labels are written and what their ids mean: nyu40, ade20k, coco, coco-stuff, seem, cityscapes,
    cityscapes-train, kitti360 (cityscapes:instances and kitti360:instances keep instances apart); or a file, ScanNet's
    scannetv2-labels.combined.tsv (with :nyu40 merged into NYU40) or the JSON of COCO's panoptic maps."""
    resize_labels: bool = False
    """Take label maps of another size than their image, resized to it; otherwise such images count as failed."""
    ignore_labels: str = ""
    """Labels that form no areas, comma-separated names or ids: sky,person,12."""
    mask_matches: str = ""
    """Labels that nothing is matched in, comma-separated names or ids: sky,person,12."""
    mask_path: Path | None = None
    """COLMAP's mask folder, <name>.png with 0 where nothing is to be matched."""

    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's camera model."""
    camera_params: str = ""
    """Its parameters, comma-separated (PINHOLE: fx,fy,cx,cy); held fixed in mapping."""
    camera_mode: Literal["auto", "single", "per-folder", "per-image"] = "auto"
    """Which images share a camera."""
    cameras: Path | None = None
    """Parameters for each image: a COLMAP model or cameras.txt, or lines `name MODEL width height params...` (`*`: all
    images, `folder/*`: those of a folder)."""
    rigs: Path | None = None
    """COLMAP's rig configuration (JSON): cameras that are mounted together."""
    refine_intrinsics: bool = False
    """Let mapping refine parameters that were given explicitly."""
    mapper: Literal["incremental", "global", "hierarchical"] = "incremental"
    """COLMAP's incremental mapper; its global one (GLOMAP); the hierarchical one, for thousands of images."""
    database: Path | None = None
    """COLMAP database to write into, changed only once all pairs are verified: keypoints and matches are appended to
    those it has, other pairs stay as they are. Images that it does not have are added."""
    append: bool = False
    """Append keypoints also to images that have descriptors in --database, which then cover the first ones only."""
    mapping: bool = True
    """Make a model; --no-mapping stops after the geometric verification."""

    max_image_size: int = 16384
    """Images with a longer side (pixels) are not decoded and count as failed."""
    executor: Literal["local", "ray"] = "local"
    """Who matches the pairs: this process, or the workers of a Ray cluster, one a GPU, or without GPUs one for every
    --threads cores (0: one core)."""
    ray_address: str = "auto"
    """The Ray cluster: auto, the one that this machine is part of; HOST:PORT of its head; or local, to start Ray on
    this machine alone."""
    shard: str = ""
    """i/n: match only the i-th of n shares of the pairs (i from 1) and stop before merging; `sgam-sfm join` puts the
    output folders of all shares together."""
    block_images: int = 8
    """A block of pairs, the unit of work and of resume, joins up to this many images with as many others."""
    retry_failed: bool = False
    """Going on in an OUT that has failed pairs, match these once more; what was matched is kept."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    precision: Precision = "auto"
    """Of the networks of xfeat-star and loftr: half, 16 bits, faster on CUDA only; full, 32 bits; auto: half on CUDA,
    and what gains from it (offsets of xfeat-star) on CPUs with bfloat16. Other matchers have no choice."""
    threads: int = 0
    """CPU threads (0: all cores). xfeat-star and sparse matchers match as many pairs at once on the CPU, 16 at most."""
    worker_timeout: float = 600.0
    """Seconds that a script of yours, or vismatch, may take to start, or for a pair or an image."""
    seed: int = 0
    """Seed of everything random."""
    verbose: bool = False
    """Show the log on the terminal; it is always in OUT/log.txt."""
    log_json: bool = False
    """Write the log to OUT/log.jsonl too, a JSON object a line: time, level, logger, message."""

    crop: Annotated[CropOptions, tyro.conf.arg(name="")] = field(default_factory=CropOptions)
    """Crops for the point matcher."""
    semantic: SemanticOptions = field(default_factory=SemanticOptions)
    """SAM: areas and their matching."""
    tiles: TileOptions = field(default_factory=TileOptions)
    """Area matcher tiles."""
    covisible: CovisibleOptions = field(default_factory=CovisibleOptions)
    """Area matcher covisible."""
    looks: LookOptions = field(default_factory=LookOptions)
    """Photos taken sideways, aslant, from near and from far."""
    geometry: GeometryOptions = field(default_factory=GeometryOptions)
    """Robust epipolar geometry."""
    prediction: PredictionOptions = field(default_factory=PredictionOptions)
    """GP: doubtful areas."""
    rejection: RejectionOptions = field(default_factory=RejectionOptions)
    """GR: wrong areas."""
    collection: CollectionOptions = field(default_factory=CollectionOptions)
    """GMC: matches of the whole images."""
    guidance: GuidanceOptions = field(default_factory=GuidanceOptions)
    """Guided areas: a second, finer round."""
    keypoints: KeypointOptions = field(default_factory=KeypointOptions)
    """Merging the points of all pairs into keypoints."""

    def __post_init__(self) -> None:
        for name in ("max_image_size", "block_images"):
            if getattr(self, name) < 1:
                raise OptionError(f"--{name.replace('_', '-')} is {getattr(self, name)}; expected at least 1")
        if self.shard:
            Shard.parse(self.shard)

    @property
    def sgam(self) -> SGAMOptions:
        """The options of the core."""
        stages = SGAMOptions(**{stage: getattr(self, stage) for stage in _STAGES})
        return replace(stages, geometry=replace(stages.geometry, seed=self.seed))

    def sgam_ignoring(self, labels: Collection[int]) -> SGAMOptions:
        """The options of the core, with more labels that form no areas."""
        ignored = tuple(sorted({*self.semantic.ignored_labels, *labels}))
        return replace(self.sgam, semantic=replace(self.semantic, ignored_labels=ignored))


@dataclass(frozen=True, kw_only=True)
class SegmentOptions:
    """Label maps of a folder of photos, with overlays to look at.

    Writes <image name>.png (ids), overlays/<image name>.jpg and labels.json (ids, colours, names where there are any,
    ignored ones). `sgam-sfm match --labels` reads the folder back, as if it had segmented the photos itself.
    """

    images: Path
    """Folder of photos; sub-folders are searched too."""
    output: Path
    """Folder for the label maps; made when missing."""
    segmenter: str = "coseg"
    """Who makes them: coseg learns regions from the collection itself, without a list of classes
    (coseg:facebook/dinov2-base, or another DINOv2 or DINOv3, with a larger network than the one that is installed);
    ade20k knows 31 by name (sky, person, car, ...); hf:MODEL is a segmentation model of the Hugging Face hub or a
    folder with one."""
    segmenter_script: Path | None = None
    """With --segmenter external: the Python script that segments, in an environment of its own (docs/workers.md)."""
    segmenter_python: Path | None = None
    """The Python that runs it, /path/env/bin/python (without: this one)."""
    segmenter_args: str = ""
    """What the script gets as arguments, quoted as in a shell."""
    num_labels: int = 0
    """Regions that coseg looks for (0: as many as are stable over seeds)."""
    labels: Path | None = None
    """Label maps made elsewhere, to be checked, coloured and drawn; wins over --segmenter."""
    label_names: str = ""
    """How --labels are written and what their ids mean: nyu40, ade20k, coco, coco-stuff, seem, cityscapes,
    cityscapes-train, kitti360 (cityscapes:instances and kitti360:instances keep instances apart); or a file, ScanNet's
    scannetv2-labels.combined.tsv (with :nyu40 merged into NYU40) or the JSON of COCO's panoptic maps."""
    resize_labels: bool = False
    """Take label maps of another size than their image, resized to it; otherwise such images count as failed."""
    ignore_labels: str = ""
    """Labels that are to form no areas, comma-separated names or ids; labels.json keeps them for `match`."""
    max_image_size: int = 16384
    """Images with a longer side (pixels) are not decoded and count as failed."""
    overlay_size: int = 1200
    """Long side of an overlay in pixels (0: no overlays)."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    threads: int = 0
    """CPU threads (0: all cores)."""
    worker_timeout: float = 600.0
    """Seconds that the script may take to start, or for an image."""
    seed: int = 0
    """Seed of everything random."""
    verbose: bool = False
    """Show the log on the terminal."""


AFTER_MATCHING = frozenset({"refine_intrinsics", "mapper", "mapping", "keypoints"})
"""Options that keypoints, database and model follow from, and nothing before them."""
NOT_IN_RESULTS = AFTER_MATCHING | frozenset(
    {"images", "pairs", "cameras", "rigs", "output", "config", "threads", "verbose", "log_json", "accept_licence"}
    | {"executor", "ray_address", "shard", "retry_failed"}
    | {"database", "append", "max_image_size", "worker_timeout"}
)
"""Options that the raw results of pairs do not follow from: a run can be continued with others. The images, pairs and
cameras themselves count, wherever they are."""

VERSION, _FINGERPRINT = "sgam_sfm_version", "fingerprint"
_WITH_CONTENT = ("matcher_script", "segmenter_script", "weights", "labels", "label_names", "mask_path")
SHA256 = "_sha256"
"""What an options.json holds besides options; of files and folders that results follow from, the content counts too."""
_OF_LABELS = (VERSION, "segmenter", "label", "num_labels", "resize_labels", "seed")
_OF_POINTS = (VERSION, "matcher", "weights", "precision", "mask")
"""How what an options.json holds begins that label maps, and point matches of crops, follow from."""


def starting_options(config: Path | None, preset: str | None) -> MatchOptions:
    """What flags are laid over: the defaults, changed by a preset (that of the file when None), then by a file.

    Raises: OptionError for a file that cannot be used, naming it, or an unknown preset.
    """
    content = read_config(config) if config else {}
    if not isinstance(content.get("crop", {}), dict):
        raise OptionError(f"--config '{config}': option 'crop' is {content['crop']!r}; expected options by name")
    _group_crop(content)
    made_by = content.pop(VERSION, version("sgam-sfm"))
    for name in (_FINGERPRINT, *(name + SHA256 for name in _WITH_CONTENT)):
        content.pop(name, None)
    try:
        name = preset or content.get("preset", "default")
        options = with_preset(MatchOptions(images=Path(), output=Path()), name if isinstance(name, str) else repr(name))
        changed: MatchOptions = merged(options, content | {"preset": options.preset})
        return changed
    except OptionError as error:
        if config is None:
            raise
        other = "" if made_by == version("sgam-sfm") else f"; it was written by sgam-sfm {made_by}, not this version"
        raise OptionError(f"--config '{config}': {error}{other}") from error


def _group_crop(content: dict[str, Any]) -> None:
    """Options of crops stand at the top level, as their flags do, or under `crop`, as in options.json."""
    for key in [key for key in content if key.replace("-", "_") in _CROP]:
        content.setdefault("crop", {})[key] = content.pop(key)


def with_preset(options: MatchOptions, preset: str) -> MatchOptions:
    """The options with the algorithm's values of a preset.

    Raises: OptionError for an unknown preset.
    """
    if preset not in PRESETS:
        raise OptionError(unknown("preset", preset, PRESETS))
    stages = {stage: getattr(PRESETS[preset], stage) for stage in _STAGES}
    return replace(options, preset=cast(Preset, preset), **stages)


def read_config(path: Path) -> dict[str, Any]:
    """A TOML or JSON file of options.

    Raises: OptionError when it is missing or neither.
    """
    if not path.is_file():
        raise OptionError(f"--config '{path}' does not exist; give a TOML or JSON file")
    try:
        text = path.read_text(encoding="utf-8-sig")
        content = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except (OSError, ValueError) as error:
        raise OptionError(f"--config '{path}' cannot be used ({error}); expected a TOML or JSON file") from error
    if not isinstance(content, dict):
        raise OptionError(f"--config '{path}' holds a {type(content).__name__}; expected options by name")
    return content


def merged(options: Any, changes: Mapping[str, Any], where: str = "") -> Any:
    """A copy of a dataclass with the values of a (nested) mapping; `-` and `_` in names are one.

    Raises: OptionError for an unknown name or a value of the wrong type.
    """
    types = get_type_hints(type(options))
    values: dict[str, Any] = {}
    for key, value in changes.items():
        name = key.replace("-", "_")
        if name not in types:
            top = _CROP if "crop" in types else ()
            near = difflib.get_close_matches(name, [*types, *top], n=1)
            hint = f"; did you mean '{where}{near[0]}'?" if near else ""
            raise OptionError(f"option '{where}{key}' is unknown{hint}")
        current = getattr(options, name, None)
        if is_dataclass(current) and isinstance(value, Mapping):
            values[name] = merged(current, value, f"{where}{key}.")
            continue
        try:
            values[name] = TypeAdapter(types[name]).validate_python(value)
        except ValidationError as error:
            raise OptionError(f"option '{where}{key}' is {value!r}: {error.errors()[0]['msg']}") from error
    try:
        return replace(options, **values)
    except SGAMError as error:
        raise OptionError(f"{where}{error}") from error


def as_json(options: MatchOptions) -> dict[str, Any]:
    """The resolved options, as written to options.json and read by --config: absolute paths, our version."""
    content: dict[str, Any] = to_jsonable_python(options)
    for option in fields(options):
        value = getattr(options, option.name)
        if isinstance(value, Path) and (value.exists() or option.name != "weights"):  # weights may be a name
            content[option.name] = str(value.absolute())
    for name in _WITH_CONTENT:
        given: Path | str | None = getattr(options, name)
        if given and Path(given).exists():  # a missing one is told of where it is used, or is a name
            content[name + SHA256] = content_digest(Path(given))
    return {VERSION: version("sgam-sfm")} | content


def told_options(options: MatchOptions) -> dict[str, Any]:
    """The resolved options as records of figures tell them: all but where and how loudly they are written."""
    return {name: value for name, value in as_json(options).items() if name not in {"output", "verbose", "log_json"}}


def fingerprint(options: MatchOptions, **inputs: Any) -> str:
    """A digest of the options that the results of pairs follow from, and of the inputs."""
    relevant = {name: value for name, value in as_json(options).items() if name not in NOT_IN_RESULTS}
    return _digest(relevant, inputs)


def fingerprint_of_labels(options: MatchOptions, **inputs: Any) -> str:
    """The same of the options that label maps follow from."""
    return _digest({name: value for name, value in as_json(options).items() if name.startswith(_OF_LABELS)}, inputs)


def fingerprint_of_points(options: MatchOptions) -> str:
    """The same of the options that the point matches of two crops follow from."""
    masked = fingerprint_of_labels(options) if options.mask_matches else ""
    relevant = {name: value for name, value in as_json(options).items() if name.startswith(_OF_POINTS)}
    return _digest(relevant, {"masked": masked})


def _digest(relevant: Mapping[str, Any], inputs: Mapping[str, Any]) -> str:
    text = json.dumps({"options": relevant, "inputs": to_jsonable_python(inputs)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
