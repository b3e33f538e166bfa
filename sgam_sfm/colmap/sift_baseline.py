"""COLMAP's own SIFT features and matches, the baseline that others are compared with."""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pycolmap

from sgam_core.errors import InputError
from sgam_sfm.colmap.process import Progress, run, serve
from sgam_sfm.colmap.reading import require_database
from sgam_sfm.colmap.verification import VerificationOptions
from sgam_sfm.pairs import Pair


def match_sift(
    database_path: Path,
    image_folder: Path,
    pairs: Sequence[Pair],
    options: VerificationOptions | None = None,
    on_progress: Progress | None = None,
    log_path: Path | None = None,
) -> float:
    """COLMAP's own SIFT features and matches of the pairs, into a database whose images and cameras are imported.

    Returns: the seconds it took. Features and matcher have COLMAP's defaults; `verify` comes afterwards, as after any
        other matches.
    Raises: StageError when COLMAP fails or ends its process; InputError for names that its pair list cannot hold.
    """
    require_database(database_path)
    pair_list = database_path.with_name("sift_pairs.txt")
    spaced = [name for pair in pairs for name in pair if len(name.split()) > 1]
    if spaced:
        raise InputError(f"image name '{spaced[0]}' has a space, which COLMAP's pair list cannot hold; leave out sift")
    pair_list.write_text("".join(f"{name0} {name1}\n" for name0, name1 in pairs), encoding="utf-8")
    job = {
        "database": str(database_path),
        "images": str(image_folder),
        "pairs": str(pair_list),
        "options": asdict(options or VerificationOptions()),
    }
    return run(__name__, "SIFT", job, log_path or database_path.parent / "colmap.log", on_progress)[1]


def _sift(job: dict[str, Any], send: Progress) -> dict[str, Any]:
    """Runs in the child process; see `process`."""
    options = VerificationOptions(**job["options"])
    with pycolmap.Database.open(job["database"]) as database:
        names = [image.name for image in database.read_all_images()]
        database.clear_two_view_geometries()
        database.clear_matches()
        database.clear_descriptors()
        database.clear_keypoints()
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = options.threads
    cpu = pycolmap.Device.cpu  # GPU SIFT gives other features on every run
    send("extract", 0, len(names))
    pycolmap.extract_features(job["database"], job["images"], names, extraction_options=extraction, device=cpu)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = job["pairs"]
    two_view = pycolmap.TwoViewGeometryOptions()
    two_view.ransac.random_seed = options.seed
    send("match", 0, 0)
    pycolmap.match_image_pairs(job["database"], matching, pairing, verification_options=two_view, device=cpu)
    return {}


if __name__ == "__main__":
    serve(_sift)
