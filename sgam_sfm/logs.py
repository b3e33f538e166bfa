"""Where the project's log goes."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Console
from rich.logging import RichHandler


@contextmanager
def logging_to(path: Path | None, console: Console, *, verbose: bool) -> Iterator[None]:
    """Send the project's log to a file, and to the terminal: all of it when verbose, else warnings."""
    terminal = RichHandler(console=console, show_path=False, show_time=verbose)
    terminal.setLevel(logging.INFO if verbose else logging.WARNING)
    handlers: list[logging.Handler] = [terminal]
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _LogFile(path, encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        handlers.append(file)
    loggers = logging.getLogger("sgam_core"), logging.getLogger("sgam_sfm")
    for logger in loggers:
        logger.setLevel(logging.INFO)
        for handler in handlers:
            logger.addHandler(handler)
    try:
        yield
    finally:
        for logger in loggers:
            for handler in handlers:
                logger.removeHandler(handler)
        for handler in handlers:
            handler.close()


class _LogFile(logging.FileHandler):
    """A log file that cannot fail the run: on a full disk the run's own files tell of it, in one line."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (the name that logging calls)
        pass

    def close(self) -> None:
        with suppress(OSError):
            super().close()
