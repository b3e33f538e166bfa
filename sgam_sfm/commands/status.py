"""`sgam-sfm status OUT`: what a running or stopped job has done, what failed and why."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from sgam_core.wording import counted
from sgam_sfm.commands.localize import poses_told
from sgam_sfm.exit_codes import DONE
from sgam_sfm.nearest import listing

if TYPE_CHECKING:
    from sgam_sfm.runs.status import RunStatus

_MAX_REASONS = 10


@dataclass(frozen=True, kw_only=True)
class StatusOptions:
    """What a running or stopped job has done, what failed and why."""

    output: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The --output folder of a run."""
    json: bool = False
    """As JSON, with every reason, for programs."""


def run(options: StatusOptions, console: Console) -> int:
    """Print the status."""
    from sgam_sfm.runs.status import read_status

    status = read_status(options.output)
    if options.json:
        print(json.dumps(asdict(status), indent=2))
    else:
        for what, text in _lines(status):
            print(f"{what:<10} {text}")
    return DONE


def _lines(status: RunStatus) -> list[tuple[str, str]]:
    from sgam_sfm.progress import duration

    run = status.run
    running = run.state == "running"
    state = f"{run.state} since {run.started}" if running else f"{run.state} at {run.updated}"
    beat = f", last sign of life {duration(status.heartbeat_seconds)} ago" if running else ""
    lines = [("state", f"{state} (process {run.pid} on {run.host}{beat})" + (f": {run.error}" if run.error else ""))]
    if run.crashes:
        lines.append(("crashes", f"ended from outside and started again {counted(run.crashes, 'time')} (see log.txt)"))
    if run.state != "done" and run.stage:
        amount = f" {run.done:.0f} of {run.total:.0f}" if run.total else ""
        eta = f", about {duration(run.eta_seconds)} left of this stage" if run.eta_seconds is not None else ""
        at = f", at {' - '.join(run.pair)}" if run.pair else ""
        lines.append(("stage", f"{run.stage}{amount}{eta}{at}"))
    if status.images is not None:
        lines.append(("images", f"{status.images} used, {len(status.failed_images)} failed"))
        lines += _reasons(status.failed_images)
        if status.labels:
            lines.append(("labels", counted(status.labels, "map")))
        if status.pairs_done is not None:
            told = f"{status.pairs_done} of {status.pairs} matched and stored, {len(status.failed_pairs)} failed"
            lines.append(("pairs", told))
            lines += _by_reason(status)
        if status.damaged:
            lines.append(("damaged", f"{', '.join(status.damaged)}: the next run matches these pairs again"))
        if status.fallbacks:
            told = ", ".join(f"{count} {reason}" for reason, count in status.fallbacks.items())
            lines.append(("fallbacks", told))
    if status.summary and run.command == "localize":
        lines += poses_told(status.summary)
    elif status.summary:
        if status.pairs_done is None:
            told = f"{status.summary['pairs']} with matches, {status.summary['verified']} verified"
            lines.append(("pairs", told))
        lines += _models(status.summary)
    if status.next:
        lines.append(("next", status.next))
    return lines


def _models(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    models, without = summary["models"], summary.get("without_pose", ())
    lines = [
        (
            f"model {number}",
            f"{model['registered']} of {counted(model['total'], 'image')}, {counted(model['points'], 'point')}",
        )
        for number, model in enumerate(models)
    ]
    if not models:
        return [("model", summary["no_model"])]
    return lines + ([("no pose", listing(without))] if without else [])


def _by_reason(status: RunStatus) -> list[tuple[str, str]]:
    """The pairs that failed: one by name, many by their number."""
    names = {reason: name for name, reason in status.failed_pairs.items()}
    return _first(
        [
            ("", f"{f'{count} pairs' if count > 1 else names[reason]}: {reason}")
            for reason, count in status.failures.items()
        ]
    )


def _reasons(failed: dict[str, str]) -> list[tuple[str, str]]:
    return _first([("", f"{name}: {reason}") for name, reason in failed.items()])


def _first(lines: list[tuple[str, str]]) -> list[tuple[str, str]]:
    more = [("", f"and {len(lines) - _MAX_REASONS} more (--json lists all)")] if len(lines) > _MAX_REASONS else []
    return lines[:_MAX_REASONS] + more
