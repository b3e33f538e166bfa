"""`sgam-sfm demo`: the whole job on the collection that comes with the project."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from sgam_sfm.commands.match import exit_code
from sgam_sfm.logs import logging_to


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Render a room with known geometry, match it, reconstruct it, and draw its areas.

    Takes a few minutes on two CPU cores and needs no network. Compares the model with the truth.
    """

    output: Path
    """Folder for the images, the results and the pictures."""
    threads: int = 0
    """CPU threads (0: all cores)."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, ..."""
    verbose: bool = False
    """Show the log on the terminal; it is always in the results' log.txt."""


def run(options: DemoOptions, console: Console) -> int:
    """Run the demo."""
    from sgam_sfm.demo import run_demo

    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        match_options, summary = run_demo(options.output, options.device, options.threads, console)
    return exit_code(summary, match_options)
