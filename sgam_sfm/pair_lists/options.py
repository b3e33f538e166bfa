"""The options of `sgam-sfm pairs`, a dataclass a method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from sgam_core.errors import OptionError


@dataclass(frozen=True, kw_only=True)
class MethodOptions:
    """What every method needs."""

    images: Path
    """Folder of photos; sub-folders are searched too."""
    output: Path
    """The pair list to write."""
    verbose: bool = False
    """Show the log on the terminal."""


@dataclass(frozen=True, kw_only=True)
class Exhaustive(MethodOptions):
    """All pairs."""

    max_images: int = 1000
    """Refuse more images than this, since pairs grow with their square (1000 images: half a million; 0: no limit)."""

    def __post_init__(self) -> None:
        _at_least(0, "--max-images", self.max_images)


@dataclass(frozen=True, kw_only=True)
class PartnerOptions(MethodOptions):
    """How many partners an image gets."""

    num: int = 20
    """Partners of each image, those with the best scores (0: all). A pair stands when either image chose the other."""

    def __post_init__(self) -> None:
        _at_least(0, "--num", self.num)


@dataclass(frozen=True, kw_only=True)
class DescriptorOptions(PartnerOptions):
    """What tells how alike two images look."""

    descriptors: Path | None = None
    """Descriptors made elsewhere: an h5 file of hloc (extract_features: netvlad, openibl, megaloc, ...)."""
    labels: Path | None = None
    """Compare the shares of labels in these label maps, <image name>.png, as `sgam-sfm segment` writes them."""
    min_score: float = -1.0
    """The lowest cosine similarity of a pair, -1 to 1. With coseg, 0 is that of any two images of the collection."""
    cache: Path | None = None
    """Folder for the features of coseg. Without it: `out/cache` beside --output, where the `sgam-sfm match` that is
    printed at the end finds them."""
    max_image_size: int = 16384
    """Images with a longer side (pixels) are not decoded and count as failed."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    threads: int = 0
    """CPU threads (0: all cores)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.descriptors is not None and self.labels is not None:
            raise OptionError("--descriptors and --labels are two ways to compare images; give one of them")
        if not -1 <= self.min_score <= 1:
            raise OptionError(f"--min-score is {self.min_score:g}; a cosine similarity is between -1 and 1")


@dataclass(frozen=True, kw_only=True)
class Sequential(DescriptorOptions):
    """Frames of videos: each with those that follow it, in the natural order of names (frame2 before frame10).

    Every sub-folder is a sequence of its own. With --loop-closure, some frames are also compared with all images, of
    all sequences, by descriptors as in `retrieval`; --num and the options that follow it are for these.
    """

    overlap: int = 10
    """Frames that each one is matched with after it."""
    quadratic_overlap: bool = False
    """As COLMAP's: the frames 1, 2, 4, 8, ... after each one, --overlap of them, in place of the next ones."""
    loop_closure: bool = False
    """Find places that are seen again: pairs by retrieval, beyond the frames that are neighbours anyway."""
    loop_period: int = 10
    """Every how many frames of a sequence to look for them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _at_least(1, "--overlap", self.overlap)
        _at_least(1, "--loop-period", self.loop_period)
        if not self.loop_closure and (self.descriptors is not None or self.labels is not None):
            raise OptionError("--descriptors and --labels are for loops; add --loop-closure")


@dataclass(frozen=True, kw_only=True)
class Retrieval(DescriptorOptions):
    """Images that look alike.

    The descriptor is the mean of the features that coseg segments with, the collection's mean subtracted; or the labels
    of --labels, or any --descriptors. The score is the cosine similarity.
    """


@dataclass(frozen=True, kw_only=True)
class FromModel(PartnerOptions):
    """Images that see the same points of a COLMAP model; the score is how many they share."""

    model: Path
    """Folder of the model: cameras, images and points3D as .bin or .txt."""
    min_score: float = 1
    """The fewest points that a pair shares."""


@dataclass(frozen=True, kw_only=True)
class FromPoses(PartnerOptions):
    """Images whose cameras look at the same space, by their poses alone; what walls hide is not known.

    The score, 0 to 1, is the share of what one image sees that the other sees too, the mean of both ways, at a third,
    once and three times --depth.
    """

    poses: Path
    """Known poses: a COLMAP model, a CSV, Strecha's cameras, a ScanNet scene, ... (docs/datasets.md)."""
    poses_format: str = ""
    """Their format, where it cannot be told from the files."""
    max_rotation_deg: float = 60.0
    """The largest angle between the viewing directions of a pair (hloc: 30); few point matchers go beyond 60."""
    min_score: float = 0.1
    """The lowest score of a pair."""
    depth: float = 0.0
    """How far from the cameras the scene is, in the unit of the poses (0: where the optical axes of pairs meet)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.max_rotation_deg <= 180:
            raise OptionError(f"--max-rotation-deg is {self.max_rotation_deg:g}; expected more than 0, up to 180")
        if not self.depth >= 0:
            raise OptionError(f"--depth is {self.depth:g}; expected a positive number, or 0 to estimate it")


@dataclass(frozen=True, kw_only=True)
class FromFile(MethodOptions):
    """Pairs that another program chose: of a COLMAP database, of hloc's matches.h5, or of a text list.

    Names are checked against the folder and each pair is kept once; a text list may be COLMAP's with match indices.
    """

    file: Path
    """database.db (pairs with matches), matches.h5, or a text file with `nameA nameB` a line."""
    min_score: float = 1
    """The fewest matches of a pair; a text list tells none."""


Method = (
    Annotated[Exhaustive, tyro.conf.subcommand("exhaustive")]
    | Annotated[Sequential, tyro.conf.subcommand("sequential")]
    | Annotated[Retrieval, tyro.conf.subcommand("retrieval")]
    | Annotated[FromModel, tyro.conf.subcommand("from-model")]
    | Annotated[FromPoses, tyro.conf.subcommand("from-poses")]
    | Annotated[FromFile, tyro.conf.subcommand("from-file")]
)


@dataclass(frozen=True, kw_only=True)
class PairsOptions:
    """Choose which images to match: writes a pair list, `nameA nameB` a line, that `sgam-sfm match --pairs` reads."""

    method: Method


def _at_least(least: int, flag: str, value: int) -> None:
    if value < least:
        raise OptionError(f"{flag} is {value}; expected at least {least}")
