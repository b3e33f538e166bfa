"""The options of every stage: one frozen dataclass each, and the presets as named instances.

Layout lengths (`_px` of areas, borders, windows) are pixels of a label map 640 wide. Residuals r are squared Sampson
distances divided by sigma^2, sigma being image pixels per matcher pixel on the coarser side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, cast

from sgam_core.errors import OptionError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DESCRIPTOR_SCALES = (0.8, 1.2, 1.4)  # both descriptors look at these multiples of an area (paper, appendix)
_PHOTO = 3 / 2  # long side over short side


class _Checked:
    """Rejects negative numbers: no option of any stage has a meaning for them."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for option in fields(cast("DataclassInstance", self)):
            value = getattr(self, option.name)
            if isinstance(value, int | float) and value < 0:
                raise OptionError(f"{option.name} is {value}; expected a number of at least 0")

    def _within(self, name: str, low: float, high: float) -> None:
        if not low <= (value := getattr(self, name)) <= high:
            raise OptionError(f"{name} is {value}; expected a number from {low} to {high}")

    def _is_upsampling(self, *names: str) -> None:
        for name in names:
            if 0 < (value := getattr(self, name)) < 1:
                raise OptionError(f"{name} is {value}; expected at least 1 (never enlarge), or 0 (without limit)")


@dataclass(frozen=True, kw_only=True, slots=True)
class CropOptions(_Checked):
    """How areas and whole images are given to the point matcher (paper, appendix, Area Size)."""

    area_size: int = 800
    """Long side of an area's crop at the matcher, pixels. More is finer and slower."""
    image_size: int = 1024
    """Long side of a whole image at the matcher, pixels."""
    max_crop_pixels: int = 2_200_000
    """Area-crop pixels matched per pair of 3:2 photos, both sides together, and in proportion to their whole images for
    those of other shapes; areas beyond it are skipped and counted (0: no limit)."""
    expand: float = 1.2
    """Side of the crop over the long side of its area."""
    keep: float = 1.1
    """Matches are kept inside the area's box enlarged by this (the paper: 1.0)."""
    max_upsampling: float = 1.0
    """Areas are enlarged to reach area_size, to at most so many times their image's resolution (1: never; 0: without
    limit, as in the paper)."""
    max_whole_upsampling: float = 1.0
    """The same for whole images and image_size."""

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        self._is_upsampling("max_upsampling", "max_whole_upsampling")
        for name in ("area_size", "image_size"):
            if (value := getattr(self, name)) < 1:
                raise OptionError(f"{name} is {value}; expected at least 1 pixel")

    def of_shapes(self, *sizes: tuple[int, int]) -> CropOptions:
        """The same with `max_crop_pixels` for a pair of images of these sizes (width, height).

        Whole images are matched at one long side, so squarer ones have more pixels, and so must crops, to be finer.
        """
        share = sum(min(size) / max(size) for size in sizes) / len(sizes)
        return replace(self, max_crop_pixels=math.ceil(self.max_crop_pixels * (share * _PHOTO)))


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectAreaOptions(_Checked):
    """Semantic object areas, SOA (paper, Sec. III-B1)."""

    enabled: bool = True
    """Detect and match object areas."""
    close_px: int = 13
    """Gaps of a label's mask up to this width are closed."""
    open_px: int = 5
    """Bridges of a label's mask up to this width are cut."""
    min_share: float = 0.01
    """Smallest object, share of the image."""
    max_share: float = 0.65
    """Largest box, share of the image; above it only against a much smaller one (a zoom)."""
    max_aspect: float = 4.0
    """Longest box, long side over short side."""
    fuse_px: float = 100.0
    """Objects of one label whose centres are nearer than this become one."""
    max_per_label: int = 4
    """Most areas of one label in an image, largest first."""
    max_per_image: int = 10
    """Most areas in an image, largest first."""
    min_run_px: int = 20
    """A label lies on a side of the border when it fills a run of at least this length."""
    distance: Literal["hamming", "jaccard"] = "hamming"
    """Distance between border descriptors."""
    max_distance: float = 0.5
    """Candidates farther apart are no candidates (T_H)."""
    doubt_margin: float = 0.2
    """Candidates within this of the best one make both doubtful (T_da)."""
    max_area_ratio: float = 25.0
    """Candidates whose boxes differ more in area are no candidates."""
    max_ratio_spread: float = 2.5
    """Once three matches agree on the area ratio of the pair, candidates may differ from it by this factor."""


