"""What a run is doing, in OUT/progress.json, for `sgam-sfm status` and for job schedulers; one run at a time in OUT."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from filelock import FileLock, Timeout

from sgam_core.errors import InputError, SGAMError
from sgam_sfm.files import write_json
from sgam_sfm.progress import Stages

_SECONDS_BETWEEN_WRITES = 1.0

State = Literal["running", "done", "stopped", "failed", "killed"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RunRecord:
    """The state of a run.

    state: `killed` is never written: it is what a record says that still claims to run when nobody holds its lock.
    done of total (None: not known): steps of the current stage. eta_seconds: of the stage, None when not known. error:
    why the run failed. started, updated: UTC, ISO 8601.
    """

    state: State
    pid: int
    host: str
    started: str
    updated: str
    stage: str = ""
    done: float = 0.0
    total: float | None = None
    eta_seconds: float | None = None
    error: str = ""


@contextmanager
def recording(output: Path, stages: Stages) -> Iterator[None]:
    """Keep OUT/progress.json up to date while a run lasts.

    Raises: InputError when another run is working in OUT.
    """
    output.mkdir(parents=True, exist_ok=True)
    path = output / "progress.json"
    lock = FileLock(_lock_path(output), timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        other = _read(path)
        who = f" (process {other.pid} on {other.host}, since {other.started})" if other else ""
        raise InputError(
            f"another run is working in '{output}'{who}; wait for it, stop it, or choose another --output"
        ) from error
    now = _now()
    record = RunRecord(state="running", pid=os.getpid(), host=socket.gethostname(), started=now, updated=now)
    written = 0.0

    def keep(stage: str, done: float, total: float | None, eta_seconds: float | None) -> None:
        nonlocal record, written
        changed = stage != record.stage
        record = replace(record, stage=stage, done=done, total=total, eta_seconds=eta_seconds, updated=_now())
        if changed or time.monotonic() - written > _SECONDS_BETWEEN_WRITES:
            write_json(path, asdict(record))
            written = time.monotonic()

    stages.listen = keep
    state, reason = "done", ""
    try:
        yield
    except KeyboardInterrupt:
        state, reason = "stopped", "stopped by Ctrl-C"
        raise
    except BaseException as error:
        state, reason = "failed", str(error) if isinstance(error, SGAMError) else f"{type(error).__name__}: {error}"
        raise
    finally:
        stages.listen = None
        try:
            write_json(path, asdict(record) | {"state": state, "error": reason, "updated": _now(), "eta_seconds": None})
        except OSError:
            if state == "done":
                raise  # otherwise what ended the run is the better message
        finally:
            lock.release()


def read_run_record(output: Path) -> RunRecord | None:
    """The state of the last run in OUT, None when there is no record of any."""
    record = _read(output / "progress.json")
    if record is None or record.state != "running":
        return record
    lock = FileLock(_lock_path(output), timeout=0)
    try:
        with lock:
            return replace(record, state="killed", eta_seconds=None, error="it ended without a word: killed?")
    except Timeout:
        return record


def _lock_path(output: Path) -> Path:
    return output / ".lock"


def _read(path: Path) -> RunRecord | None:
    try:
        return RunRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
