"""A run under supervision: when something ends it from outside, it is started again and goes on where it was.

The system's out-of-memory killer and faults in native code end a process without an exception. The command `sgam-sfm`
therefore runs `match` in a child process and does nothing itself but wait. The child tells over a pipe what it works
on. When a signal such as SIGKILL ends it, the supervisor starts another one, and tells it over its standard input what
its predecessors were working on when they were ended: a pair is tried twice, then recorded as failed. Outside of pairs,
the second end at the same place is the end of the run. The supervisor imports nothing but the standard library: it
starts at once, and is too small for the out-of-memory killer.

Runs from Python, and on Windows, are not supervised: they do without all of this.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from types import FrameType
from typing import Any

from sgam_sfm.child import end_with_parent
from sgam_sfm.exit_codes import ERROR, INTERRUPTED
from sgam_sfm.runs.supervised import TRIES, Crash, begin

_SECONDS_OF_ONE_STOP = 1.0
_COMMANDS = ("match",)
_PROGRAM = "import sys; from sgam_sfm.runs.supervision import child; sys.exit(child(int(sys.argv[1])))"
# What native code and the system end a process with; others are what users and schedulers stop it with.
_CRASHES = tuple(
    getattr(signal, name, None) for name in ("SIGKILL", "SIGSEGV", "SIGBUS", "SIGABRT", "SIGILL", "SIGFPE")
)


class Terminated(KeyboardInterrupt):
    """Ctrl-C, or the signal that schedulers stop a job with; both are a clean stop."""


def child(pipe: int) -> int:
    """The child process: a job from standard input, then the command line. Returns: its exit code."""
    job = json.loads(sys.stdin.buffer.readline())
    end_with_parent(sys.stdin.fileno())
    begin(job["crashes"], pipe)
    _stop_cleanly()
    try:
        from sgam_sfm.cli import run

        return run(job["arguments"])
    except KeyboardInterrupt:  # before the command line could say so
        _say("stopped; the same command continues where it was")
        return INTERRUPTED


def _stop_cleanly() -> None:
    """Make SIGTERM a clean stop as Ctrl-C is; a stop can arrive twice, from the terminal and from the supervisor."""
    import zlib  # noqa: F401  (before pycolmap, see `sgam_sfm.colmap`)

    import pycolmap  # noqa: F401  (which takes SIGTERM for itself when it is imported: not after us)

    last = -_SECONDS_OF_ONE_STOP

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal last
        if time.monotonic() - last > _SECONDS_OF_ONE_STOP:
            last = time.monotonic()
            raise Terminated("Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name)

    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)


# In the supervisor.


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the command `sgam-sfm`; ends the process with one of the exit codes."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if os.name == "posix" and given[:1] and given[0] in _COMMANDS and not {"-h", "--help"}.intersection(given):
        sys.exit(supervise(given))
    from sgam_sfm.cli import run

    sys.exit(run(given))


def supervise(arguments: Sequence[str]) -> int:
    """Run a command line in a child process, again when it is ended from outside. Returns: its exit code."""
    ends: list[Crash] = []
    with _forwarding() as forward:
        while not forward.stopped.is_set():
            code, place = _run_child(arguments, ends, forward)
            if forward.stopped.is_set() and code < 0:
                return INTERRUPTED
            if -code not in _CRASHES:
                return code if code >= 0 else 128 - code
            crash = Crash.of({"signal": signal.Signals(-code).name, "pair": ()} | place)
            where = " - ".join(crash.pair) or f"stage '{crash.stage}'" if crash.stage else "its start"
            ends.append(crash)
            if not crash.pair and sum(map(crash.same_place, ends)) >= TRIES:
                _say(
                    f"error: the process was {crash.told} at {where}, {TRIES} times; what was matched has been kept, "
                    "and the same command continues"
                )
                return ERROR
            _say(f"the process was {crash.told} at {where}; it is started again")
    return INTERRUPTED


@dataclass
class _Forward:
    process: subprocess.Popen[bytes] | None = None
    stopped: threading.Event = field(default_factory=threading.Event)


@contextmanager
def _forwarding() -> Iterator[_Forward]:
    """Hand what is to stop the run on to the child, and wait for it."""
    forward = _Forward()

    def hand_on(number: int, frame: FrameType | None) -> None:
        forward.stopped.set()
        if forward.process is not None:
            forward.process.send_signal(number)

    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, hand_on) for number in numbers}
    try:
        yield forward
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run_child(arguments: Sequence[str], ends: Sequence[Crash], forward: _Forward) -> tuple[int, dict[str, Any]]:
    """Returns: the exit code, negative for a signal, and what the child last told it was working on."""
    from_child, to_parent = os.pipe()
    # -P keeps the working directory off the module path: a `random.py` there must not be what the child imports.
    command = [sys.executable, "-P", "-c", _PROGRAM, str(to_parent)]
    place: dict[str, Any] = {}
    with os.fdopen(from_child, encoding="utf-8") as lines:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=(to_parent,))
        forward.process = process
        os.close(to_parent)
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError):  # a child that ended at once is told by its exit code
                job = {"arguments": list(arguments), "crashes": [asdict(end) for end in ends]}
                process.stdin.write(json.dumps(job).encode() + b"\n")
                process.stdin.flush()
            for line in lines:
                with suppress(ValueError):  # the last one may be cut
                    place = json.loads(line)
            return process.wait(), place
        finally:
            process.kill()  # where this process is stopped by an error of its own
            process.wait()
            forward.process = None
            with suppress(BrokenPipeError):
                process.stdin.close()


def _say(text: str) -> None:
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)
