"""Where the project's log goes."""

from __future__ import annotations

import json
import logging
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console
from rich.logging import RichHandler

from sgam_core.errors import SGAMError
from sgam_sfm.files import disk_is_full

_log = logging.getLogger(__name__)


@contextmanager
def logging_to(path: Path | None, console: Console, *, verbose: bool, as_json: bool = False) -> Iterator[None]:
    """Send the project's log to a file, and to the terminal: all of it when verbose, else warnings.

    What ends the work is the last line of the file.
    Args: as_json: to `<stem>.jsonl` beside the file too, a JSON object a line.
    """
    terminal = RichHandler(console=console, show_path=False, show_time=verbose)
    terminal.setLevel(logging.INFO if verbose else logging.WARNING)
    terminal.addFilter(lambda record: record.name != __name__)  # how it ended is told by the command line
    handlers: list[logging.Handler] = [terminal]
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _LogFile(path, encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        handlers.append(file)
        if as_json:
            handlers.append(_LogFile(path.with_suffix(".jsonl"), encoding="utf-8"))
            handlers[-1].setFormatter(_AsJSON())
    loggers = logging.getLogger("sgam_core"), logging.getLogger("sgam_sfm")
    for logger in loggers:
        logger.setLevel(logging.INFO)
        for handler in handlers:
            logger.addHandler(handler)
    try:
        yield
    except KeyboardInterrupt as error:
        _log.warning("stopped by %s", str(error) or "Ctrl-C")
        raise
    except Exception as error:
        known = isinstance(error, (SGAMError, OSError)) or disk_is_full(error)
        _log.error("%s", error if str(error) else type(error).__name__, exc_info=None if known else error)
        raise
    finally:
        for logger in loggers:
            for handler in handlers:
                logger.removeHandler(handler)
        for handler in handlers:
            handler.close()


def in_one_line(error: Exception) -> str:
    """An exception that nobody foresaw, and where it was raised."""
    raised = traceback.extract_tb(error.__traceback__)[-1]
    message = (str(error).splitlines() or [""])[0]
    return f"{type(error).__name__}: {message} ({Path(raised.filename).name}:{raised.lineno})"


class _AsJSON(logging.Formatter):
    """time: UTC, ISO 8601. traceback: of a mistake of ours."""

    def format(self, record: logging.LogRecord) -> str:
        content = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            content["traceback"] = self.formatException(record.exc_info)
        return json.dumps(content)


class _LogFile(logging.FileHandler):
    """A log file that cannot fail the run: on a full disk the run's own files tell of it, in one line."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (the name that logging calls)
        pass

    def close(self) -> None:
        with suppress(OSError):
            super().close()