@dataclass(frozen=True, kw_only=True, slots=True)
class IntersectionAreaOptions(_Checked):
    """Semantic intersection areas, SIA (paper, Sec. III-B2)."""

    enabled: bool = True
    """Detect and match intersection areas."""
    window_px: float = 256.0
    """Side of the window."""
    max_window_share: float = 0.9
    """The window is at most this share of the label map's short side."""
    min_labels: int = 3
    """Fewest labels in a window (the paper: more than 3)."""
    min_label_share: float = 1 / 64
    """Labels that fill less of a window are ignored."""
    nms_px: float = 100.0
    """Of windows whose centres are nearer than this the better one stays."""
    max_per_image: int = 8
    """Most windows in an image."""
    max_distance: float = 0.25
    """Candidates farther apart, in L2 between label proportions, are no candidates (T_l; the paper: 0.75)."""
    doubt_margin: float = 0.05
    """Candidates within this of the best one make both doubtful (T_da; the paper: 0.2)."""
    max_scale: float = 4.0
    """Largest change of window size that follows the matched objects' scale."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SemanticOptions(_Checked):
    """Semantic area matching, SAM (paper, Sec. III-B)."""

    ignored_labels: tuple[int, ...] = ()
    """Labels that never form areas, as label 0 (void) never does."""
    objects: ObjectAreaOptions = field(default_factory=ObjectAreaOptions)
    """Object areas."""
    intersections: IntersectionAreaOptions = field(default_factory=IntersectionAreaOptions)
    """Intersection areas."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TileOptions(_Checked):
    """Tiles: a grid, paired by a first match of the whole images; no labels."""

    side_share: float = 0.4
    """Side of a tile, share of its image's long side, 0.05 to 1; its resolution at the matcher is area_size over it."""
    overlap_share: float = 0.1
    """Neighbouring tiles overlap by at least this share of their side (0: they touch; at most 0.9)."""
    min_matches: int = 10
    """Two tiles become a pair when at least this many whole-image matches join them (0: one is enough)."""
    max_pairs: int = 8
    """Most tile pairs per image pair, those with most matches first (0: no limit)."""
    verify: bool = True
    """Count only matches that agree with one robust geometry of the pair, where there is one (False: all)."""

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        self._within("side_share", 0.05, 1)
        self._within("overlap_share", 0, 0.9)


@dataclass(frozen=True, kw_only=True, slots=True)
class CovisibleOptions(_Checked):
    """Covisible: one area an image, where a first match of the whole images lies; no labels.

    Its crop has the larger of image_size and area_size: it replaces the whole image.
    """

    min_matches: int = 20
    """Fewest whole-image matches for an area (0: one is enough)."""
    quantile: float = 0.02
    """Share of the matches, weighted by score, left out at each side of the box (0: none; at most 0.45)."""
    margin: float = 0.1
    """Added on each side of the box, share of its long side (0: nothing)."""
    verify: bool = True
    """Enclose only matches that agree with one robust geometry of the pair, where there is one (False: all)."""

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        self._within("quantile", 0, 0.45)


