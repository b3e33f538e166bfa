"""Reconstruct a Strecha scene with and without areas and compare the poses with its ground truth.

    python scripts/bench_strecha.py SCENE OUT [-- --area-size 800 ...]

SCENE: a folder with images/, images/K.txt and gt_dense_cameras/ (such as fountain-P11). Runs `sgam-sfm match` with the
true intrinsics held fixed on all pairs, once with `--area-matcher sgam` and once with `none`, into OUT; options after
`--` go to both. Prints JSON and a Markdown table: registered images, pose AUC over all pairs at 0.5, 1 and 3 degrees
(the larger of rotation and translation-direction error; pairs without poses count as 180), points, distinct images a
track, reprojection error, seconds by stage, peak memory.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own)
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from sgam_sfm.exit_codes import DONE

ANGLES = (0.5, 1.0, 3.0)


def main() -> None:
    """Run both methods and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("options", nargs="*")
    arguments = parser.parse_args()
    figures = {
        method: run(arguments.scene, arguments.out / method, method, arguments.options) for method in ("sgam", "none")
    }
    print(json.dumps({"scene": arguments.scene.name, "machine": platform.machine(), "methods": figures}, indent=2))
    print(table(arguments.scene.name, figures))


def run(scene: Path, output: Path, method: str, options: list[str]) -> dict:
    """One method's figures."""
    K = np.loadtxt(scene / "images" / "K.txt").reshape(3, 3)
    params = ",".join(str(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    camera = ["--camera-model", "PINHOLE", "--camera-params", params, "--camera-mode", "single"]
    files = ["--images", str(scene / "images"), "--output", str(output)]
    command = [sys.executable, "-m", "sgam_sfm", "match", *files, "--area-matcher", method, *camera, *options]
    code = subprocess.run(command, check=False).returncode  # a process of its own, for its peak memory
    summary = json.loads((output / "summary.json").read_text())
    model = summary["models"][0] if code == DONE else {}
    errors = pose_errors(output / "sparse" / "0", scene) if model else np.full(1, 180.0)
    return {
        "exit_code": code,
        "registered": [model.get("registered", 0), summary["images"]["used"]],
        "pose_auc": {str(angle): round(auc(errors, angle), 1) for angle in ANGLES},
        "points": model.get("points"),
        "images_per_track": model.get("mean_images_per_track"),
        "reprojection_error_px": model.get("mean_reprojection_error_px"),
        "verified_pairs": summary["pairs"]["verified"],
        "pixels_matched": summary["pairs"]["pixels_matched"],
        "seconds": summary["seconds"],
        "peak_memory_mb": summary["peak_memory_mb"],
        "versions": summary["versions"],
    }


def pose_errors(model: Path, scene: Path) -> np.ndarray:
    """Relative pose error of every pair of images, degrees."""
    found = {image.name: image.cam_from_world().matrix() for image in pycolmap.Reconstruction(model).images.values()}
    truth = {}
    for path in sorted((scene / "gt_dense_cameras").glob("*.camera")):
        values = np.array(path.read_text().split(), float)
        R = values[12:21].reshape(3, 3).T
        truth[path.name.removesuffix(".camera")] = np.column_stack([R, -R @ values[21:24]])
    return np.array(
        [
            relative_error(found[a], found[b], truth[a], truth[b]) if a in found and b in found else 180.0
            for a, b in combinations(sorted(truth), 2)
        ]
    )


def relative_error(found0: np.ndarray, found1: np.ndarray, true0: np.ndarray, true1: np.ndarray) -> float:
    """The larger of rotation and translation-direction error between two views, degrees; poses are (3, 4)."""
    (R, t), (R_true, t_true) = relative(found0, found1), relative(true0, true1)
    rotation = np.arccos(np.clip((np.trace(R.T @ R_true) - 1) / 2, -1, 1))
    direction = np.arccos(np.clip(t @ t_true / np.linalg.norm(t) / np.linalg.norm(t_true), -1, 1))
    return float(np.degrees(max(rotation, direction)))


def relative(pose0: np.ndarray, pose1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation from camera 0 to camera 1."""
    R = pose1[:, :3] @ pose0[:, :3].T
    return R, pose1[:, 3] - R @ pose0[:, 3]


def auc(errors: np.ndarray, angle: float) -> float:
    """Exact area under the recall curve up to `angle`, percent."""
    errors = np.sort(errors)
    recall = np.arange(1, len(errors) + 1) / len(errors)
    below = int(np.searchsorted(errors, angle))
    x = np.concatenate([[0.0], errors[:below], [angle]])
    y = np.concatenate([[0.0], recall[:below], [recall[below - 1] if below else 0.0]])
    return float(100 * np.trapezoid(y, x) / angle)


def table(scene: str, figures: dict) -> str:
    """The figures as rows of a Markdown table."""
    rows = [
        "| scene | areas | registered | AUC@0.5 / 1 / 3 | points | images a track | reproj. px | matching s | peak MB |"
    ]
    rows.append("|---|---|---|---|---|---|---|---|---|")
    for method, f in figures.items():
        auc_text = " / ".join(f"{value:.1f}" for value in f["pose_auc"].values())
        rows.append(
            f"| {scene} | {method} | {f['registered'][0]}/{f['registered'][1]} | {auc_text} | {f['points']} | "
            f"{f['images_per_track']:.2f} | {f['reprojection_error_px']:.3f} | {f['seconds']['Matching pairs']:.0f} | "
            f"{f['peak_memory_mb']['matching']:.0f} |"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    main()
