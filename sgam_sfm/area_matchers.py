"""The area matchers that `--area-matcher` names."""

from sgam_core import AreaMatcher, SemanticAreaMatcher, SGAMOptions, WholeImages


def sgam(options: SGAMOptions) -> AreaMatcher:
    """Semantic areas with geometric consistency: the paper."""
    return SemanticAreaMatcher(options=options.semantic)


def none(options: SGAMOptions) -> AreaMatcher:
    """No areas: the point matcher on whole images, the baseline."""
    return WholeImages()
