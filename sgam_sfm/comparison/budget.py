"""The same price: sizes at which a method matches as many pixels as another one does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgam_core import AreaMatcher, Image, Matches
from sgam_core.crops import area_crop, whole_crop
from sgam_core.guidance import most_enlarged
from sgam_core.options import CropOptions
from sgam_core.types import Box, Crop, PutativeAreas
from sgam_sfm.images import ImageFile
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair

_SMALLEST = 64

Cut = Callable[[Image, Box, CropOptions], Crop]


@dataclass(frozen=True, kw_only=True, slots=True)
class Budget:
    """What a budget led to. target, reached: pixels matched over all pairs. cap: why it was not met."""

    options: MatchOptions
    target: int
    reached: int
    cap: str = ""


def fit_budget(
    options: MatchOptions,
    images: Mapping[str, ImageFile],
    pairs: Sequence[Pair],
    target: int,
    area_matcher: AreaMatcher,
    whole_matches: Mapping[Pair, Matches],
    max_image_size: int,
) -> Budget:
    """The options with the size of whole images, or of areas, at which `target` pixels are matched over all pairs.

    Either is enlarged as far as guided areas may be.

    Args: whole_matches: of the pairs at the options' image size, for area matchers that start from them; without areas
        they are not looked at. max_image_size: the largest size that memory allows for a whole image.
    """
    cut: Cut = getattr(area_matcher, "crop", area_crop)
    blank = {name: _blank(file) for name, file in images.items()}
    proposed = {
        (a, b): _propose(area_matcher, blank[a], blank[b], whole_matches.get((a, b), Matches.empty())) for a, b in pairs
    }
    native = max(max(file.width, file.height) for file in images.values())
    enlarged = most_enlarged(native, options.crop, options.guidance)
    finest = round(native * enlarged)
    limit = "the images' own resolution" if enlarged == 1 else f"{enlarged:g} times the images' own resolution"
    name, largest = "area_size", finest
    if not any(areas.confident or areas.doubtful for areas in proposed.values()):
        name, largest = "image_size", min(finest, max_image_size)
        limit = limit if largest == finest else "--budget-image-size"

    def crop_options(size: int) -> CropOptions:
        crop = replace(options.crop, max_crop_pixels=0)
        if name == "area_size":
            return replace(crop, area_size=size, max_upsampling=enlarged)
        return replace(crop, image_size=size, max_whole_upsampling=enlarged)

    def pixels(size: int) -> int:
        crops = crop_options(size)
        return sum(_pixels(blank[a], blank[b], proposed[a, b], cut, crops) for a, b in pairs)

    size = _largest_within(target, pixels, _SMALLEST, largest)
    reached = pixels(size)
    cap = ""
    if size == largest and reached < 0.98 * target:
        cap = f"capped at {limit} ({name.replace('_', '-')} {size})"
    elif reached > 1.02 * target:
        cap = f"it takes {reached / target:.0%} of it at least"
    return Budget(
        options=replace(options, crop=crop_options(size)),
        target=target,
        reached=reached,
        cap=cap,
    )


def _largest_within(target: int, pixels: Callable[[int], int], low: int, high: int) -> int:
    """The largest size whose pixels do not exceed the target; the smallest one when all do."""
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if pixels(middle) <= target else (low, middle - 1)
    return low


def _blank(file: ImageFile) -> Image:
    """An image of that size that takes no memory."""
    return Image(name=file.name, pixels=np.broadcast_to(np.uint8(0), (file.height, file.width, 3)))


def _propose(area_matcher: AreaMatcher, image0: Image, image1: Image, whole: Matches) -> PutativeAreas:
    described = (area_matcher.describe(image0, None), area_matcher.describe(image1, None))
    return area_matcher.match(*described, lambda: whole)


def _pixels(image0: Image, image1: Image, areas: PutativeAreas, cut: Cut, options: CropOptions) -> int:
    """Pixels of both sides that the point matcher sees of a pair: the whole images, and the crops of all areas."""
    matched = [*areas.confident, *(area for group in areas.doubtful for area in group)]
    crops = [whole_crop(image0, options), whole_crop(image1, options)]
    for area in matched:
        crops += [cut(image0, area.area0.box, options), cut(image1, area.area1.box, options)]
    return sum(map(_size, crops))


def _size(crop: Crop) -> int:
    return crop.size[0] * crop.size[1]
