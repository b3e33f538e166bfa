"""SGAM: semantic area-to-point matching with geometric consistency, as functions over immutable values."""

from sgam_core.a2pm import WholeImages, match_described, match_pair, match_whole
from sgam_core.covisible import CovisibleAreaMatcher
from sgam_core.options import PRESETS, SGAMOptions
from sgam_core.protocols import AreaMatcher, PointMatcher
from sgam_core.semantic import SemanticAreaMatcher, layout_labels
from sgam_core.tiles import TileAreaMatcher
from sgam_core.types import (
    Area,
    AreaMatch,
    AreaState,
    Box,
    Crop,
    Image,
    Matches,
    PairResult,
    PutativeAreas,
    TwoViewModel,
)

__all__ = [
    "PRESETS",
    "Area",
    "AreaMatch",
    "AreaMatcher",
    "AreaState",
    "Box",
    "CovisibleAreaMatcher",
    "Crop",
    "Image",
    "Matches",
    "PairResult",
    "PointMatcher",
    "PutativeAreas",
    "SGAMOptions",
    "SemanticAreaMatcher",
    "TileAreaMatcher",
    "TwoViewModel",
    "WholeImages",
    "layout_labels",
    "match_described",
    "match_pair",
    "match_whole",
]
