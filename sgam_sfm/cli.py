"""The command line: `sgam-sfm match` and `sgam-sfm demo`; logging and exit codes."""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape

from sgam_core.errors import OptionError, SGAMError
from sgam_sfm.options import MatchOptions, merged, read_config, with_preset

DONE, ERROR, USAGE, SOME_FAILED, NO_MODEL, INTERRUPTED = 0, 1, 2, 3, 4, 130
_EXIT_CODES = """exit codes: 0 done, 1 error, 2 usage, 3 done but some images or pairs failed (named in summary.json),
4 no model could be made"""


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the command `sgam-sfm`; ends the process with one of the exit codes."""
    sys.exit(run(sys.argv[1:] if arguments is None else list(arguments)))


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; usage errors and `--help` leave by SystemExit (2 and 0)."""
    console = Console(stderr=True)
    try:
        command = tyro.cli(
            Annotated[
                Annotated[MatchOptions, tyro.conf.subcommand("match", default=_defaults(arguments))]
                | Annotated[DemoOptions, tyro.conf.subcommand("demo")],
                tyro.conf.OmitSubcommandPrefixes,
            ],
            prog="sgam-sfm",
            description="Semantic area-to-point matching (SGAM) for COLMAP.\n\n" + _EXIT_CODES,
            args=arguments,
        )
        return _match(command, console) if isinstance(command, MatchOptions) else _demo(command, console)
    except SGAMError as error:
        console.print(f"[red]error:[/red] {escape(str(error))}", highlight=False, soft_wrap=True)
        return USAGE if isinstance(error, OptionError) else ERROR
    except KeyboardInterrupt:
        console.print("stopped; the same command continues where it was")
        return INTERRUPTED


def _defaults(arguments: Sequence[str]) -> Any:
    """The values that flags are laid over: the preset's, then the file's."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--config", type=Path)
    early.add_argument("--preset")
    known, _ = early.parse_known_args(arguments)
    content = read_config(known.config) if known.config else {}
    content.pop("fingerprint", None)  # of an options.json
    preset = known.preset or content.get("preset", "default")
    options = merged(with_preset(MatchOptions(images=Path(), output=Path()), preset), content | {"preset": preset})
    for name in {"images", "output"} - content.keys():
        object.__setattr__(options, name, tyro.MISSING)  # no Path: tells tyro that the flag is required
    return options


def _match(options: MatchOptions, console: Console) -> int:
    from sgam_sfm.progress import Stages
    from sgam_sfm.runner import match_collection
    from sgam_sfm.summary import print_summary

    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        summary = match_collection(options, Stages(console=console))
        print_summary(summary, console)
    return exit_code(summary, options)


def exit_code(summary: dict[str, Any], options: MatchOptions) -> int:
    """What a finished run tells the shell."""
    if options.mapping and not summary["models"]:
        return NO_MODEL
    failed = summary["images"]["failed"] or summary["pairs"]["failed"] or summary["pairs"]["of_unusable_images"]
    return SOME_FAILED if failed or summary["labels"].get("failed") else DONE


def _demo(options: DemoOptions, console: Console) -> int:
    from sgam_sfm.demo import run_demo

    with logging_to(options.output / "log.txt", console, verbose=options.verbose):
        match_options, summary = run_demo(options.output, options.device, options.threads, console)
    return exit_code(summary, match_options)


@contextmanager
def logging_to(path: Path, console: Console, *, verbose: bool) -> Iterator[None]:
    """Send the project's log to a file, and to the terminal: all of it when verbose, else warnings."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = logging.FileHandler(path, encoding="utf-8")
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    terminal = RichHandler(console=console, show_path=False, show_time=verbose)
    terminal.setLevel(logging.INFO if verbose else logging.WARNING)
    loggers = logging.getLogger("sgam_core"), logging.getLogger("sgam_sfm")
    for logger in loggers:
        logger.setLevel(logging.INFO)
        logger.addHandler(file)
        logger.addHandler(terminal)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(file)
            logger.removeHandler(terminal)
        file.close()
