"""What a running, stopped or finished run has done so far, from its output folder alone."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sgam_core.errors import InputError
from sgam_sfm.nearest import did_you_mean_run
from sgam_sfm.runs.run_record import RunRecord, read_run_record
from sgam_sfm.runs.store import read_outcomes, stored_files

# What commands write of a run that is done; others than these write summary.json.
_SUMMARIES = {"reconstruct": "reconstruct.json", "aggregate": "aggregate.json", "localize": "localize.json"}


@dataclass(frozen=True, kw_only=True, slots=True)
class RunStatus:
    """The state of a run.

    images, pairs: how many there are to work on (None before that is known). failed_images, failed_pairs: and why.
    labels: images that have a label map. pairs_done: matched, with and without areas, None where pairs are not matched
    in OUT. fallbacks: pairs matched without areas, failures: pairs that failed, both by reason. damaged: files of pairs
    that are to be matched again. summary: what a finished run's command has written of it. next: how to go on from
    here. heartbeat_seconds: since the last sign of life.
    """

    run: RunRecord
    images: int | None
    failed_images: dict[str, str]
    labels: int
    pairs: int | None
    pairs_done: int | None
    failed_pairs: dict[str, str]
    failures: dict[str, int]
    fallbacks: dict[str, int]
    damaged: tuple[str, ...]
    heartbeat_seconds: float
    summary: dict[str, Any] | None
    next: str


def read_status(output: Path) -> RunStatus:
    """The status of the run in OUT, while it runs or afterwards.

    Raises: InputError when OUT holds no run.
    """
    run = read_run_record(output)
    if run is None:
        what = "holds no run of sgam-sfm" if output.is_dir() else "does not exist"
        hint = did_you_mean_run(output, "give the --output folder of `sgam-sfm match`")
        raise InputError(f"'{output}' {what}; {hint}")
    inputs = _read_json(output / "inputs.json") or {}
    fallbacks: Counter[str] = Counter()
    failed: dict[str, str] = {}
    for pair in inputs.get("left_out", ()):
        reasons = (inputs["failed"][name] for name in pair if name in inputs["failed"])
        failed[" - ".join(pair)] = next(reasons, "one of its images cannot be used")
    done = 0
    damaged = []
    for path in stored_files(output):
        try:
            outcomes = read_outcomes(path)
        except InputError:
            damaged.append(path.name)
            continue
        for outcome in outcomes:
            done += not outcome.error
            if outcome.error:
                failed[" - ".join(outcome.pair)] = outcome.error
            elif outcome.fallback:
                fallbacks[outcome.fallback.partition(":")[0]] += 1
    elsewhere = run.command in ("reconstruct", "aggregate") and not (output / "pairs").exists()
    return RunStatus(
        run=run,
        images=len(inputs["images"]) if inputs else None,
        failed_images=inputs.get("failed", {}),
        labels=sum(1 for _ in (output / "labels").rglob("*.png")),
        pairs=len(inputs["pairs"]) + len(inputs.get("left_out", ())) if inputs else None,
        pairs_done=None if elsewhere else done,
        failed_pairs=failed,
        failures=dict(Counter(failed.values()).most_common()),
        damaged=tuple(damaged),
        heartbeat_seconds=(datetime.now(UTC) - datetime.fromisoformat(run.updated)).total_seconds(),
        fallbacks=dict(sorted(fallbacks.items())),
        summary=_read_json(output / _SUMMARIES.get(run.command, "summary.json")) if run.state == "done" else None,
        next=_how_to_go_on(run, output / "options.json", retry=len(failed) > len(inputs.get("left_out", ()))),
    )


def _how_to_go_on(run: RunRecord, options: Path, *, retry: bool) -> str:
    """What to start next, empty for nothing. Args: retry: whether pairs have failed."""
    if run.state == "running" or (run.state == "done" and not retry):
        return ""
    if run.command != "match":
        return f"start the same `sgam-sfm {run.command}` again"
    told = f"sgam-sfm match --config '{options}'" if options.exists() else ""
    return f"{told} --retry-failed" if told and run.state == "done" else told


def _read_json(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"'{path}' is damaged ({error}); start the run again") from error
    return content