@dataclass(frozen=True, kw_only=True, slots=True)
class GeometryOptions(_Checked):
    """Robust epipolar geometry of a pair."""

    threshold: float = 1.5
    """Threshold of the robust estimator, matcher pixels."""
    max_residual: float = 4.0
    """An inlier has r up to this."""
    tau: float = 9.0
    """Residuals are capped here before they are averaged."""
    min_matches: int = 15
    """Fewest matches that give a geometry."""
    max_iterations: int = 5000
    """Iterations of the robust estimator where a camera is unknown, and samples are seven matches."""
    max_iterations_calibrated: int = 1500
    """Iterations where both cameras are known, and samples are five: enough to find an inlier ratio of a third."""
    seed: int = 0
    """Seed of the robust estimator."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PredictionOptions(_Checked):
    """GP: the true matches among doubtful areas (paper, Sec. III-C1)."""

    enabled: bool = True
    """Resolve doubtful areas; otherwise they stay unmatched."""
    max_candidates: int = 16
    """Most candidate pairs matched per image pair."""
    dummy_cost: float = 0.8
    """Cost of leaving an area unmatched, share of tau."""
    min_lead: float = 0.1
    """Areas whose best choices differ by less than this share of the better one's cost stay unmatched."""
    max_enumerated: int = 4
    """Without confident matches, groups up to this many areas a side are enumerated."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RejectionOptions(_Checked):
    """GR: area matches that contradict the others (paper, Sec. III-C2)."""

    rule: Literal["consensus", "paper", "paper-literal", "none"] = "consensus"
    """`consensus`: one robust geometry judges all. `paper`: means, leave-one-out. `paper-literal`: Alg. 1 as printed,
    which rejects everything when phi < 1. `none`: keep all."""
    phi: float = 1.0
    """Weight of the threshold of the two paper rules (0.5 on ScanNet)."""
    max_pooled: int = 150
    """Most matches of one area in the pool that gives the consensus."""
    max_outlier_share: float = 0.5
    """An area with more outliers than this is rejected."""
    min_inliers: int = 15
    """An area with fewer inliers is rejected."""
    min_pool_inlier_ratio: float = 0.3
    """Below it the areas as a whole are not trusted and the pair falls back to the whole images."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CollectionOptions(_Checked):
    """GMC: matches of the whole images where areas cover too little (paper, Sec. III-C3)."""

    rule: Literal["capped", "paper", "paper-literal", "none"] = "capped"
    """Bound on r of a collected match. `capped`: max(2 mean, 1). `paper`: mean of the areas' means. `paper-literal`:
    mean of their sums. `none`: collect nothing."""
    min_coverage: float = 1.0
    """Collect when the kept areas cover less of either image (T_SP; the paper: 0.3, 0.6 on ScanNet). 1: always, which
    costs one whole-image match a pair and keeps images together that share more than their areas."""
    duplicate_px: float = 1.0
    """Matches nearer than this in both images are one; the finer stays."""
    covered_px: float = 8.0
    """A whole-image match is dropped when a finer one lies within this many of its own matcher pixels in both
    images."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GuidanceOptions(_Checked):
    """Guided areas: a second, finer round where the first one shows both images to overlap (not in the paper)."""

    enabled: bool = True
    """Look again; otherwise the first round is the result, as in the paper."""
    sure_matches: int = 60
    """So many consistent whole-image matches need no areas to find more evidence (0: areas always)."""
    sure_inlier_ratio: float = 0.5
    """And so large a share of all of them is consistent."""
    min_inlier_ratio: float = 0.35
    """Where a smaller share is, the images are taken to show different things, and nothing more is tried (0: it is);
    where matches are too few for a geometry, areas are."""
    max_chance: float = 0.1
    """Where they do not agree, area pairs are matched that whole-image matches join more often than chance: the largest
    probability of chance (1: all area pairs)."""
    min_overlap: float = 0.5
    """And of whose areas' matches, in either image, so large a share lies in both areas (0: any)."""
    evidence_size: int = 512
    """Long side of these areas' crops at the matcher, pixels, where area_size is larger."""
    evidence_pixels: int = 1_500_000
    """Their pixels per pair, both sides together, where max_crop_pixels is more; those with most support come first."""
    min_matches: int = 20
    """Fewest consistent matches for a window, and fewest matches by which areas are cut to what both images show."""
    quantile: float = 0.02
    """Share of the matches, by score, left out at each side of a window or cut area (0: none; at most 0.45)."""
    margin: float = 0.1
    """Added on each side of a window or cut area, share of its long side (0: nothing)."""
    min_agreement: float = 0.7
    """Share of the first round's consistent matches that the second one's geometry must explain; of one that put a
    place in two, those inside the areas that are left."""
    max_bend: float = 0.04
    """A window's crops are warped to look alike where its matches follow one affine map: the largest median distance
    from it, share of the window's long side (0: no crop is warped)."""
    min_gain: float = 1.1
    """Crops are to be finer than the first round's matches by at least this factor."""
    max_upsampling: float = 2.0
    """Small photos are enlarged: crops may be so many times as fine as whole images are seen, where the photos' own
    resolution is less (1: none is enlarged; 0: without limit)."""

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        self._is_upsampling("max_upsampling")


