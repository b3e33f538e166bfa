"""Results of pairs for tests that need any."""

from sgam_core import Matches, PairResult


def whole_images(matches: Matches, **more) -> PairResult:
    """Of a pair whose whole images were matched."""
    return PairResult(
        matches=matches, areas=(), two_view=None, coverage0=0, coverage1=0, whole_scale0=1, whole_scale1=1, **more
    )
