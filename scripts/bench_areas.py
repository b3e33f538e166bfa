"""Time area detection and description per image, and area matching per pair, on one core at 640 wide.

    python scripts/bench_areas.py LABELS [--repeats 20]

LABELS: a folder of label maps, such as OUT/labels of a run. Prints JSON; the paper's own area matching takes 620 ms a
pair on the authors' machine, most of it detection and description.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from sgam_core import Image, SemanticAreaMatcher, layout_labels
from sgam_sfm.images import read_label_map


def main() -> None:
    """Read the label maps, time both steps, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--repeats", type=int, default=20)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    matcher = SemanticAreaMatcher()
    maps = {path.name: layout_labels(read_label_map(path)) for path in sorted(arguments.labels.rglob("*.png"))}
    images = {name: Image(name=name, pixels=np.zeros((*labels.shape, 3), np.uint8)) for name, labels in maps.items()}

    def milliseconds(calls: list) -> list[float]:
        found = []
        for _ in range(arguments.repeats):
            for call in calls:
                start = time.perf_counter()
                call()
                found.append(1e3 * (time.perf_counter() - start))
        return found

    describe = milliseconds([lambda n=name: matcher.describe(images[n], maps[n]) for name in maps])
    described = {name: matcher.describe(images[name], maps[name]) for name in maps}
    match = milliseconds(
        [lambda a=a, b=b: matcher.match(described[a], described[b]) for a, b in combinations(sorted(maps), 2)]
    )
    figures = {
        step: {"median_ms": float(np.median(times)), "p95_ms": float(np.percentile(times, 95)), "max_ms": max(times)}
        for step, times in (("describe_per_image", describe), ("match_per_pair", match))
    }
    print(json.dumps({"images": len(maps), "machine": platform.processor() or platform.machine(), **figures}, indent=2))


if __name__ == "__main__":
    main()
