"""Plot what bench_scale.py measured at several sizes: seconds and memory of every stage against matches.

python scripts/plot_scale.py scale1k.json scale3k.json scale10k.json --output scale.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    runs = sorted((json.loads(path.read_text()) for path in arguments.results), key=lambda run: run["matches"])
    mpl.use("agg")
    figure = Figure(figsize=(10, 4), layout="constrained")
    seconds, memory = figure.subplots(1, 2)
    millions = [run["matches"] / 1e6 for run in runs]
    for stage in [name for name in ("store", "merge", "database") if all(name in run["stages"] for run in runs)]:
        figures = [run["stages"][stage] for run in runs]
        seconds.loglog(millions, [stage["seconds"] for stage in figures], "o-", label=stage)
        memory.semilogx(millions, [stage["peak_mb"] / 1024 for stage in figures], "o-", label=stage)
    seconds.loglog(millions, millions, "k:", label="1 M matches a second")
    memory.axhline(4, color="k", linestyle=":", label="4 GiB")
    for axes, unit in ((seconds, "seconds"), (memory, "peak memory, GiB")):
        axes.set_xlabel("raw matches, millions")
        axes.set_ylabel(unit)
        axes.legend()
    memory.set_ylim(bottom=0)
    figure.savefig(arguments.output, dpi=120)


if __name__ == "__main__":
    main()
