"""Point matches of crops on disk, so that what several methods or seeds ask for is computed once."""

from __future__ import annotations

import hashlib
import logging
import time
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sgam_core import Crop, Matches, PointMatcher
from sgam_core.errors import SGAMError
from sgam_sfm.files import replacing
from sgam_sfm.inputs import Inputs
from sgam_sfm.options import MatchOptions, fingerprint_of_points
from sgam_sfm.runs.matching import create_matcher, is_repeatable, reset

_log = logging.getLogger(__name__)


@dataclass
class CachedMatcher:
    """A point matcher (`sgam_core.protocols.PointMatcher`) that looks its results up before it computes them.

    A result that is looked up is charged with the seconds that it cost when it was computed, so that the run time of a
    method does not depend on what ran before it.

    digests: of the images' files, by name. key: of the point matcher, its options and masks. folder: of the results.
    charged: seconds that all results cost since `start`; saved: those of them that were not spent again. crops: pixels
    of the different crops asked for since `start`.
    """

    matcher: PointMatcher
    digests: Mapping[str, str]
    key: str
    folder: Path
    charged: float = 0.0
    saved: float = 0.0
    crops: dict[tuple, int] = field(default_factory=dict)

    @staticmethod
    def of(options: MatchOptions, inputs: Inputs, folder: Path) -> CachedMatcher:
        """The point matcher of the options, for these images."""
        return CachedMatcher(create_matcher(options), inputs.digests, fingerprint_of_points(options), folder)

    def start(self) -> None:
        """Begin to count anew."""
        self.charged = self.saved = 0.0
        self.crops.clear()

    @property
    def repeatable(self) -> bool:
        """Whether what a pair gives does not depend on what was matched before it."""
        return is_repeatable(self.matcher)

    def reset(self) -> None:
        """Forget what the point matcher has in memory."""
        reset(self.matcher)

    @property
    def pixels_extracted(self) -> int:
        """Pixels of all different crops asked for, each counted once."""
        return sum(self.crops.values())

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        """Match every pair of crops; see `PointMatcher.match`."""
        for pair in pairs:
            self.crops |= {crop.key: crop.size[0] * crop.size[1] for crop in pair}
        paths = [self._path(*pair) for pair in pairs]
        kept = {row: result for row, path in enumerate(paths) if (result := _read(path)) is not None}
        missing = [row for row in range(len(pairs)) if row not in kept]
        if missing:
            start = time.perf_counter()
            computed = self.matcher.match([pairs[row] for row in missing])
            seconds = time.perf_counter() - start
            pixels = np.array([sum(crop.size[0] * crop.size[1] for crop in pairs[row]) for row in missing], float)
            for row, matches, share in zip(missing, computed, pixels / pixels.sum(), strict=True):
                _write(paths[row], matches, seconds * share)
                kept[row] = (matches, seconds * share)
            self.saved -= seconds
        found = [kept[row] for row in range(len(pairs))]
        cost = sum(seconds for _, seconds in found)
        self.charged += cost
        self.saved += cost
        return [matches for matches, _ in found]

    def _path(self, crop0: Crop, crop1: Crop) -> Path:
        sides = [(self.digests[crop.image.name], *crop.key[1:]) for crop in (crop0, crop1)]
        name = hashlib.sha256(repr((self.key, sides)).encode()).hexdigest()[:32]
        return self.folder / name[:2] / f"{name}.npz"


def _write(path: Path, matches: Matches, seconds: float) -> None:
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(
            file,
            points0=matches.points0,
            points1=matches.points1,
            scores=matches.scores,
            sigmas0=matches.sigmas0,
            sigmas1=matches.sigmas1,
            seconds=np.array(seconds),
        )


def _read(path: Path) -> tuple[Matches, float] | None:
    """None when there is none, or the disk has damaged it."""
    try:
        with path.open("rb") as stored, np.load(stored, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
        seconds = float(content.pop("seconds"))
        return Matches(**content), seconds
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, SGAMError) as error:
        _log.warning("'%s' is damaged (%s), and is matched again", path, error)
        return None
