"""Size a cluster: how long a collection takes on it, and what passes through network and disks, from a sample run.

    python scripts/size_cluster.py SAMPLE --images 100000 --workers 16 [--pairs-per-second 5]

SAMPLE: the output folder of a finished `sgam-sfm match` on photos like those of the collection, on the kind of machine
that the workers are. Blocks are handed to workers as `--executor ray` does it; workers read images from one file
server, one process writes, workers fail and come back. Prints JSON, without mapping, which does not follow from counts.
"""

from __future__ import annotations

import argparse
import heapq
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sgam_sfm.pairs import blocks
from sgam_sfm.runs.store import PairStore

SAMPLED_IMAGES = 4000  # that blocks are made of, to know how many pairs and images they have


@dataclass(frozen=True, kw_only=True)
class Costs:
    """What the sample cost. Seconds of one machine; the driver's are spent on one machine whatever the workers."""

    read_seconds_per_image: float
    label_seconds_per_image: float
    match_seconds_per_pair: float
    write_seconds_per_pair: float
    merge_seconds_per_pair: float
    verify_seconds_per_pair: float
    bytes_per_image: float
    label_bytes_per_image: float
    raw_bytes_per_pair: float
    database_bytes_per_pair: float
    worker_memory_mb: float


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """link_mb_s: of a worker to the file server, which gives server_mb_s in all. mtbf_hours: of one worker."""

    workers: int
    link_mb_s: float
    server_mb_s: float
    mtbf_hours: float
    restart_minutes: float


