"""`sgam-sfm evaluate`: matches, poses and areas of pairs against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from sgam_core.wording import counted
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
    "aor_guided": ("AOR guided", 1),
    "aor_after_gr": ("AOR after GR", 1),
    "amp_soa": ("AMP SOA", 1),
    "amp_sia": ("AMP SIA", 1),
    "amp_gp": ("AMP GP", 1),
    "amp_guided": ("AMP guided", 1),
    "amp_after_gr": ("AMP after GR", 1),
    "fallbacks": ("fallbacks, %", 0),
    "megapixels_matched": ("Mpx a pair", 2),
}


def run(options: EvaluateOptions, console: Console) -> int:
    """Evaluate; print the table."""
    from sgam_sfm.evaluation.evaluate import evaluate
    from sgam_sfm.progress import Stages

    with logging_to(options.output / "log.txt", console, verbose=options.verbose, as_json=options.log_json):
        content = evaluate(options, Stages(console=console))
    _print(content, console)
    console.print(f"figures    {options.output / 'evaluate.json'}", highlight=False, markup=False, soft_wrap=True)
    return DONE


def _print(content: Mapping[str, Any], console: Console) -> None:
    from sgam_sfm.tables import print_figures

    auc = {f"auc_{degrees:g}": (f"AUC@{degrees:g}", 1) for degrees in content["auc_degrees"]}
    variants = content["variants"]
    rows = [
        (title, [_cell(variant["figures"].get(name), digits) for variant in variants])
        for name, (title, digits) in (auc | _SHOWN).items()
    ]
    names = [variant["name"] for variant in variants]
    print_figures(counted(content["num_pairs"], "pair"), names, rows, console)
    if not any(pair["by_depth"] for variant in variants for pair in variant["pairs"]):
        console.print(
            "MMA is by the symmetric epipolar distance: the truth has no depth for these pairs", soft_wrap=True
        )
    degrees = content["auc_degrees"][len(content["auc_degrees"]) // 2]
    parts = zip(*(variant["slices"] for variant in variants), strict=True)  # a slice is the same pairs in all
    rows = [
        (
            f"{of[0]['by']} {of[0]['part']} ({of[0]['num_pairs']})",
            [_cell(part["figures"][f"auc_{degrees:g}"], 1) for part in of],
        )
        for of in parts
        if of[0]["num_pairs"]
    ]
    print_figures(f"AUC@{degrees:g} of the pairs with", names, rows, console)
    failed = sum(bool(pair["error"]) for pair in variants[0]["pairs"])
    if failed:
        console.print(
            f"{counted(failed, 'pair')} could not be matched, counted as failed; evaluate.json says why", style="yellow"
        )


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
