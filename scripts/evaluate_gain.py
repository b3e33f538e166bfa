"""What areas gain over the same point matcher on whole images: two-view poses and matches, scene by scene.

    python scripts/evaluate_gain.py OUT SCENE [SCENE ...] [--matchers xfeat-star sift ...] [-- --max-pairs 60 ...]

SCENE: a Strecha or ScanNet folder, see `scenes.py`. Runs `sgam-sfm evaluate` of each matcher on each scene into
OUT/<scene>_<matcher>; options after `--` go to all, and what is there is not run again. Prints a Markdown table; `gap`
is the share of the distance from the plain matcher to 100 that areas close.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from scenes import scene_options, split_options

COLUMNS = {
    "auc_0.5": "AUC@0.5",
    "auc_1": "@1",
    "auc_5": "@5",
    "mma_1": "MMA@1",
    "mma_3": "@3",
    "matches": "matches",
    "megapixels_matched": "Mpx",
    "fallbacks": "fallbacks %",
}
GAPS = ("auc_1", "mma_1")


def main() -> None:
    """Evaluate what is missing, print the table."""
    own, passed_on = split_options(sys.argv[1:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--matchers", nargs="+", default=["xfeat-star"])
    arguments = parser.parse_args(own)
    gaps = [f"gap {COLUMNS[figure]}" for figure in GAPS]
    rows = [["scene", "matcher", "images", *COLUMNS.values(), *gaps, "s a pair"]]
    rows.append(["---"] * len(rows[0]))
    for matcher in arguments.matchers:
        for scene in arguments.scenes:
            output = arguments.out / f"{scene.name}_{matcher}"
            if not (output / "evaluate.json").exists():
                options = ["--matcher", matcher, "--output", str(output), "--auc-degrees", "0.5", "1", "5"]
                command = [sys.executable, "-m", "sgam_sfm", "evaluate", *scene_options(scene), *options, *passed_on]
                subprocess.run(command, check=True)
            rows += rows_of(json.loads((output / "evaluate.json").read_text()), scene.name, matcher)
            print("\n".join("| " + " | ".join(row) + " |" for row in rows[-2:]), file=sys.stderr, flush=True)
    print("\n".join("| " + " | ".join(row) + " |" for row in rows))


def rows_of(content: dict, scene: str, matcher: str) -> list[list[str]]:
    """A row for the whole images, one for the areas."""
    plain = content["variants"][0]["figures"]
    rows = []
    for variant in content["variants"]:
        figures = variant["figures"]
        cells = ["" if (value := figures.get(name)) is None else f"{value:.1f}" for name in COLUMNS]
        gaps = [""] * len(GAPS)
        if variant is not content["variants"][0]:
            gaps = [f"{100 * (figures[name] - plain[name]) / max(100 - plain[name], 1e-9):+.0f} %" for name in GAPS]
        seconds = sum(variant["seconds"].values())
        rows.append([f"{scene}, {content['num_pairs']}", matcher, variant["name"], *cells, *gaps, f"{seconds:.1f}"])
    return rows


if __name__ == "__main__":
    main()