def main() -> None:
    """Read the costs, simulate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sample", type=Path)
    parser.add_argument("--images", type=int, required=True)
    parser.add_argument("--workers", type=int, required=True, help="one a GPU, or one for every --threads cores")
    parser.add_argument("--partners", type=int, default=20, help="images that each is paired with")
    parser.add_argument("--scene", type=int, default=0, help="partners are any of so many images (0: the next by name)")
    parser.add_argument("--block-images", type=int, default=8)
    parser.add_argument("--pairs-per-second", type=float, default=0.0, help="of one worker (0: as the sample)")
    parser.add_argument("--link-mb-s", type=float, default=100.0, help="of a worker's network (1 Gbit/s: 100)")
    parser.add_argument("--server-mb-s", type=float, default=1000.0, help="of the file server in all")
    parser.add_argument("--mtbf-hours", type=float, default=500.0, help="mean time between failures of a worker")
    parser.add_argument("--restart-minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()

    costs = measured(given.sample)
    if given.pairs_per_second:
        costs = replace(costs, match_seconds_per_pair=1 / given.pairs_per_second)
    cluster = Cluster(
        workers=given.workers,
        link_mb_s=given.link_mb_s,
        server_mb_s=given.server_mb_s,
        mtbf_hours=given.mtbf_hours,
        restart_minutes=given.restart_minutes,
    )
    rng = np.random.default_rng(given.seed)
    work = block_sizes(given.images, given.partners, given.scene, given.block_images, rng)
    print(
        json.dumps(
            {"costs": asdict(costs), "cluster": asdict(cluster)} | sized(costs, cluster, work, given.images, rng)
        )
    )


def measured(sample: Path) -> Costs:
    """The costs of a finished run; the writing of blocks is timed anew."""
    summary = json.loads((sample / "summary.json").read_text())
    options = json.loads((sample / "options.json").read_text())
    names = json.loads((sample / "inputs.json").read_text())["images"]
    seconds, pairs, images = summary["seconds"], summary["pairs"]["matched"], len(names)
    stored = sorted((sample / "pairs").glob("*.h5"))
    return Costs(
        read_seconds_per_image=seconds["Reading images"] / images,
        label_seconds_per_image=seconds.get("Segmenting images", 0.0) / images,
        match_seconds_per_pair=seconds["Matching pairs"] / pairs,
        write_seconds_per_pair=_writing(stored) / pairs,
        merge_seconds_per_pair=seconds["Merging keypoints"] / pairs,
        verify_seconds_per_pair=seconds["Verifying pairs"] / pairs,
        bytes_per_image=sum((Path(options["images"]) / name).stat().st_size for name in names) / images,
        label_bytes_per_image=sum(path.stat().st_size for path in (sample / "labels").rglob("*.png")) / images,
        raw_bytes_per_pair=sum(path.stat().st_size for path in stored) / pairs,
        database_bytes_per_pair=(sample / "database.db").stat().st_size / pairs,
        worker_memory_mb=summary["peak_memory_mb"]["matching"],
    )


def _writing(stored: Sequence[Path]) -> float:
    """CPU seconds to write all blocks of a store."""
    content = [list(PairStore(folder=path.parent, fingerprint="").read(int(path.stem))) for path in stored]
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()  # the machine may have other work
        for number, records in enumerate(content):
            PairStore(folder=Path(folder), fingerprint="").write(number, records)
        return time.process_time() - start


def block_sizes(images: int, partners: int, scene: int, block_images: int, rng: np.random.Generator) -> np.ndarray:
    """Pairs and images (B, 2) of every block of a collection; a sample of it is repeated."""
    count = min(images, SAMPLED_IMAGES)
    names = [f"{number:07d}" for number in range(count)]
    pairs = set()
    for first in range(count):
        reach = np.arange(1, partners // 2 + 1)
        if scene:
            begin = first // scene * scene
            others = rng.integers(begin, min(begin + scene, count), partners // 2)
        else:
            others = first + reach
        pairs |= {(names[min(first, other)], names[max(first, other)]) for other in others if other < count}
    pairs = {pair for pair in pairs if pair[0] != pair[1]}
    sizes = [(len(block), len({name for pair in block for name in pair})) for block in blocks(pairs, block_images)]
    return np.resize(np.array(sizes), (round(len(sizes) * images / count), 2))


def sized(costs: Costs, cluster: Cluster, work: np.ndarray, images: int, rng: np.random.Generator) -> dict:
    """Hours, rates and sizes."""
    pairs = int(work[:, 0].sum())
    rate = min(cluster.link_mb_s, cluster.server_mb_s / cluster.workers) * 1e6
    read = work[:, 1] * (costs.bytes_per_image + costs.label_bytes_per_image)
    spent = work[:, 0] * costs.match_seconds_per_pair + read / rate
    seconds, repeated, writing = simulated(spent, work[:, 0] * costs.write_seconds_per_pair, cluster, rng)
    hours = {
        "reading images (driver)": images * costs.read_seconds_per_image / 3600,
        "label maps (driver)": images * costs.label_seconds_per_image / 3600,
        "matching (workers)": seconds / 3600,
        "merging keypoints (driver)": pairs * costs.merge_seconds_per_pair / 3600,
        "verifying pairs (driver)": pairs * costs.verify_seconds_per_pair / 3600,
    }
    return {
        "pairs": pairs,
        "blocks": len(work),
        "pairs_per_block": pairs / len(work),
        "hours": hours,
        "pairs_per_second": pairs / seconds,
        "workers_busy": float(spent.sum() / seconds / cluster.workers),
        "repeated_blocks": repeated,
        "writer_busy": writing / seconds,
        "read_mb_s_per_worker": float(read.sum()) / 1e6 / seconds / cluster.workers,
        "read_mb_s_in_all": float(read.sum()) / 1e6 / seconds,
        "written_mb_s": pairs * costs.raw_bytes_per_pair / 1e6 / seconds,
        "images_gb": images * costs.bytes_per_image / 1e9,
        "label_maps_gb": images * costs.label_bytes_per_image / 1e9,
        "raw_results_gb": pairs * costs.raw_bytes_per_pair / 1e9,
        "database_gb": pairs * costs.database_bytes_per_pair / 1e9,
    }


def simulated(
    spent: np.ndarray, written: np.ndarray, cluster: Cluster, rng: np.random.Generator
) -> tuple[float, int, float]:
    """Seconds until the last block is written, blocks that were worked on again, and seconds of writing.

    Args: spent, written (B,): seconds of a worker and of the one writer for each block.
    """
    free = [(0.0, worker) for worker in range(cluster.workers)]
    fails = rng.exponential(cluster.mtbf_hours * 3600, cluster.workers)
    writer, repeated, todo = 0.0, 0, list(range(len(spent)))[::-1]
    while todo:
        block = todo.pop()
        now, worker = heapq.heappop(free)
        if now + spent[block] > fails[worker]:
            back = max(fails[worker], now) + cluster.restart_minutes * 60
            fails[worker] = back + rng.exponential(cluster.mtbf_hours * 3600)
            todo.append(block)
            repeated += 1
            heapq.heappush(free, (back, worker))
            continue
        heapq.heappush(free, (now + spent[block], worker))
        writer = max(writer, now + spent[block]) + written[block]
    return writer, repeated, float(written.sum())


if __name__ == "__main__":
    main()
