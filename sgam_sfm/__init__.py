"""SGAM over image collections, into COLMAP."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgam_sfm.options import MatchOptions
    from sgam_sfm.runs.runner import match_collection

__all__ = ["MatchOptions", "match_collection"]

_HOMES = {"MatchOptions": "sgam_sfm.options", "match_collection": "sgam_sfm.runs.runner"}


def __getattr__(name: str) -> Any:
    # Imported when asked for: COLMAP's child process and `--help` need little of what these bring.
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
