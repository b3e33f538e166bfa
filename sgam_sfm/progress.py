"""Stages of a run: a progress bar with an ETA while one lasts, its seconds once it is over."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Advance = Callable[[float], None]
_SECONDS_BETWEEN_LOG_LINES = 60.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class StageProgress:
    """How far a stage is: done of total steps (None: not known). seconds_per_step, eta_seconds: None when not known.

    pair: what is worked on, empty when the stage has no pairs.
    """

    stage: str
    done: float
    total: float | None
    seconds_per_step: float | None
    pair: tuple[str, ...] = ()

    @property
    def eta_seconds(self) -> float | None:
        """What the stage may still take."""
        if self.total is None or self.seconds_per_step is None:
            return None
        return max(self.total - self.done, 0.0) * self.seconds_per_step


Listener = Callable[[StageProgress], None]


@dataclass
class Stages:
    """Shows and times the stages of one run.

    quiet: no bars. listen: is told of all progress. counts: of what the run works on and how it went, for heartbeats.
    paces: seconds that a step of a stage took in an earlier run, the estimate until this one has done a step.
    """

    quiet: bool = False
    seconds: dict[str, float] = field(default_factory=dict)
    console: Console = field(default_factory=lambda: Console(stderr=True))
    listen: Listener | None = None
    counts: Counter[str] = field(default_factory=Counter)
    paces: Mapping[str, float] = field(default_factory=dict)
    _now: StageProgress | None = None

    @contextmanager
    def stage(self, name: str, total: float | None, done: float = 0.0) -> Iterator[Advance]:
        """Run one stage; yields a function that adds to its progress.

        Args: total: None when it cannot be known. done: what an earlier run has done of it, which tells nothing of the
            time that the rest takes.
        """
        _log.info("%s ...", name)
        start = logged = time.perf_counter()
        columns = (
            TextColumn("{task.description:<22}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("ETA"),
            TimeRemainingColumn(elapsed_when_finished=False),
        )
        try:
            with Progress(*columns, console=self.console, disable=self.quiet, speed_estimate_period=600) as bars:
                number = bars.add_task(name, total=total, completed=done)  # type: ignore[arg-type]  # any number
                task = bars.tasks[0]

                def advance(amount: float) -> None:
                    nonlocal logged
                    bars.advance(number, amount)
                    now, steps = time.perf_counter(), task.completed - done
                    pace = (now - start) / steps if steps > 0 else self.paces.get(name)
                    progress = StageProgress(stage=name, done=task.completed, total=total, seconds_per_step=pace)
                    self._tell(progress)
                    if now - logged > _SECONDS_BETWEEN_LOG_LINES:
                        logged = now
                        _log.info("%s: %s", name, _told(progress))

                self._tell(StageProgress(stage=name, done=done, total=total, seconds_per_step=self.paces.get(name)))
                yield advance
                bars.update(number, total=total or 1, completed=total or 1)
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            _log.info("%s: %.1f s", name, self.seconds[name])

    def working_on(self, pair: tuple[str, str]) -> None:
        """Tell the listener which pair of the stage is begun."""
        if self._now is not None:
            self._tell(replace(self._now, pair=pair))

    def _tell(self, progress: StageProgress) -> None:
        self._now = progress
        if self.listen is not None:
            self.listen(progress)


def duration(seconds: float) -> str:
    """A time for people: 40 s, 12 min, 3 h 20 min."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _told(progress: StageProgress) -> str:
    total = "" if progress.total is None else f" of {progress.total:.0f}"
    eta = progress.eta_seconds
    return f"{progress.done:.0f}{total}" + ("" if eta is None else f", about {duration(eta)} left")
