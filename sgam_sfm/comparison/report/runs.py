"""What the output folder of a method tells of its pairs; SIFT has a database only, the others raw matches too."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sgam_sfm.colmap.reading import read_counts, read_match_counts, read_pair_matches
from sgam_sfm.pairs import Pair
from sgam_sfm.runs.store import PairRecord, PairStore, read_pair_outcomes, read_pairs_of


@dataclass(frozen=True, kw_only=True, slots=True)
class PairFacts:
    """Of one pair. matches: raw. inliers: after COLMAP's verification. coverage: share of both images in kept areas."""

    matches: int = 0
    inliers: int = 0
    coverage: float | None = None
    fallback: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodRun:
    """The first seed of a method. content: its entry in compare.json. pairs: by names in alphabetical order."""

    number: int
    name: str
    folder: Path
    content: Mapping[str, Any]
    pairs: Mapping[Pair, PairFacts]

    @property
    def database(self) -> Path:
        """COLMAP's database, which a run that was stopped may lack."""
        return self.folder / "database.db"

    @property
    def model(self) -> Path | None:
        """The folder of the largest model."""
        folder = self.folder / "sparse" / "0"
        return folder if folder.is_dir() else None

    @property
    def has_areas(self) -> bool:
        """Whether any pair was matched by areas."""
        return any(facts.coverage is not None for facts in self.pairs.values())

    def facts(self, pair: Pair) -> PairFacts:
        """Of a pair, zeros where the method did not find it."""
        return self.pairs.get(pair, PairFacts())


class PairMatches(NamedTuple):
    """Raw matches of a pair, in pixels (M, 2) of the first and of the second image by name."""

    pair: Pair
    points0: Float[np.ndarray, "M 2"]
    points1: Float[np.ndarray, "M 2"]


def read_run(output: Path, number: int, content: Mapping[str, Any]) -> MethodRun:
    """The first seed of a method, from OUT/<slug>."""
    folder = output / content["slug"]
    inliers = _inliers(folder / "database.db")
    raw = {key(record.pair): _facts(record) for record in read_pairs_of(folder)}
    if not has_store(folder):
        raw = {pair: PairFacts(matches=count) for pair, count in _num_matches(folder / "database.db").items()}
    pairs = {
        pair: PairFacts(
            matches=facts.matches, inliers=inliers.get(pair, 0), coverage=facts.coverage, fallback=facts.fallback
        )
        for pair, facts in sorted(({pair: PairFacts() for pair in inliers} | raw).items())
    }
    return MethodRun(number=number, name=content["name"], folder=folder, content=content, pairs=pairs)


def has_store(folder: Path) -> bool:
    """Whether the run kept its raw matches."""
    return any((folder / "pairs").glob("*.h5"))


def read_matches(folder: Path, wanted: Collection[Pair]) -> Iterator[PairMatches]:
    """Raw matches of some pairs, a pair at a time."""
    if has_store(folder):
        store = PairStore(folder=folder / "pairs", fingerprint="")
        blocks = {outcome.block for outcome in read_pair_outcomes(folder) if key(outcome.pair) in wanted}
        for record in (record for block in sorted(blocks) for record in store.read(block)):
            if record.result is not None and key(record.pair) in wanted:
                matches = record.result.matches
                yield _ordered(record.pair, matches.points0, matches.points1)
    elif (folder / "database.db").is_file():
        for pair, points in read_pair_matches(folder / "database.db", sorted(wanted)):
            yield PairMatches(pair, *points)


def key(pair: Pair) -> Pair:
    """A pair in alphabetical order, since lists and databases order it differently."""
    name0, name1 = pair
    return (name0, name1) if name0 <= name1 else (name1, name0)


def _facts(record: PairRecord) -> PairFacts:
    result = record.result
    if result is None:
        return PairFacts()
    covered = (result.coverage0 + result.coverage1) / 2 if result.areas else None
    return PairFacts(matches=len(result.matches), coverage=covered, fallback=result.fallback)


def _inliers(database: Path) -> dict[Pair, int]:
    return {key(pair): count for pair, count in read_counts(database).inliers.items()} if database.is_file() else {}


def _num_matches(database: Path) -> dict[Pair, int]:
    return {key(pair): count for pair, count in read_match_counts(database).items()} if database.is_file() else {}


def _ordered(pair: Pair, points0: np.ndarray, points1: np.ndarray) -> PairMatches:
    return PairMatches(pair, points0, points1) if key(pair) == pair else PairMatches(key(pair), points1, points0)
