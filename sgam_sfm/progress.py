"""Stages of a run: a progress bar with an ETA while one lasts, its seconds once it is over."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Advance = Callable[[float], None]
Listener = Callable[[str, float, float | None, float | None], None]
"""Called with a stage's name, how much of it is done, its total, and the seconds that it may still take."""
_log = logging.getLogger(__name__)


@dataclass
class Stages:
    """Shows and times the stages of one run. quiet: no bars. listen: is told of all progress."""

    quiet: bool = False
    seconds: dict[str, float] = field(default_factory=dict)
    console: Console = field(default_factory=lambda: Console(stderr=True))
    listen: Listener | None = None

    @contextmanager
    def stage(self, name: str, total: float | None) -> Iterator[Advance]:
        """Run one stage; yields a function that adds to its progress. total: None when it cannot be known."""
        _log.info("%s ...", name)
        start = time.perf_counter()
        columns = (
            TextColumn("{task.description:<22}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(elapsed_when_finished=False),
        )
        try:
            with Progress(*columns, console=self.console, disable=self.quiet) as bars:
                number = bars.add_task(name, total=total)
                task = bars.tasks[0]

                def advance(amount: float) -> None:
                    bars.advance(number, amount)
                    self._tell(name, task.completed, total, task.time_remaining)

                self._tell(name, 0.0, total, None)
                yield advance
                bars.update(number, total=total or 1, completed=total or 1)
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            _log.info("%s: %.1f s", name, self.seconds[name])

    def _tell(self, name: str, done: float, total: float | None, eta_seconds: float | None) -> None:
        if self.listen is not None:
            self.listen(name, done, total, eta_seconds)
