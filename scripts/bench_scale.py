"""Measure what follows matching on a synthetic collection: store, merge keypoints, write the database.

    python scripts/bench_scale.py --images 10000 --pairs 200000 --output scale.json

Everything but the networks runs. Their stand-in looks from above, on a grid of places with varying heights, headings
and overlap, at a hilly ground full of spots, and matches every image with its nearest: spots that both see, each time
off by some sub-pixel noise; points anywhere on the ground, that no other pair has; and outliers. No two pairs share a
grid of pixels. Every stage has a process of its own; seconds of the stand-in itself are not counted. FILE gets the
figures as JSON; the files of the run are made beside it and removed at the end (--keep DIR keeps them, and uses a store
that is there). The last line is a summary.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from sgam_core import Area, AreaMatch, Box, Matches, PairResult, TwoViewModel
from sgam_core.options import GeometryOptions
from sgam_sfm.colmap.database import write_database
from sgam_sfm.files import write_json
from sgam_sfm.hloc_files import write_keypoints_h5, write_matches_h5
from sgam_sfm.machine import peak_memory_mb
from sgam_sfm.merging.keypoints import CollectionKeypoints, KeypointOptions
from sgam_sfm.pairs import Pair, blocks
from sgam_sfm.runs.assembly import merged_records
from sgam_sfm.runs.store import PairRecord, PairStore

_STAGES = ("store", "merge")
_WIDTH, _HEIGHT, _FOCAL = 1024, 768, 900.0
_SIGMAS = (1.6, 0.8)  # image pixels per matcher pixel of the whole image and of areas
_SPOTS_IN_VIEW = 4000
_REACH = 0.7  # how far the centres of matched images are apart at most, in widths of an image on the ground
_ON_SPOTS, _OUTLIERS = 0.75, 0.1  # shares of the matches; the others are anywhere on the ground
_NOISE_PX = 0.2  # matcher pixels, in each direction


def main() -> None:
    """Run the stages, or the one that the parent process asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, required=True)
    parser.add_argument("--pairs", type=int, required=True)
    parser.add_argument("--matches", type=int, default=500, help="a pair, on average")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hloc", action="store_true", help="write keypoints.h5 and matches.h5 too")
    parser.add_argument("--keep", type=Path, help="folder for the files of the run, which stay; a store in it is used")
    parser.add_argument("--stage", choices=_STAGES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    scene = Scene(
        num_images=arguments.images, num_pairs=arguments.pairs, per_pair=arguments.matches, seed=arguments.seed
    )
    if arguments.stage:
        stages: dict[str, Callable[[], dict]] = {
            "store": lambda: store_stage(scene, arguments.keep),
            "merge": lambda: merge_stage(scene, arguments.keep, arguments.hloc),
        }
        print(json.dumps(stages[arguments.stage]()))
        return
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    folder = arguments.keep or Path(tempfile.mkdtemp(prefix="bench_scale_", dir=arguments.output.parent))
    try:
        figures: dict[str, dict] = {}
        for stage in _STAGES:
            command = [sys.executable, *sys.argv, "--stage", stage, "--keep", str(folder)]
            run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            figures |= json.loads(run.stdout.splitlines()[-1])
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder)
    content = {
        "images": arguments.images,
        "pairs": arguments.pairs,
        "matches": figures["read"]["matches"],
        "seed": arguments.seed,
        "stages": figures,
        "versions": {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "h5py", "pycolmap")},
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
    }
    write_json(arguments.output, content)
    print(summary_of(content))