@dataclass(frozen=True, kw_only=True, slots=True)
class LookOptions(_Checked):
    """Photos taken sideways, aslant, from near and from far (not in the paper)."""

    enabled: bool = True
    """Where whole images do not agree well, look whether they do with the second one turned or one made smaller."""
    sure_matches: int = 150
    """So many consistent matches need no such look (0: always look)."""
    min_votes: int = 5
    """Fewest landmarks that agree on a turn and a change of size."""
    min_turn: int = 15
    """Smaller turns are left to the point matcher, degrees."""
    min_growth: float = 1.5
    """Smaller changes of size are left to the point matcher."""
    min_inliers: int = 25
    """Fewest consistent matches so seen."""
    min_lead: float = 1.5
    """And at least so many times those that the images have as they are."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SGAMOptions(_Checked):
    """All stages of the algorithm."""

    crop: CropOptions = field(default_factory=CropOptions)
    """Crops for the point matcher."""
    semantic: SemanticOptions = field(default_factory=SemanticOptions)
    """SAM."""
    tiles: TileOptions = field(default_factory=TileOptions)
    """The area matcher `tiles`."""
    covisible: CovisibleOptions = field(default_factory=CovisibleOptions)
    """The area matcher `covisible`."""
    looks: LookOptions = field(default_factory=LookOptions)
    """Turns in the image plane and changes of size."""
    geometry: GeometryOptions = field(default_factory=GeometryOptions)
    """Robust estimation."""
    prediction: PredictionOptions = field(default_factory=PredictionOptions)
    """GP."""
    rejection: RejectionOptions = field(default_factory=RejectionOptions)
    """GR."""
    collection: CollectionOptions = field(default_factory=CollectionOptions)
    """GMC."""
    guidance: GuidanceOptions = field(default_factory=GuidanceOptions)
    """Guided areas."""


def changed(options: Any, **changes: Any) -> Any:
    """A copy with nested fields changed, named with `__` for a dot: changed(options, crop__area_size=480)."""
    for path, value in changes.items():
        head, _, rest = path.partition("__")
        options = replace(options, **{head: changed(getattr(options, head), **{rest: value}) if rest else value})
    return options


PAPER = changed(
    SGAMOptions(),
    crop__area_size=480,
    crop__expand=1.0,
    crop__keep=1.0,
    crop__max_upsampling=0,
    crop__max_crop_pixels=0,
    semantic__intersections__min_labels=4,
    semantic__intersections__max_distance=0.75,
    semantic__intersections__doubt_margin=0.2,
    rejection__rule="paper",
    collection__rule="paper",
    collection__min_coverage=0.3,
    guidance__enabled=False,
    looks__enabled=False,
)
"""The paper's own parameters (its appendix), with GR in the form that can accept an area."""

SCANNET = changed(SGAMOptions(), crop__area_size=256, crop__image_size=640, collection__min_coverage=0.6)
"""Indoor frames of 640x480: areas of 256 px, T_SP 0.6 (the paper's sizes; our rules)."""

OUTDOOR = changed(SGAMOptions(), crop__area_size=480, collection__min_coverage=0.3)
"""Outdoor photos: areas of 480 px, T_SP 0.3 (the paper's sizes; our rules)."""

FAST = changed(
    SGAMOptions(),
    crop__area_size=512,
    crop__max_crop_pixels=1_000_000,
    semantic__objects__max_per_image=3,
    semantic__intersections__enabled=False,
    prediction__max_candidates=3,
    guidance__min_gain=1.2,
    guidance__max_upsampling=1.0,
)
"""At most half more time than whole images take: few areas, where whole images do not agree, and a second round only
where it is a fifth finer."""

PRESETS: Mapping[str, SGAMOptions] = MappingProxyType(
    {"default": SGAMOptions(), "fast": FAST, "paper": PAPER, "scannet": SCANNET, "outdoor": OUTDOOR}
)
