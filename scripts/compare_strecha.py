"""The README's table of methods: SGAM against the same matcher run plainly, at the same price, and against SIFT.

    python scripts/compare_strecha.py DATA OUT [--runs fountain-P11 fountain-P11:every=2 ...] [-- --max-pairs 20 ...]

DATA: a folder with the Strecha scenes (fountain-P11/images, images/K.txt, gt_dense_cameras, ...). Runs `sgam-sfm
compare` with the true intrinsics held fixed on all pairs of each scene (the whole castle-P19, a walk around a
courtyard: each image with the next three), and on harder cuts of it, into OUT/<run>; options after `--` go to all.
What is there is not run again. Prints a Markdown table of all runs that are in OUT: gains over the plain matcher at the
same input size in bold, losses in italics, where the printed figures differ.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

from scenes import scene_options, split_options

CUTS = ("", ":every=2", ":every=3", ":zoom=2.5")
RUNS = (
    *(f"{scene}{cut}" for scene in ("Herz-Jesus-P8", "fountain-P11") for cut in CUTS),
    *(f"castle-P19{cut}" for cut in ("", ":every=3")),
)
PARTNERS = {"castle-P19": 3}
METHODS = (
    "sgam:xfeat-star",
    "none:xfeat-star",
    "none:xfeat-star@budget=match",
    "tiles:xfeat-star@budget=match",
    "covisible:xfeat-star@budget=match",
    "sift",
)
COLUMNS = {
    "registered": "registered",
    "auc_0.5": "AUC@0.5",
    "auc_1": "@1",
    "auc_3": "@3",
    "auc_5": "@5",
    "center_error": "centre mm",
    "points": "points",
    "images_per_track": "images a track",
    "reprojection_error_px": "reproj. px",
    "verified_pairs": "verified pairs",
    "megapixels_matched": "Mpx matched",
    "matching_seconds": "matching s",
    "peak_memory_mb": "peak MB",
}
DIGITS = {"auc_0.5": 1, "auc_1": 1, "auc_3": 1, "auc_5": 1, "center_error": 1, "images_per_track": 2}
DIGITS |= {"reprojection_error_px": 3}
SCALE = {"center_error": 1000}


def main() -> None:
    """Run what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--runs", nargs="*", default=list(RUNS))
    own, passed_on = split_options(sys.argv[1:])
    arguments = parser.parse_args(own)
    for run in arguments.runs:
        compare(arguments.data, arguments.out, run, passed_on)
    print(table({run: arguments.out / folder_of(run) for run in dict.fromkeys([*RUNS, *arguments.runs])}))


def compare(data: Path, out: Path, run: str, options: list[str]) -> None:
    """One comparison."""
    scene, _, cut = run.partition(":")
    files = [*scene_options(data / scene), "--output", out / folder_of(run)]
    if scene in PARTNERS and not cut:
        names = sorted(path.name for path in (data / scene / "images").glob("*.jpg"))
        around = [
            (a, names[(row + step) % len(names)])
            for step in range(1, PARTNERS[scene] + 1)
            for row, a in enumerate(names)
        ]
        out.mkdir(parents=True, exist_ok=True)
        (out / f"{scene}.txt").write_text("".join(f"{a} {b}\n" for a, b in around))
        files += ["--pairs", out / f"{scene}.txt"]
    command = [sys.executable, "-m", "sgam_sfm", "compare", *files, "--methods", *METHODS, *options]
    subprocess.run([*map(str, command), *(["--hard", cut] if cut else [])], check=True)


def folder_of(run: str) -> str:
    """The folder of a run, whose name may hold characters that file systems refuse."""
    return run.replace(":", "_").replace("=", "-")


def table(folders: dict[str, Path]) -> str:
    """Markdown, a row a method and run."""
    rows = [["run", "method", *COLUMNS.values()], ["---"] * (len(COLUMNS) + 2)]
    for run, folder in folders.items():
        if (folder / "compare.json").exists():
            content = json.loads((folder / "compare.json").read_text())
            total = len(content["collection"]["names"])
            reference = next(m for m in content["methods"] if m["slug"] == content["reference"])
            plain = cells_of(reference, total)
            for method in content["methods"]:
                name = method["name"].replace(":xfeat-star", "").replace("=match", "")
                verdicts = [method["verdicts"].get(figure, "") for figure in COLUMNS]
                cells = map(marked, cells_of(method, total), plain, verdicts)
                rows.append([run.replace(":", ", "), name, *cells])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def cells_of(method: dict, total: int) -> list[str]:
    """Every figure as text; empty where the method has none."""
    found = method["figures"] | method["times"]
    texts = []
    for figure in COLUMNS:
        value = (found.get(figure) or {}).get("mean")
        if value is None:
            texts.append("")
        elif figure == "registered":
            texts.append(f"{value:.0f}/{total}")
        else:
            texts.append(f"{value * SCALE.get(figure, 1):.{DIGITS.get(figure, 0)}f}")
    return texts


def marked(text: str, reference: str, verdict: str) -> str:
    """A figure as the table shows it."""
    return text if text == reference else {"gain": f"**{text}**", "loss": f"_{text}_"}.get(verdict, text)


if __name__ == "__main__":
    main()
