"""Compare merged keypoints with rounding to cells, as hloc merges semi-dense matches, in COLMAP models.

    python scripts/bench_keypoints.py RAW IMAGES OUT [--cameras CAMERAS] [--cell-px 3]

RAW: the output folder of a run, such as one with `--area-matcher none`. Both variants get its raw matches, are verified
and mapped under OUT, and their figures are printed as JSON.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sgam_core.types import Matches
from sgam_sfm.colmap.database import write_database
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.colmap.mapping import map_images
from sgam_sfm.colmap.verification import verify
from sgam_sfm.merging.keypoints import KeypointOptions
from sgam_sfm.merging.merge import merge_keypoints
from sgam_sfm.runs.store import read_pairs_of

Pair = tuple[str, str]


def main() -> None:
    """Merge in both ways, map both, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("raw", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cameras", type=Path, help="known cameras, held fixed")
    parser.add_argument("--cell-px", type=float, default=1.0, help="hloc's cell and largest error, image pixels")
    parser.add_argument("--max-keypoints", type=int, default=8192, help="hloc's limit per image; 0 for none")
    arguments = parser.parse_args()

    pairs = read_raw(arguments.raw)
    names = sorted({name for pair in pairs for name in pair})
    arguments.out.mkdir(parents=True, exist_ok=True)
    imported = arguments.out / "cameras.db"
    cameras = import_cameras(imported, arguments.images, names, CameraOptions(cameras=arguments.cameras))

    def merged() -> tuple[Mapping[str, np.ndarray], Mapping[Pair, np.ndarray]]:
        result = merge_keypoints(pairs)
        return result.keypoints, result.matches

    def figures(variant: str) -> dict:
        start = time.perf_counter()
        keypoints, matches = (
            merged() if variant == "merged" else round_to_cells(pairs, arguments.cell_px, arguments.max_keypoints)
        )
        seconds = time.perf_counter() - start
        folder = arguments.out / variant
        folder.mkdir(exist_ok=True)
        write_database(folder / "database.db", imported, keypoints, matches)
        verify(folder / "database.db")
        mapped = map_images(
            folder / "database.db",
            arguments.images,
            folder / "sparse",
            known_camera_ids=cameras.known_camera_ids,
        )
        return {
            "keypoints": sum(map(len, keypoints.values())),
            "matches": sum(map(len, matches.values())),
            "merge_seconds": round(seconds, 2),
            "model": {k: v for k, v in asdict(mapped.models[0]).items() if k != "images"} if mapped.models else None,
        }

    print(
        json.dumps(
            {
                "raw_matches": sum(map(len, pairs.values())),
                "pairs": len(pairs),
                "options": asdict(KeypointOptions()),
                "cell_px": arguments.cell_px,
                "max_keypoints": arguments.max_keypoints,
                "versions": {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "pycolmap")},
                "machine": platform.processor() or platform.machine(),
                **{variant: figures(variant) for variant in ("cells", "merged")},
            },
            indent=2,
        )
    )


def read_raw(output: Path) -> dict[Pair, Matches]:
    """The raw matches of a finished run."""
    records = ((record.pair, record.result) for record in read_pairs_of(output))
    return {pair: result.matches for pair, result in records if result is not None and len(result.matches)}


def round_to_cells(
    pairs: Mapping[Pair, Matches], cell_px: float, max_keypoints: int
) -> tuple[dict[str, np.ndarray], dict[Pair, np.ndarray]]:
    """Merge as hloc's `match_dense` does when the cell is as large as the error it allows.

    One keypoint a cell, the `max_keypoints` with most score; each point goes to the nearest keypoint within the cell's
    size, and the best match of every keypoint of the first image stays. One-to-one in both images, which hloc means to
    be but is not: COLMAP's database refuses anything else here.
    """
    seen = defaultdict(list)
    for pair, m in pairs.items():
        for name, points in zip(pair, (m.points0, m.points1), strict=True):
            seen[name].append(np.column_stack([np.round(points / cell_px) * cell_px, m.scores]))
    keypoints = {}
    for name, votes in seen.items():
        table = np.concatenate(votes)
        cells, inverse = np.unique(table[:, :2], axis=0, return_inverse=True)
        score = np.bincount(inverse.reshape(-1), table[:, 2], len(cells))
        keypoints[name] = cells[np.argsort(-score, kind="stable")[: max_keypoints or None]]
    matches = {}
    for (a, b), m in pairs.items():
        (near0, index0), (near1, index1) = (
            cKDTree(keypoints[name]).query(points) for name, points in ((a, m.points0), (b, m.points1))
        )
        rows = np.column_stack([index0, index1])[np.argsort(-m.scores, kind="stable")]
        rows = rows[((near0 <= cell_px) & (near1 <= cell_px))[np.argsort(-m.scores, kind="stable")]]
        best = [np.isin(np.arange(len(rows)), np.unique(rows[:, side], return_index=True)[1]) for side in (0, 1)]
        matches[a, b] = rows[best[0] & best[1]]
    return keypoints, matches


if __name__ == "__main__":
    main()
