"""SGAM over image collections, into COLMAP."""

from sgam_sfm.options import MatchOptions
from sgam_sfm.runner import match_collection

__all__ = ["MatchOptions", "match_collection"]
