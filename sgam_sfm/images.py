"""Read images, masks and label maps of a folder, in the geometry that COLMAP sees (EXIF orientation not applied)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageFile:
    """One image of a collection.

    name: POSIX path relative to the image folder, as in pairs.txt and in COLMAP. digest: SHA-256 of the file's bytes.
    """

    name: str
    path: Path
    width: int
    height: int
    digest: str
