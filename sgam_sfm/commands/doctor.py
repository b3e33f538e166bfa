"""`sgam-sfm doctor`: what this machine is to a run, and a short self-test."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from sgam_sfm.exit_codes import DONE, ERROR
from sgam_sfm.logs import logging_to

_BUSY = "Loading, compiling, testing; the first time takes a minute or two ..."


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Versions, device, memory, disk, the models of a default run, and a self-test on two rendered images."""

    output: Path = Path()
    """Where results would go: its disk is looked at."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    self_test: bool = True
    """Run the whole path on two rendered images (about ten seconds; a minute or two the first time)."""


def run(options: DoctorOptions, console: Console) -> int:
    """Print what was found; an error when something is wrong."""
    output = Console()
    healthy = True
    folder = next(path for path in (options.output, *options.output.absolute().parents) if path.is_dir())
    with logging_to(None, console, verbose=False):
        with console.status(_BUSY):
            from sgam_sfm.doctor import examine
        findings = examine(folder, options.device, self_test=options.self_test)
        while True:
            # Nothing is printed while the spinner turns: it would take standard output for its own.
            with console.status(_BUSY):
                finding = next(findings, None)
            if finding is None:
                break
            mark = {True: "[green]ok[/] ", False: "[red]bad[/]", None: "   "}[finding.good]
            output.print(f"{mark} {finding.what:<12} {escape(finding.text)}", highlight=False, soft_wrap=True)
            if finding.good is False:
                healthy = False
                output.print(f"    {'':<12} -> {escape(finding.mend)}", highlight=False, soft_wrap=True)
    return DONE if healthy else ERROR
