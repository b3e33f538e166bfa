"""The area matchers that `--area-matcher` names."""

from sgam_core import (
    AreaMatcher,
    CovisibleAreaMatcher,
    SemanticAreaMatcher,
    SGAMOptions,
    TileAreaMatcher,
    WholeImages,
)


def sgam(options: SGAMOptions) -> AreaMatcher:
    """Semantic areas with geometric consistency: the paper."""
    return SemanticAreaMatcher(options=options.semantic)


def tiles(options: SGAMOptions) -> AreaMatcher:
    """A grid of tiles, paired by a first match of the whole images: a baseline without labels."""
    return TileAreaMatcher(options=options.tiles, geometry=options.geometry)


def covisible(options: SGAMOptions) -> AreaMatcher:
    """What a first match shows in both images, matched again: a baseline without labels."""
    return CovisibleAreaMatcher(options=options.covisible, geometry=options.geometry)


def none(options: SGAMOptions) -> AreaMatcher:
    """No areas: the point matcher on whole images, the baseline."""
    return WholeImages()
