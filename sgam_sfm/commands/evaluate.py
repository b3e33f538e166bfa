"""`sgam-sfm evaluate`: matches, poses and areas of pairs against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from sgam_sfm.evaluation.options import EvaluateOptions
from sgam_sfm.exit_codes import DONE
from sgam_sfm.logs import logging_to

_SHOWN = {
    "matches": ("matches", 0),
    "mma_1": ("MMA@1", 1),
    "mma_3": ("MMA@3", 1),
    "mma_1_at_640": ("MMA@1 at 640", 1),
    "areas_after_gr": ("areas after GR", 1),
    "aor_soa": ("AOR SOA", 1),
    "aor_sia": ("AOR SIA", 1),
    "aor_gp": ("AOR GP", 1),
    "aor_after_gr": ("AOR after GR", 1),
    "amp_soa": ("AMP SOA", 1),
    "amp_sia": ("AMP SIA", 1),
    "amp_gp": ("AMP GP", 1),
    "amp_after_gr": ("AMP after GR", 1),
    "fallbacks": ("fallbacks, %", 0),
    "megapixels_matched": ("Mpx a pair", 2),
}


def run(options: EvaluateOptions, console: Console) -> int:
    """Evaluate; print the table."""
    from sgam_sfm.evaluation.evaluate import evaluate
    from sgam_sfm.progress import Stages

    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        content = evaluate(options, Stages(console=console))
    _print(content, console)
    return DONE


def _print(content: Mapping[str, Any], console: Console) -> None:
    from sgam_sfm.tables import print_figures

    auc = {f"auc_{degrees:g}": (f"AUC@{degrees:g}", 1) for degrees in content["auc_degrees"]}
    variants = content["variants"]
    rows = [
        (title, [_cell(variant["figures"].get(name), digits) for variant in variants])
        for name, (title, digits) in (auc | _SHOWN).items()
    ]
    print_figures(f"{content['num_pairs']} pairs", [variant["name"] for variant in variants], rows, console)


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
