"""COLMAP's two-view verification: which matches of a pair agree with a geometry, and which pairs have enough."""

from __future__ import annotations

import sqlite3
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pycolmap

from sgam_core.errors import OptionError
from sgam_sfm.colmap.process import Progress, run, serve
from sgam_sfm.colmap.reading import require_database
from sgam_sfm.pairs import Pair
from sgam_sfm.repeating import repeating


@dataclass(frozen=True, kw_only=True, slots=True)
class VerificationOptions:
    """COLMAP's two-view verification; the defaults are COLMAP's own, but for the seed.

    max_error_px: of an inlier, in pixels of the images as they are. min_num_inliers: fewer and the pair is dropped.
    seed: of the robust estimation, the same for every pair. threads: -1 for all cores, which does not change the
    result.
    """

    max_error_px: float = 4.0
    min_num_inliers: int = 15
    seed: int = 0
    threads: int = -1

    def __post_init__(self) -> None:
        if self.max_error_px <= 0:
            raise OptionError(f"verification's max_error_px is {self.max_error_px}; expected more than 0 pixels")


@dataclass(frozen=True, kw_only=True, slots=True)
class VerificationSummary:
    """What verification left. inliers: their number for every verified pair. num_pairs: pairs that had matches."""

    inliers: Mapping[Pair, int]
    num_pairs: int
    seconds: float
    peak_memory_mb: float | None


def verify(
    database_path: Path,
    options: VerificationOptions | None = None,
    on_progress: Progress | None = None,
    log_path: Path | None = None,
    *,
    anew: bool = True,
) -> VerificationSummary:
    """Estimate the two-view geometry of every pair with matches and write it into the database.

    Args: anew: of pairs too that have one. log_path: takes COLMAP's own log, by default `colmap.log` beside the
        database.
    Raises: StageError when COLMAP fails or ends its process; InputError when there is no database.
    """
    require_database(database_path)
    job = {
        "database": str(database_path),
        "options": asdict(options or VerificationOptions()),
        "anew": anew,
    }
    result, seconds = run(__name__, "verification", job, log_path or database_path.parent / "colmap.log", on_progress)
    return VerificationSummary(
        inliers={(name0, name1): count for name0, name1, count in result["inliers"]},
        num_pairs=result["num_pairs"],
        seconds=seconds,
        peak_memory_mb=result["peak_memory_mb"],
    )


def _verify(job: dict[str, Any], send: Progress) -> dict[str, Any]:
    """Runs in the child process; see `process`."""
    options = VerificationOptions(**job["options"])
    with pycolmap.Database.open(job["database"]) as database:
        if job["anew"]:
            database.clear_two_view_geometries()  # COLMAP skips pairs that have one
        names = {image.image_id: image.name for image in database.read_all_images()}
        num_pairs = database.num_matched_image_pairs()
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = options.threads
    two_view = pycolmap.TwoViewGeometryOptions()
    two_view.min_num_inliers = options.min_num_inliers
    two_view.ransac.max_error = options.max_error_px
    two_view.ransac.random_seed = options.seed
    with _counting_rows(job["database"], "two_view_geometries", lambda done: send("verify", done, num_pairs)):
        pycolmap.geometric_verification(job["database"], verifier, two_view_geometry_options=two_view)
    with pycolmap.Database.open(job["database"]) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
    send("verify", num_pairs, num_pairs)
    pairs = [(*pycolmap.pair_id_to_image_pair(pair_id), count) for pair_id, count in zip(pair_ids, counts, strict=True)]
    return {
        "inliers": [[names[id0], names[id1], count] for id0, id1, count in sorted(pairs) if count > 0],
        "num_pairs": num_pairs,
    }


@contextmanager
def _counting_rows(database_path: str, table: str, report: Callable[[int], None]) -> Iterator[None]:
    """Report the growing number of rows, twice a second; verification itself has no callback."""
    address = f"{Path(database_path).resolve().as_uri()}?mode=ro"
    with closing(sqlite3.connect(address, uri=True, check_same_thread=False)) as database:

        def count() -> None:
            report(database.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])

        with repeating(count, 0.5):
            yield


if __name__ == "__main__":
    serve(_verify)
