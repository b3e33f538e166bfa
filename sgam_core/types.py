"""The values that flow through the algorithm: immutable, checked when made.

Pixels are (x, y) with COLMAP's corner origin: the centre of the first pixel is (0.5, 0.5). The suffixes 0 and 1 name
the two images of a pair. Points are full-image pixels unless a name says `crop`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8

from sgam_core.errors import ShapeError
from sgam_core.landmarks import Landmarks, find_landmarks


@dataclass(frozen=True, kw_only=True, slots=True)
class Box:
    """A half-open rectangle [x0, x1) x [y0, y1) in pixels."""

    x0: float
    y0: float
    x1: float
    y1: float

    def __post_init__(self) -> None:
        if not (self.x0 < self.x1 and self.y0 < self.y1):
            raise ShapeError(f"box [{self.x0}, {self.x1}) x [{self.y0}, {self.y1}) is empty; expected x0 < x1, y0 < y1")

    @property
    def width(self) -> float:
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        return self.y1 - self.y0

    @property
    def area(self) -> float:
        return self.width * self.height

    @property
    def center(self) -> tuple[float, float]:
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def enlarged(self, factor: float) -> Box:
        """This box, `factor` times as wide and as high about the same centre."""
        (x, y), w, h = self.center, self.width * factor / 2, self.height * factor / 2
        return Box(x0=x - w, y0=y - h, x1=x + w, y1=y + h)

    def within(self, other: Box) -> Box:
        """The part of this box inside another one. Raises: ShapeError where they do not overlap."""
        x0, y0 = max(self.x0, other.x0), max(self.y0, other.y0)
        return Box(x0=x0, y0=y0, x1=min(self.x1, other.x1), y1=min(self.y1, other.y1))

    def times(self, sx: float, sy: float) -> Box:
        """This box in the pixels of an image that is sx times as wide and sy times as high."""
        return Box(x0=self.x0 * sx, y0=self.y0 * sy, x1=self.x1 * sx, y1=self.y1 * sy)

    def contains(self, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        """Which of the points (N, 2) lie inside."""
        x, y = points[:, 0], points[:, 1]
        inside: np.ndarray = (x >= self.x0) & (x < self.x1) & (y >= self.y0) & (y < self.y1)
        return inside


@dataclass(frozen=True, kw_only=True, eq=False)
class Image:
    """One image as the algorithm sees it.

    name: its key in caches and messages. pixels: (H, W, 3) RGB. mask: (H, W), True where matches are wanted.
    camera_matrix: (3, 3) pinhole matrix, corner origin, when the focal length is known.
    """

    name: str
    pixels: UInt8[np.ndarray, "H W 3"]
    mask: Bool[np.ndarray, "H W"] | None = None
    camera_matrix: Float[np.ndarray, "3 3"] | None = None

    def __post_init__(self) -> None:
        if self.pixels.ndim != 3 or self.pixels.shape[2] != 3 or self.pixels.dtype != np.uint8:
            raise ShapeError(
                f"image '{self.name}' is {self.pixels.dtype} {self.pixels.shape}; expected uint8 (height, width, 3) RGB"
            )
        if self.mask is not None and self.mask.shape != self.pixels.shape[:2]:
            raise ShapeError(
                f"mask of '{self.name}' is {self.mask.shape[0]}x{self.mask.shape[1]} but the image is "
                f"{self.height}x{self.width} (height x width); a mask has the image's own size"
            )

    @property
    def width(self) -> int:
        return int(self.pixels.shape[1])

    @property
    def height(self) -> int:
        return int(self.pixels.shape[0])

    @cached_property
    def gray(self) -> UInt8[np.ndarray, "H W"]:
        """Its luminance, found when first asked for."""
        gray: np.ndarray = cv2.cvtColor(self.pixels, cv2.COLOR_RGB2GRAY)
        return gray

    @cached_property
    def landmarks(self) -> Landmarks:
        """What tells how it lies and is sized against another image; found when first asked for."""
        return find_landmarks(self.gray, self.mask)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Crop:
    """A window of an image, resized and turned for a point matcher.

    window: whole pixels inside the image. size: (width, height) in the matcher's pixels, as it sees them. turns:
    quarter turns anticlockwise, 0 to 3. alike: things have one size in both crops of the pair, as far as an earlier
    round tells, so that a matcher which looks at several sizes may do with one. The resize is isotropic up to the
    rounding of `size`; `crop_from_image` is the exact affine map of what `pixels` and `gray` return.
    """

    image: Image
    window: Box
    size: tuple[int, int]
    turns: int = 0
    alike: bool = False

    @property
    def key(self) -> tuple[str | float, ...]:
        """Equal for crops with equal content: what a matcher may cache features by, within one collection."""
        w = self.window
        return (self.image.name, w.x0, w.y0, w.x1, w.y1, *self.size, self.turns, self.alike)

    @property
    def scale(self) -> float:
        """Matcher pixels per image pixel."""
        width, height = self._size_before_turns
        return min(width / self.window.width, height / self.window.height)

    @property
    def crop_from_image(self) -> Float[np.ndarray, "2 3"]:
        """Affine map (2, 3) from image to crop pixels: s * (p - origin), then the quarter turns."""
        width, height = self._size_before_turns
        sx, sy = width / self.window.width, height / self.window.height
        affine = np.array([[sx, 0.0, -sx * self.window.x0], [0.0, sy, -sy * self.window.y0]])
        for _ in range(self.turns):  # (x, y) becomes (y, width - x)
            affine = np.array([affine[1], [0.0, 0.0, width] - affine[0]])
            width, height = height, width
        return affine

    def turned(self, degrees: int) -> Crop:
        """The same crop turned anticlockwise by so much more; quarter turns leave its pixels what they are."""
        if degrees % 90:
            return _turned_about_its_centre(self, degrees)
        turns = degrees // 90
        size = self.size[::-1] if turns % 2 else self.size
        return replace(self, size=size, turns=(self.turns + turns) % 4)

    def contains(self, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        """Which points (N, 2), in crop pixels, lie on the crop."""
        inside: np.ndarray = np.all((points >= 0) & (points < self.size), axis=1)
        return inside

    def to_image(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Crop pixels (N, 2) to image pixels."""
        affine = self.crop_from_image
        moved = points - affine[:, 2]
        if self.turns % 2:
            return np.stack([moved[:, 1] / affine[1, 0], moved[:, 0] / affine[0, 1]], axis=1)
        image_points: np.ndarray = moved / affine[[0, 1], [0, 1]]
        return image_points

    def pixels(self) -> UInt8[np.ndarray, "h w 3"]:
        """The crop's own pixels (h, w, 3) RGB."""
        return self._seen(self.image.pixels)

    def gray(self) -> UInt8[np.ndarray, "h w"]:
        """Its own luminance (h, w), for matchers that want no colours: they are cropped three times as fast."""
        return self._seen(self.image.gray)

    def mask(self) -> Bool[np.ndarray, "h w"] | None:
        """The crop's mask (h, w), True where matches are wanted; None when the image has none."""
        if self.image.mask is None:
            return None
        mask = _resize(self._cut(self.image.mask).astype(np.uint8), self._size_before_turns, smooth=False)
        return self._turn(mask.astype(bool))

    @property
    def _size_before_turns(self) -> tuple[int, int]:
        return self.size[::-1] if self.turns % 2 else self.size

    def _seen(self, array: np.ndarray) -> np.ndarray:
        """What the crop shows of an array of the image's size."""
        return self._turn(_resize(self._cut(array), self._size_before_turns, smooth=True))

    def _turn(self, array: np.ndarray) -> np.ndarray:
        return np.rot90(array, self.turns).copy() if self.turns else array

    def _cut(self, array: np.ndarray) -> np.ndarray:
        w = self.window
        return array[int(w.y0) : int(w.y1), int(w.x0) : int(w.x1)]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class WarpedCrop(Crop):
    """A crop that is seen through any affine map, so that things look as they do in another image.

    image_from_crop: (2, 3), row by row, from what `pixels` returns. Outside the window, which is resized to the same
    size of things first, there is nothing: its pixels continue what is at the edge, and `mask` tells.
    """

    image_from_crop: tuple[float, float, float, float, float, float]

    @property
    def key(self) -> tuple[str | float, ...]:
        w = self.window
        return (self.image.name, w.x0, w.y0, w.x1, w.y1, *self.size, *self.image_from_crop, self.alike)

    @property
    def scale(self) -> float:
        a, b, _, c, d, _ = self.image_from_crop
        return abs(a * d - b * c) ** -0.5

    @property
    def crop_from_image(self) -> Float[np.ndarray, "2 3"]:
        return cv2.invertAffineTransform(self._affine)

    @property
    def _affine(self) -> Float[np.ndarray, "2 3"]:
        return np.reshape(self.image_from_crop, (2, 3))

    def turned(self, degrees: int) -> Crop:
        return _turned_about_its_centre(self, degrees) if degrees % 360 else self

    def contains(self, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        """Which points (N, 2), in crop pixels, lie on the crop where it shows its window."""
        return Crop.contains(self, points) & self.window.contains(self.to_image(points))

    def to_image(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        image_points: np.ndarray = points @ self._affine[:, :2].T + self._affine[:, 2]
        return image_points

    def mask(self) -> Bool[np.ndarray, "h w"]:
        mask = self._resized.mask()
        shown = np.ones(self._resized.size[::-1], np.uint8) if mask is None else mask.astype(np.uint8)
        return self._warp(shown, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT).astype(bool)

    def _seen(self, array: np.ndarray) -> np.ndarray:
        return self._warp(self._resized._seen(array), cv2.INTER_LINEAR, cv2.BORDER_REFLECT_101)

    @property
    def _resized(self) -> Crop:
        """The window, things as large in it as here on the whole."""
        size = (max(round(self.window.width * self.scale), 1), max(round(self.window.height * self.scale), 1))
        return Crop(image=self.image, window=self.window, size=size)

    def _warp(self, array: np.ndarray, interpolation: int, border: int) -> np.ndarray:
        whole = np.vstack([self._affine, [0, 0, 1]])
        affine = self._resized.crop_from_image @ whole
        affine[:, 2] += affine[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts from the centre of the first pixel
        return cv2.warpAffine(array, affine, self.size, flags=interpolation | cv2.WARP_INVERSE_MAP, borderMode=border)


def _turned_about_its_centre(crop: Crop, degrees: int) -> WarpedCrop:
    """All of a crop, turned anticlockwise, with nothing in the corners."""
    width, height = crop.size
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    sides = np.abs([[cosine, sine], [sine, cosine]]) @ crop.size
    size = (max(round(sides[0]), 1), max(round(sides[1]), 1))
    linear = cv2.invertAffineTransform(crop.crop_from_image)[:, :2] @ [[cosine, -sine], [sine, cosine]]
    [centre] = crop.to_image(np.array([[width / 2, height / 2]]))
    affine = np.column_stack([linear, centre - linear @ size / 2])
    image_from_crop = tuple(affine.ravel().tolist())
    return WarpedCrop(
        image=crop.image, window=crop.window, size=size, alike=crop.alike, image_from_crop=image_from_crop
    )


def _resize(array: np.ndarray, size: tuple[int, int], *, smooth: bool) -> np.ndarray:
    if size == (array.shape[1], array.shape[0]):
        return np.ascontiguousarray(array)
    shrinks = size[0] < array.shape[1] or size[1] < array.shape[0]
    method = cv2.INTER_NEAREST_EXACT if not smooth else cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    while smooth and _can_be_halved(array, size):
        array = cv2.resize(array, (array.shape[1] // 2, array.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(array, size, interpolation=method)


def _can_be_halved(array: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether an array has even sides, at least four times as long as `size` (width, height).

    Halving is many times as fast as other means of areas. The last step, from twice `size` or more, decides where
    things come to lie, to a few hundredths of a pixel.
    """
    height, width = array.shape[:2]
    return width % 2 == 0 == height % 2 and width >= 4 * size[0] and height >= 4 * size[1]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Matches:
    """Point matches of two images, or of two crops when a point matcher returns them.

    points0, points1: (M, 2) pixels. scores: (M,) in [0, 1]. sigmas0, sigmas1: (M,) image pixels per matcher pixel, the
    resolution at which each side was matched (1 when left out). area_index: (M,) row in the pair's areas, -1 for the
    whole image.
    """

    points0: Float[np.ndarray, "M 2"]
    points1: Float[np.ndarray, "M 2"]
    scores: Float[np.ndarray, " M"]
    sigmas0: Float[np.ndarray, " M"] = field(default=None)  # type: ignore[arg-type]
    sigmas1: Float[np.ndarray, " M"] = field(default=None)  # type: ignore[arg-type]
    area_index: Int32[np.ndarray, " M"] = field(default=None)  # type: ignore[arg-type]

    def __post_init__(self) -> None:
        count = len(self.points0)
        filled: dict[str, np.ndarray] = {
            "points0": np.asarray(self.points0, np.float64),
            "points1": np.asarray(self.points1, np.float64),
            "scores": np.asarray(self.scores, np.float32),
            "sigmas0": np.ones(count, np.float32) if self.sigmas0 is None else np.asarray(self.sigmas0, np.float32),
            "sigmas1": np.ones(count, np.float32) if self.sigmas1 is None else np.asarray(self.sigmas1, np.float32),
            "area_index": np.full(count, -1, np.int32)
            if self.area_index is None
            else np.asarray(self.area_index, np.int32),
        }
        for name, array in filled.items():
            expected = (count, 2) if name.startswith("points") else (count,)
            if array.shape != expected:
                raise ShapeError(f"{name} of matches has shape {array.shape}; expected {expected}")
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.points0)

    @property
    def sigmas(self) -> Float[np.ndarray, " M"]:
        """(M,) the coarser side of each match: what residuals are divided by."""
        return np.maximum(self.sigmas0, self.sigmas1)

    def select(self, rows: np.ndarray) -> Matches:
        """The given rows (indices or a mask), in their order."""
        return Matches(**{name: getattr(self, name)[rows] for name in _MATCH_FIELDS})

    def swapped(self) -> Matches:
        """The same matches with the two images exchanged."""
        return replace(self, points0=self.points1, points1=self.points0, sigmas0=self.sigmas1, sigmas1=self.sigmas0)

    @staticmethod
    def empty() -> Matches:
        return Matches(points0=np.zeros((0, 2)), points1=np.zeros((0, 2)), scores=np.zeros(0))

    @staticmethod
    def concatenate(parts: Sequence[Matches]) -> Matches:
        if not parts:
            return Matches.empty()
        return Matches(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in _MATCH_FIELDS})


_MATCH_FIELDS = ("points0", "points1", "scores", "sigmas0", "sigmas1", "area_index")


@dataclass(frozen=True, kw_only=True, slots=True)
class Area:
    """A region of one image that can be matched as a whole.

    kind: `object` (SOA), `intersection` (SIA), or what another area matcher calls its own. label: the object's label,
    None where the area holds several.
    """

    box: Box
    kind: str
    label: int | None = None


class AreaState(StrEnum):
    """What became of an area match."""

    KEPT = "kept"  # its point matches are in the result
    REJECTED = "rejected"  # GR found it inconsistent with the two-view geometry
    UNRESOLVED = "unresolved"  # doubtful, and GP could not or did not choose it
    SKIPPED = "skipped"  # never matched: a limit of the options was reached


@dataclass(frozen=True, kw_only=True, slots=True)
class AreaMatch:
    """Two areas that may show the same thing, and what the later stages said of them.

    distance: of their descriptors. predicted: chosen by GP among doubtful areas. scale0, scale1: matcher pixels per
    image pixel of the two crops (0 before they are cropped). num_matches, num_inliers: point matches inside, and those
    consistent with the pair's geometry.
    """

    area0: Area
    area1: Area
    distance: float
    predicted: bool = False
    state: AreaState = AreaState.KEPT
    reason: str = ""
    scale0: float = 0.0
    scale1: float = 0.0
    num_matches: int = 0
    num_inliers: int = 0

    def joins(self, matches: Matches) -> Bool[np.ndarray, " M"]:
        """Which matches, in image pixels, lie in both areas."""
        return self.area0.box.contains(matches.points0) & self.area1.box.contains(matches.points1)


@dataclass(frozen=True, kw_only=True, slots=True)
class PutativeAreas:
    """What an area matcher proposes: certain matches, and groups of doubtful candidates that exclude each other.

    notes: limits that were reached, for the report.
    """

    confident: tuple[AreaMatch, ...] = ()
    doubtful: tuple[tuple[AreaMatch, ...], ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TwoViewModel:
    """Robust epipolar geometry of a pair.

    F: (3, 3) maps image-0 points to image-1 lines, full-image pixels. calibrated: came from an essential matrix.
    num_inliers of num_matches; planarity: share of the inliers that a single homography explains as well (near 1 the
    geometry is unstable when not calibrated).
    """

    F: Float[np.ndarray, "3 3"]
    calibrated: bool
    num_inliers: int
    num_matches: int
    planarity: float

    @property
    def inlier_ratio(self) -> float:
        return self.num_inliers / max(self.num_matches, 1)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PairResult:
    """Everything that is known of a pair after matching.

    matches: in the image's own pixels. areas: every area match with its state and reason. two_view: the consensus
    geometry, None when there is none. coverage0, coverage1: share of each image inside kept areas. whole_scale0,
    whole_scale1: matcher pixels per image pixel of plain whole-image matching at the same options. fallback: why the
    whole images were matched instead of areas, empty when areas were used. notes: limits that were reached.
    pixels_matched: sum over both sides of every point-matcher call. turned: degrees anticlockwise by which the point
    matcher saw the second image turned. zoom: size at which it saw the second whole image over that of the first one,
    against plain matching: below 1 the second one was made smaller, above 1 the first one. seconds: by stage.
    """

    matches: Matches
    areas: tuple[AreaMatch, ...]
    two_view: TwoViewModel | None
    coverage0: float
    coverage1: float
    whole_scale0: float
    whole_scale1: float
    fallback: str = ""
    notes: tuple[str, ...] = ()
    pixels_matched: int = 0
    turned: int = 0
    zoom: float = 1.0
    seconds: Mapping[str, float] = field(default_factory=dict)
