"""What a run is doing, in OUT/progress.json, for `sgam-sfm status` and for job schedulers; one run at a time in OUT."""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from filelock import FileLock, Timeout

from sgam_core.errors import InputError, SGAMError
from sgam_sfm.files import remove_partials, write_json
from sgam_sfm.progress import StageProgress, Stages
from sgam_sfm.repeating import repeating
from sgam_sfm.runs import supervised

_SECONDS_BETWEEN_WRITES = 1.0
_SECONDS_OF_AN_ENDING = 5.0  # a killed run's child ends a moment after it
SECONDS_BETWEEN_BEATS = 10.0
_log = logging.getLogger(__name__)

State = Literal["running", "done", "stopped", "failed", "killed"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RunRecord:
    """The state of a run.

    command: of sgam-sfm, such as `match`. state: `killed` is never written: it is what a record says that still claims
    to run when nobody holds its lock. started: of this process; crashes: how often one before it, of the same run, was
    ended from outside. updated: the heartbeat, at least every ten seconds while the process lives; times are UTC, ISO
    8601. done of total (None: not known): steps of the current stage. pair: what is being matched. eta_seconds,
    seconds_per_step: of the stage, None when not known. counts: images, images_failed, pairs, pairs_done, pairs_failed,
    fallbacks. error: why it failed.
    """

    state: State
    pid: int
    host: str
    started: str
    updated: str
    command: str = "match"
    crashes: int = 0
    stage: str = ""
    done: float = 0.0
    total: float | None = None
    pair: tuple[str, ...] = ()
    eta_seconds: float | None = None
    seconds_per_step: float | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    error: str = ""


@contextmanager
def recording(output: Path, stages: Stages, command: str = "match") -> Iterator[RunRecord | None]:
    """Keep OUT/progress.json up to date while a run of a command lasts.

    Yields: how the last run in OUT ended, None when there was none.
    Raises: InputError when another run is working in OUT.
    """
    output.mkdir(parents=True, exist_ok=True)
    path = output / "progress.json"
    lock = FileLock(_lock_path(output), timeout=_SECONDS_OF_AN_ENDING)
    try:
        lock.acquire()
    except Timeout as error:
        other = _read(path)
        who = f" (process {other.pid} on {other.host}, since {other.started})" if other else ""
        raise InputError(
            f"another run is working in '{output}'{who}; wait for it, stop it, or choose another --output"
        ) from error
    remove_partials(output)
    for crash in supervised.crashes()[-1:]:
        where = " - ".join(crash.pair) or crash.stage or "its start"
        _log.info("the process before this one was %s at %s", crash.told, where)
    before = _read(path)
    if before is not None and before.seconds_per_step is not None:
        stages.paces = {before.stage: before.seconds_per_step}
    heart = _Heart(path, stages, command)
    stages.listen = heart.listen
    state, reason = "done", ""
    try:
        with repeating(heart.beat, SECONDS_BETWEEN_BEATS):
            yield before
    except KeyboardInterrupt as error:
        state, reason = "stopped", f"stopped by {error}" if str(error) else "stopped by Ctrl-C"
        raise
    except BaseException as error:
        state, reason = "failed", str(error) if isinstance(error, SGAMError) else f"{type(error).__name__}: {error}"
        raise
    finally:
        stages.listen = None
        try:
            last = asdict(heart.record) | {"counts": dict(stages.counts), "updated": _now(), "eta_seconds": None}
            write_json(path, last | {"state": state, "error": reason})
        except OSError:
            if state == "done":
                raise  # otherwise what ended the run is the better message
        finally:
            lock.release()


class _Heart:
    """Writes the record when something has changed, at most once a second, and every few seconds when nothing has."""

    def __init__(self, path: Path, stages: Stages, command: str) -> None:
        self._path, self._stages = path, stages
        now = _now()
        self.record = RunRecord(
            state="running",
            pid=os.getpid(),
            host=socket.gethostname(),
            started=now,
            updated=now,
            command=command,
            crashes=len(supervised.crashes()),
        )
        self._written = 0.0
        self._writing = threading.Lock()

    def listen(self, progress: StageProgress) -> None:
        supervised.tell(progress.stage, progress.done, progress.pair)
        changed = progress.stage != self.record.stage
        self.record = replace(self.record, **asdict(progress), eta_seconds=progress.eta_seconds)
        if changed or time.monotonic() - self._written > _SECONDS_BETWEEN_WRITES:
            self._beat()

    def beat(self) -> None:
        """Write a sign of life."""
        with suppress(OSError):  # the run's own files tell of a full disk
            self._beat()

    def _beat(self) -> None:
        with self._writing:
            self._written = time.monotonic()
            now = replace(self.record, updated=_now(), counts=dict(self._stages.counts))
            write_json(self._path, asdict(now), durable=False)


def read_run_record(output: Path) -> RunRecord | None:
    """The state of the last run in OUT, None when there is no record of any."""
    record = _read(output / "progress.json")
    if record is None or record.state != "running":
        return record
    lock = FileLock(_lock_path(output), timeout=0)
    try:
        with lock:
            return replace(record, state="killed", eta_seconds=None, error="it ended without a word: killed?")
    except (Timeout, OSError):  # it runs, or nobody else may tell
        return record


def _lock_path(output: Path) -> Path:
    return output / ".lock"


def _read(path: Path) -> RunRecord | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return RunRecord(**(content | {"pair": tuple(content.get("pair", ()))}))
    except (OSError, ValueError, TypeError, AttributeError):
        return None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
