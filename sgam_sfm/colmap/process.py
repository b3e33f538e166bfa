"""COLMAP's work in a child process.

Native code can end a process without an exception (corrupt data, memory). In a child that becomes a `StageError`, and
everything computed before is still there. The child is a module run as a program, which calls `serve`: it reads a job
as JSON from its standard input and writes one JSON object a line, progress and finally the result; it ends when its
input is closed. What native code prints is appended to a log file.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from sgam_core.errors import StageError
from sgam_sfm.child import end_with_parent
from sgam_sfm.machine import peak_memory_mb

Progress = Callable[[str, int, int], None]
"""Called with the name of the step, how much of it is done, and how much there is (0 when nobody knows)."""

Work = Callable[[dict[str, Any], Progress], dict[str, Any]]
"""What a child does: a job in, the result out, both as they are in JSON."""

_ERROR_LINE = re.compile(r"what\(\):|[EF]\d{8} |[A-Za-z.]*(Error|Exception): ")
_TRACE_LINE = re.compile(r"@ |PC: |\*\*\* |terminate called")


def run(
    module: str, stage: str, job: dict[str, Any], log_path: Path, on_progress: Progress | None = None
) -> tuple[dict[str, Any], float]:
    """Run a job in a child process.

    Args: module: full name of the one that serves the job. stage: what COLMAP does, for the error. log_path: what
        native code prints is appended to it.
    Returns: the result, with the child's `peak_memory_mb` (None when unknown), and the seconds it took.
    Raises: StageError when the work fails or ends the process.
    """
    start = time.perf_counter()
    result = None
    # -P keeps the working directory off the module path: a `random.py` there must not be what COLMAP's child imports.
    command = [sys.executable, "-P", "-m", module]
    log_path.parent.mkdir(parents=True, exist_ok=True)
    with log_path.open("ab") as log:
        log_start = log.tell()
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True)
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            with suppress(BrokenPipeError):  # a child that ended at once is told by its exit code
                child.stdin.write(json.dumps(job) + "\n")
                child.stdin.flush()  # and left open: the child ends when it is closed
            with child.stdout:
                for line in child.stdout:
                    message = json.loads(line)
                    if "step" in message and on_progress is not None:
                        on_progress(message["step"], message["done"], message["total"])
                    result = message.get("result", result)
            code = child.wait()
        finally:
            child.kill()
            child.wait()
            with suppress(BrokenPipeError):
                child.stdin.close()
    if code != 0 or result is None:
        ending = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        ending += " (out of memory?)" if ending == "SIGKILL" else ""
        raise StageError(
            f"COLMAP's {stage} ended with {ending}: {_last_words(log_path, log_start)} (log: {log_path}); "
            "everything before this stage has been kept"
        )
    return result, time.perf_counter() - start


def serve(work: Work) -> None:
    """Do the job that `run` sends: a module that can be `run` calls this when it is the program."""
    # The parent reads our lines only: what native code prints to standard output joins its log on standard error.
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def write(message: dict[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")
        channel.flush()

    job = json.loads(sys.stdin.buffer.readline())
    end_with_parent(sys.stdin.fileno())  # it would go on to write into a database that the next run replaces
    result = work(job, lambda step, done, total: write({"step": step, "done": done, "total": total}))
    write({"result": {**result, "peak_memory_mb": peak_memory_mb()}})


def _last_words(log_path: Path, start: int) -> str:
    """The line of the log since byte `start` that tells most: the last error, or else the last line."""
    with log_path.open("rb") as log:
        log.seek(start)
        # glog's handler of signals may write into a line that is not ended yet
        lines = [
            line.partition("*** Aborted")[0].strip() for line in log.read().decode("utf-8", "replace").splitlines()
        ]
    lines = [line for line in lines if line and not _TRACE_LINE.match(line)]
    errors = [line for line in lines if _ERROR_LINE.match(line)]
    return (errors or lines or ["it left no message"])[-1]