def summary_of(content: dict) -> str:
    """One line."""
    parts = [
        f"{name} {stage['matches'] / stage['seconds'] / 1e6:.2f} M matches/s, "
        f"{stage['peak_mb'] / 1024:.2f} GiB, {stage['disk_bytes'] / 1e9:.2f} GB on disk"
        for name, stage in content["stages"].items()
    ]
    head = f"{content['images']} images, {content['pairs']} pairs, {content['matches'] / 1e6:.1f} M matches"
    return "; ".join([head, *parts])


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Places to look down from, and what is seen of the ground; lengths in widths of an image on the ground."""

    num_images: int
    num_pairs: int
    per_pair: int
    seed: int
    _ids: dict = field(default_factory=dict, repr=False)

    @cached_property
    def names(self) -> list[str]:
        """Of the images, along the rows of the grid."""
        return [f"strip/{row:06d}.jpg" for row in range(self.num_images)]

    @cached_property
    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """R (N, 3, 3) and centres (N, 3) in world coordinates; the ground is near z = 0 and cameras look down."""
        rng = np.random.default_rng([self.seed, 1])
        neighbours = 2 * self.num_pairs / self.num_images
        spacing = _REACH * np.sqrt(np.pi / neighbours)
        columns = int(np.ceil(np.sqrt(self.num_images)))
        row, column = np.divmod(np.arange(self.num_images), columns)
        centres = np.stack([column, row, np.zeros(len(row))], axis=1) * spacing
        centres[:, :2] += rng.normal(0, 0.15 * spacing, (len(row), 2))
        centres[:, 2] = _FOCAL / _WIDTH * rng.uniform(0.85, 1.15, len(row))
        yaw, tilt = rng.uniform(0, 2 * np.pi, len(row)), rng.normal(0, 0.05, (2, len(row)))
        zeros, ones = np.zeros(len(row)), np.ones(len(row))
        turn = np.array([[np.cos(yaw), np.sin(yaw), zeros], [np.sin(yaw), -np.cos(yaw), zeros], [zeros, zeros, -ones]])
        lean = np.array([[ones, zeros, tilt[0]], [zeros, ones, tilt[1]], [-tilt[0], -tilt[1], ones]])
        left, _, right = np.linalg.svd(lean.transpose(2, 0, 1) @ turn.transpose(2, 0, 1))
        return left @ right, centres

    @cached_property
    def spots(self) -> np.ndarray:
        """(S, 3) on the ground."""
        rng = np.random.default_rng([self.seed, 2])
        _, centres = self.cameras
        low, high = centres[:, :2].min(axis=0) - 1, centres[:, :2].max(axis=0) + 1
        count = int(_SPOTS_IN_VIEW * np.prod(high - low) * _WIDTH / _HEIGHT)
        return on_ground(rng.uniform(low, high, (count, 2)))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.spots[:, :2])

    @cached_property
    def pairs(self) -> list[Pair]:
        """The images that are nearest to each other."""
        _, centres = self.cameras
        wanted = min(4 * self.num_pairs // self.num_images + 4, self.num_images)
        distance, nearest = cKDTree(centres[:, :2]).query(centres[:, :2], wanted)
        rows = np.sort(np.stack([np.repeat(np.arange(len(nearest)), wanted), nearest.ravel()], axis=1), axis=1)
        order = np.lexsort((rows[:, 1], rows[:, 0], distance.ravel()))
        rows = rows[order][rows[order, 0] != rows[order, 1]]
        _, first = np.unique(rows, axis=0, return_index=True)
        chosen = rows[np.sort(first)[: self.num_pairs]]
        return [(self.names[a], self.names[b]) for a, b in chosen.tolist()]

    @cached_property
    def _row(self) -> dict[str, int]:
        return {name: row for row, name in enumerate(self.names)}

    def project(self, row: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (S, 2) of points (S, 3), and whether they are in the image."""
        rotations, centres = self.cameras
        rays = (points - centres[row]) @ rotations[row].T
        pixels = _FOCAL * rays[:, :2] / rays[:, 2:] + [_WIDTH / 2, _HEIGHT / 2]
        inside = ((pixels > 0) & (pixels < [_WIDTH, _HEIGHT])).all(axis=1)
        return pixels, inside

    def seen(self, row: int) -> np.ndarray:
        """The spots in an image, sorted."""
        _, centres = self.cameras
        near = np.sort(self._tree.query_ball_point(centres[row, :2], 0.85))
        _, inside = self.project(row, self.spots[near])
        return near[inside]

    def fundamental(self, row0: int, row1: int) -> np.ndarray:
        """F (3, 3) of two images."""
        rotations, centres = self.cameras
        inverse = np.linalg.inv(np.array([[_FOCAL, 0, _WIDTH / 2], [0, _FOCAL, _HEIGHT / 2], [0, 0, 1]]))
        relative = rotations[row1] @ rotations[row0].T
        x, y, z = rotations[row1] @ (centres[row0] - centres[row1])
        F = inverse.T @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative @ inverse
        return F / np.linalg.norm(F)


