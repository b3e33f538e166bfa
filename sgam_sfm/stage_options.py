"""The options of the commands that work on what `match` has written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sgam_core.errors import OptionError
from sgam_sfm.merging.keypoints import KeypointOptions


@dataclass(frozen=True, kw_only=True)
class _ModelOptions:
    """How a model is made from a database."""

    images: Path | None = None
    """Folder of the images, where it is no longer the one that the run was given."""
    output: Path | None = None
    """Folder for the results, which then has a database of its own; without it: OUT itself."""
    mapper: Literal["incremental", "global", "hierarchical", "triangulate"] = "incremental"
    """COLMAP's incremental mapper; its global one (GLOMAP); the hierarchical one, for thousands of images; or
    triangulate, points only, for the known poses of --input-model."""
    input_model: Path | None = None
    """COLMAP model with the poses and cameras of the images (for --mapper triangulate); its points are not used."""
    refine_intrinsics: bool = False
    """Let mapping refine parameters that were given explicitly."""
    seed: int = 0
    """Seed of verification and mapping."""
    threads: int = 0
    """CPU threads of the verification (0: all cores); mappers use one, so that they repeat."""
    verbose: bool = False
    """Show the log on the terminal; it is always in OUT/log.txt."""

    def __post_init__(self) -> None:
        if self.mapper == "triangulate" and self.input_model is None:
            raise OptionError("--mapper triangulate needs known poses; give a COLMAP model with --input-model DIR")
        if self.input_model is not None and self.mapper != "triangulate":
            raise OptionError(f"--input-model is for --mapper triangulate, not {self.mapper}; leave one of them out")


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(_ModelOptions):
    """Make the model anew with other mapping options; nothing is matched again.

    Reads OUT/database.db of a match run, or any COLMAP database. Writes sparse/0, sparse/1, ... and reconstruct.json.
    Pairs that COLMAP has not verified yet are verified first. Options that are not given have the defaults of `match`,
    not the values of the run.
    """

    results: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[OUT]")] = None
    """The --output folder of a match run."""
    database: Path | None = None
    """A COLMAP database in place of OUT, made by any program; it is copied, not changed (needs --images, --output)."""

    def __post_init__(self) -> None:
        _ModelOptions.__post_init__(self)
        if (self.results is None) == (self.database is None):
            raise OptionError("give either OUT, the --output folder of a match run, or --database FILE")
        if self.database is not None and (self.images is None or self.output is None):
            raise OptionError("--database needs --images, the folder of its images, and --output, a folder to write to")


@dataclass(frozen=True, kw_only=True)
class AggregateOptions(_ModelOptions):
    """Merge the raw matches of a run into keypoints again with other settings; nothing is matched again.

    Writes keypoints.h5, matches.h5 and database.db, verifies the pairs and makes the model anew. Options that are not
    given have the defaults of `match`, not the values of the run.
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """The --output folder of a match run."""
    mapping: bool = True
    """Make a model; --no-mapping stops after the geometric verification."""
    keypoints: KeypointOptions = field(default_factory=KeypointOptions)
    """Merging the points of all pairs into keypoints."""
    hloc: bool = False
    """Write matches.h5 even when it takes more than 2 GB, which hloc's layout does for tens of thousands of pairs."""


@dataclass(frozen=True, kw_only=True)
class LocalizeOptions:
    """Poses of new photos in the model of a match run, found with the same matcher, areas and parameters.

    Writes poses.txt (name qw qx qy qz tx ty tz), poses.csv, sparse/0 (the model with the new photos) and localize.json.
    The same command started again continues where it stopped.
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """The --output folder of the match run: its images are the references."""
    images: Path
    """Folder of the photos to localize; sub-folders are searched too."""
    output: Path
    """Folder for the results; made when missing."""
    model: Path | None = None
    """COLMAP model to localize in, of the run's images (without it: OUT/sparse/0)."""
    reference_images: Path | None = None
    """Folder of the run's images, where it is no longer the one that the run was given."""
    pairs: Path | None = None
    """Text file with `photo reference` a line. Without it: each photo with all references, up to 60 of them."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's camera model of the photos."""
    camera_params: str = ""
    """Its parameters, comma-separated; without them EXIF's focal length, or one that is estimated."""
    camera_mode: Literal["auto", "single", "per-folder", "per-image"] = "auto"
    """Which photos share a camera."""
    cameras: Path | None = None
    """Parameters for each photo, as `match` reads them."""
    labels: Path | None = None
    """Label maps of the photos and the references, for a run with --labels; photos without any are matched whole."""
    area_matcher: str = ""
    """Another area matcher than the run's: none is the fastest."""
    radius_px: float = 3.0
    """A match within it of a reference's keypoint shows the same point, in pixels of the point matcher."""
    max_error_px: float = 12.0
    """Reprojection error of an inlier, in pixels of the photo."""
    min_inliers: int = 15
    """Points of the model that a pose must agree with."""
    max_image_size: int = 16384
    """Photos with a longer side (pixels) are not decoded and count as failed."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    threads: int = 0
    """CPU threads (0: all cores)."""
    seed: int = 0
    """Seed of the pose estimation."""
    verbose: bool = False
    """Show the log on the terminal; it is always in OUTPUT/log.txt."""

    def __post_init__(self) -> None:
        for name in ("radius_px", "max_error_px"):
            if not getattr(self, name) > 0:
                raise OptionError(f"--{name.replace('_', '-')} is {getattr(self, name)}; expected more than 0 pixels")
        if self.min_inliers < 4:
            raise OptionError(f"--min-inliers is {self.min_inliers}; expected at least 4, since 3 points fit any pose")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Keypoints and matches of a run as COLMAP's text files, for feature_importer and matches_importer.

    Writes keypoints/<image name>.txt and matches.txt. For hloc and its readers, a run has keypoints.h5 and matches.h5
    in OUT already.
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """The --output folder of a match run."""
    output: Path
    """Folder for the files; made when missing."""
    images: Path | None = None
    """Folder of the images, where it is no longer the one that the run was given."""


@dataclass(frozen=True, kw_only=True)
class JoinOptions:
    """The shards of a run (`match --shard i/n`) put together: the output of the same run without shards.

    Checks that all blocks of pairs are there, then merges the points into keypoints and writes database.db, verifies
    and maps with the options of the shards. Nothing is matched again.
    """

    shards: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SHARD_OUT...")]
    """The --output folders of all shards."""
    output: Path
    """Folder for all results; made when missing."""
    images: Path | None = None
    """Folder of the images, where it is no longer the one that the shards were given."""
    verbose: bool = False
    """Show the log on the terminal; it is always in OUT/log.txt."""
