"""How many of the truly overlapping pairs retrieval keeps on three Strecha scenes mixed in one folder.

    python scripts/bench_retrieval.py DATA OUT [--min-overlap 0.3]

DATA: a folder with castle-P19, fountain-P11 and Herz-Jesus-P8, each with images/ and gt_dense_cameras/. Links their
images into OUT/images, segments them with coseg, and prints JSON: the recall at k = 5, 10 and 20 partners an image, of
the descriptor of `sgam-sfm pairs retrieval` and of the shares of coseg's labels, and what an oracle would keep.

A pair overlaps when both images are of one scene and `sgam_sfm.pair_lists.shared_view` scores it at least
--min-overlap: of the points that one image sees at a third, once and three times the depth of the scene, the share
that falls into the other image, the mean of both ways, for viewing directions at most 60 degrees apart. The depth is
where the optical axes of the scene's true cameras meet. Occlusion is not modelled. Images of two scenes never overlap.
"""

from __future__ import annotations

import argparse
import json
import platform
from importlib.metadata import version
from pathlib import Path

import numpy as np

from sgam_sfm.evaluation.ground_truth import read_ground_truth
from sgam_sfm.images import list_images
from sgam_sfm.options import SegmentOptions
from sgam_sfm.pair_lists.descriptors import coseg_descriptors, label_histograms
from sgam_sfm.pair_lists.options import Retrieval
from sgam_sfm.pair_lists.ranking import ScoreRows, best_partners, cosine_scores
from sgam_sfm.pair_lists.shared_view import shared_view_scores, typical_depth
from sgam_sfm.pairs import Pair
from sgam_sfm.progress import Stages
from sgam_sfm.segmentation import segment_collection

SCENES = ("castle-P19", "fountain-P11", "Herz-Jesus-P8")
PARTNERS = (5, 10, 20)
MAX_ROTATION_DEG = 60.0


def main() -> None:
    """Mix, describe, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--min-overlap", type=float, default=0.3)
    arguments = parser.parse_args()
    images, labels = mix(arguments.data, arguments.out / "images"), arguments.out / "labels"
    names, stages = list_images(images)[0], Stages()
    truth: dict[Pair, float] = {}
    depths = {}
    for scene in SCENES:
        overlaps, depths[scene] = true_overlaps(arguments.data / scene, arguments.min_overlap)
        truth |= {(f"{scene}/{a}", f"{scene}/{b}"): score for (a, b), score in overlaps.items()}
    segment_collection(SegmentOptions(images=images, output=labels, overlay_size=0), stages)
    options = Retrieval(images=images, output=arguments.out / "pairs.txt", cache=labels / "cache")
    described = {
        "coseg descriptor": coseg_descriptors(options, stages),
        "shares of coseg labels": label_histograms(labels, names, stages),
    }
    scores = {name: (found.names, cosine_scores(found.vectors)) for name, found in described.items()}
    content = {
        "images": len(names),
        "all_pairs": len(names) * (len(names) - 1) // 2,
        "min_overlap": arguments.min_overlap,
        "max_rotation_deg": MAX_ROTATION_DEG,
        "depth_m": {scene: round(depth, 2) for scene, depth in depths.items()},
        "overlapping_pairs": {scene: sum(a.startswith(f"{scene}/") for a, _ in truth) for scene in SCENES},
        "recall": {name: {f"k={k}": judge(*found, k, truth) for k in PARTNERS} for name, found in scores.items()},
        "oracle": {f"k={k}": judge(names, oracle(names, truth), k, truth) for k in PARTNERS},
        "machine": platform.machine(),
        "sgam_sfm": version("sgam-sfm"),
    }
    print(json.dumps(content, indent=2))


def mix(data: Path, folder: Path) -> Path:
    """Links to the images of all scenes, <scene>/<image>, in one folder."""
    for scene in SCENES:
        (folder / scene).mkdir(parents=True, exist_ok=True)
        for path in sorted((data / scene / "images").glob("*.jpg")):
            link = folder / scene / path.name
            link.unlink(missing_ok=True)
            link.symlink_to(path.resolve())
    return folder


def true_overlaps(scene: Path, min_overlap: float) -> tuple[dict[Pair, float], float]:
    """The overlapping pairs of a scene with their scores, and its depth."""
    truth = read_ground_truth(scene)
    names = sorted(truth.views)
    views = [truth.views[name] for name in names]
    depth = typical_depth(views)
    scores = shared_view_scores(views, depth, MAX_ROTATION_DEG)(np.arange(len(views)))
    rows = np.argwhere(np.triu(scores >= min_overlap, k=1)).tolist()
    return {(names[i], names[j]): float(scores[i, j]) for i, j in rows}, depth


def oracle(names: tuple[str, ...], truth: dict[Pair, float]) -> ScoreRows:
    """The true overlaps as scores."""
    row = {name: index for index, name in enumerate(names)}
    scores = np.full((len(names), len(names)), -np.inf, np.float32)
    for (a, b), score in truth.items():
        scores[row[a], row[b]] = scores[row[b], row[a]] = score
    return lambda rows: scores[rows]


def judge(names: tuple[str, ...], scores_of: ScoreRows, num: int, truth: dict[Pair, float]) -> dict[str, float]:
    """What the pairs of every image with its `num` best partners keep of the truth."""
    found = best_partners(np.arange(len(names)), scores_of, num, -1.0, lambda amount: None)
    kept = {(names[i], names[j]) for i, j in found.tolist()}
    return {
        "recall": round(len(kept & {*truth}) / len(truth), 3),
        "pairs": len(kept),
        "pairs_across_scenes": sum(a.split("/")[0] != b.split("/")[0] for a, b in kept),
    }


if __name__ == "__main__":
    main()