def on_ground(places: np.ndarray) -> np.ndarray:
    """Points (S, 3) of the hilly ground at (S, 2)."""
    x, y = places.T
    heights = 0.03 * np.sin(5 * x + 1) * np.cos(4 * y) + 0.01 * np.sin(23 * x + 17 * y)
    return np.column_stack([places, heights])


class StandIn:
    """Semi-dense matches of a scene, pair by pair; a pair's do not depend on the others."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.seen = lru_cache(64)(scene.seen)

    def match(self, pair: Pair) -> PairRecord:
        """What matching would have made of a pair."""
        scene = self._scene
        row0, row1 = (scene._row[name] for name in pair)
        rng = np.random.default_rng([scene.seed, 3, row0, row1])
        both = np.intersect1d(self.seen(row0), self.seen(row1), assume_unique=True)
        overlap = len(both) / _SPOTS_IN_VIEW  # the constants make the mean of all pairs what was asked for
        count = int(scene.per_pair * (0.64 + 1.16 * overlap))
        num_spots, num_outliers = min(int(_ON_SPOTS * count), len(both)), int(_OUTLIERS * count)
        spots = scene.spots[rng.choice(both, num_spots, replace=False)]
        base = scene.spots[rng.choice(both, count - num_spots)] if len(both) else np.zeros((0, 3))
        anywhere = on_ground(base[:, :2] + rng.normal(0, 0.01, (len(base), 2)))
        ground = np.concatenate([spots, anywhere])
        sigma = np.where(rng.random(len(ground)) < 0.4, _SIGMAS[1], _SIGMAS[0])
        scores = rng.beta(4, 2, len(ground))
        spread = np.where(rng.random(len(ground)) < 0.1, 3.0, 1.0) * _NOISE_PX * sigma
        points, inside = zip(*(scene.project(row, ground) for row in (row0, row1)), strict=True)
        points = np.stack(points) + rng.normal(size=(2, len(ground), 2)) * spread[:, None]
        wrong = rng.choice(len(ground), min(num_outliers, len(ground)), replace=False)
        points[1, wrong] = rng.uniform(0, [_WIDTH, _HEIGHT], (len(wrong), 2))
        scores[wrong] *= 0.6
        kept = inside[0] & inside[1] & (points > 0).all(axis=(0, 2)) & (points < [_WIDTH, _HEIGHT]).all(axis=(0, 2))
        matches = Matches(
            points0=points[0, kept],
            points1=points[1, kept],
            scores=scores[kept],
            sigmas0=sigma[kept],
            sigmas1=sigma[kept],
            area_index=np.where(sigma[kept] < 1, 0, -1).astype(np.int32),
        )
        area = Area(box=Box(x0=100.0, y0=100.0, x1=600.0, y1=500.0), kind="object", label=3)
        model = TwoViewModel(
            F=scene.fundamental(row0, row1),
            calibrated=False,
            num_inliers=len(matches) - len(wrong),
            num_matches=len(matches),
            planarity=0.5,
        )
        result = PairResult(
            matches=matches,
            areas=(AreaMatch(area0=area, area1=area, distance=0.1, scale0=1.25, scale1=1.25, num_matches=count),) * 3,
            two_view=model,
            coverage0=0.4,
            coverage1=0.4,
            whole_scale0=0.6,
            whole_scale1=0.6,
            pixels_matched=10**6,
        )
        return PairRecord(pair=pair, result=result)


def store_stage(scene: Scene, folder: Path) -> dict:
    """Write the matches of all pairs into the store, unless they are there."""
    store = PairStore(folder=folder / "pairs", fingerprint="bench")
    stand_in, count, seconds, cpu = StandIn(scene), 0, 0.0, 0.0
    work = blocks(scene.pairs)
    for number, block in enumerate(work):
        if store.has(number):
            continue
        records = [stand_in.match(pair) for pair in block]
        start = time.perf_counter(), time.process_time()
        store.write(number, records)
        seconds, cpu = seconds + time.perf_counter() - start[0], cpu + time.process_time() - start[1]
        count += sum(len(record.result.matches) for record in records if record.result)
    written = {
        "matches": count,
        "seconds": seconds,
        "cpu_seconds": cpu,
        "peak_mb": peak_memory_mb(),
        "disk_bytes": size_of(store.folder),
    }
    clock = Clock(folder)
    read = sum(len(record.result.matches) for record in store.read_all(len(work)) if record.result)
    return ({"store": written} if count else {}) | {"read": clock.figures(read)}


def merge_stage(scene: Scene, folder: Path, hloc: bool) -> dict:
    """Merge keypoints, then write the database, then hloc's files where they are asked for."""
    store = PairStore(folder=folder / "pairs", fingerprint="bench")
    num_blocks = len(blocks(scene.pairs))
    write_images(folder / "cameras.db", scene.names)
    figures = {}
    clock = Clock(folder)
    with merged_records(
        store.read_all(num_blocks), KeypointOptions(), GeometryOptions().max_residual, folder, folder
    ) as merged:
        figures["merge"] = clock.figures(merged.num_raw) | quality(merged)
        clock = Clock(folder)
        write_database(folder / "database.db", folder / "cameras.db", merged.keypoints, merged.matches)
        figures["database"] = clock.figures(merged.num_raw)
        if hloc:
            clock = Clock(folder)
            write_keypoints_h5(folder / "keypoints.h5", merged.keypoints)
            counts = {name: len(points) for name, points in merged.keypoints.items()}
            write_matches_h5(folder / "matches.h5", merged.matches, merged.scores, counts)
            figures["hloc"] = clock.figures(merged.num_raw)
    return figures


