"""The paper's ablation on ScanNet scenes, with their own labels and with label-free areas side by side.

    python scripts/evaluate_scannet.py OUT SCENE [SCENE ...] [-- --max-pairs 60 ...]

SCENE: a folder with color/, pose/, intrinsics, and label/ or label-filt/ (depth/, when there is one, makes AOR and AMP
exact). Runs `sgam-sfm evaluate --ablation --preset scannet` on all pairs of each, once with its labels and once with
`coseg`, into OUT/<scene>_<labels>; options after `--` go to all. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from scenes import scene_options, split_options

COLUMNS = {
    "auc_5": "AUC@5",
    "auc_10": "@10",
    "auc_20": "@20",
    "mma_1": "MMA@1",
    "mma_3": "@3",
    "mma_1_at_640": "@1 at 640",
    "areas_all": "areas",
    "areas_after_gr": "after GR",
    "aor_all": "AOR",
    "amp_soa": "AMP SOA",
    "amp_sia": "SIA",
    "amp_gp": "GP",
    "amp_after_gr": "after GR",
    "fallbacks": "fallbacks %",
    "megapixels_matched": "Mpx",
}


def main() -> None:
    """Evaluate every scene twice, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    own, passed_on = split_options(sys.argv[1:])
    arguments = parser.parse_args(own)
    rows = [["scene", "labels", "variant", *COLUMNS.values()], ["---"] * (len(COLUMNS) + 3)]
    for scene in arguments.scenes:
        folder = next(path for name in ("label-filt", "label") if (path := scene / name).is_dir())
        for labels, options in (("its own", ["--labels", str(folder), "--resize-labels"]), ("coseg", [])):
            output = arguments.out / f"{scene.name}_{labels.replace(' ', '_')}"
            if not (output / "evaluate.json").exists():
                evaluate(scene, output, [*options, *passed_on])
            content = json.loads((output / "evaluate.json").read_text())
            for variant in content["variants"]:
                values = (variant["figures"].get(name) for name in COLUMNS)
                cells = ("" if value is None else f"{value:.1f}" for value in values)
                rows.append([f"{scene.name}, {content['num_pairs']} pairs", labels, variant["name"], *cells])
    print("\n".join("| " + " | ".join(row) + " |" for row in rows))


def evaluate(scene: Path, output: Path, options: list[str]) -> None:
    """One evaluation."""
    fixed = ["--ablation", "--preset", "scannet", *scene_options(scene), "--output", str(output)]
    command = [sys.executable, "-m", "sgam_sfm", "evaluate", *fixed, *options]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