def quality(merged: CollectionKeypoints) -> dict:
    """What merging made of the matches."""
    return {
        "keypoints": sum(map(len, merged.keypoints.values())),
        "exported": sum(map(len, merged.matches.values())),
        "duplicates": merged.num_duplicates,
        "conflicts": merged.num_conflicts,
        "inconsistent": merged.num_inconsistent,
    }


class Clock:
    """Seconds, peak memory and disk from here on."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._before = folder, size_of(folder)
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
        self._start, self._cpu = time.perf_counter(), time.process_time()

    def figures(self, matches: int) -> dict:
        """What a stage took."""
        seconds, cpu = time.perf_counter() - self._start, time.process_time() - self._cpu
        return {
            "matches": matches,
            "seconds": seconds,
            "cpu_seconds": cpu,
            "peak_mb": peak_memory_mb(),
            "disk_bytes": size_of(self._folder) - self._before,
        }


def size_of(folder: Path) -> int:
    """Bytes of the files in a folder and below."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.exists() else 0


def write_images(path: Path, names: list[str]) -> None:
    """A database with the images and one camera, and nothing else."""
    path.unlink(missing_ok=True)
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", _FOCAL, _WIDTH, _HEIGHT)
        camera.camera_id = database.write_camera(camera)
        for name in names:
            database.write_image(pycolmap.Image(name=name, camera_id=camera.camera_id))


if __name__ == "__main__":
    main()
