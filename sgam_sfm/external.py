"""A worker: a script that matches or segments in another Python environment, and the talk with it.

The protocol is described in `sgam_sfm.workers.sgam_worker`, the module that the worker imports.
"""

from __future__ import annotations

import logging
import os
import shlex
import signal
import subprocess
import sys
import weakref
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader, BufferedWriter, TextIOWrapper
from pathlib import Path
from threading import Event, Thread, Timer
from typing import IO, Any, TypeVar

import numpy as np

from sgam_core.errors import InputError, OptionError, SGAMError, StageError
from sgam_sfm.options import MatchOptions, SegmentOptions
from sgam_sfm.workers import sgam_worker
from sgam_sfm.workers.sgam_worker import PROTOCOL, ProtocolError, read_message, write_message

_log = logging.getLogger(__name__)
_LAST_LINES, _LINE_LENGTH = 16, 200
_NOT_INHERITED = ("PYTHONPATH", "PYTHONHOME")  # they lead to packages of this environment
_SECONDS_TO_END = 5.0

Header = Mapping[str, Any]
T = TypeVar("T")


class WorkerError(SGAMError):
    """A worker could not do one thing that it was asked for; it may do the next."""


@dataclass(frozen=True, kw_only=True, slots=True)
class WorkerCommand:
    """How a worker is started.

    kind: matcher or segmenter. name: of the model, as the option of that kind has it. python: None for the one that
    runs. timeout: seconds for its start, and for each pair or image. threads: of the CPU, 0 for all cores.
    """

    kind: str
    name: str
    python: Path | None = None
    script: Path | None = None
    arguments: tuple[str, ...] = ()
    timeout: float = 600.0
    threads: int = 0

    @staticmethod
    def of(options: MatchOptions | SegmentOptions, kind: str, name: str) -> WorkerCommand:
        """What the options of that kind say. Raises: OptionError for arguments with an open quote."""
        try:
            arguments = shlex.split(getattr(options, f"{kind}_args"))
        except ValueError as error:
            raise OptionError(f"--{kind}-args cannot be split ({error}); quote as in a shell") from error
        return WorkerCommand(
            kind=kind,
            name=name,
            python=getattr(options, f"{kind}_python"),
            script=getattr(options, f"{kind}_script"),
            arguments=tuple(arguments),
            timeout=options.worker_timeout,
            threads=options.threads,
        )

    @property
    def line(self) -> list[str]:
        """The command line.

        Raises: OptionError when none is named, or the time-out is none; InputError when Python or script is missing.
        """
        python, script = self.python or Path(sys.executable), self.script
        if script is None:
            raise OptionError(
                f"--{self.kind} {self.name} needs --{self.kind}-script FILE, the worker; docs/workers.md tells how to "
                "write one"
            )
        for option, path, wanted in (
            ("python", python, "the Python of the worker's environment, such as /path/env/bin/python"),
            ("script", script, "the worker, a Python script"),
        ):
            if not path.is_file():
                state = "is a folder" if path.is_dir() else "does not exist"
                raise InputError(f"--{self.kind}-{option} '{path}' {state}; give {wanted}")
        if not self.timeout > 0:
            raise OptionError(f"--worker-timeout is {self.timeout:g}; expected more than 0 seconds")
        return [str(python.absolute()), sgam_worker.__file__, str(script.absolute()), *self.arguments]

    def __str__(self) -> str:
        return f"--{self.kind} {self.name} ('{self.script}')"


def refuse_unused_script(options: MatchOptions | SegmentOptions, kind: str) -> None:
    """Raises: OptionError for a script that nothing would run: its user expects its results."""
    name = getattr(options, kind)
    if getattr(options, f"{kind}_script") is not None and name != "external":
        raise OptionError(f"--{kind}-script would not be used by --{kind} {name}; add `--{kind} external`")


class Worker:
    """A worker that runs; one that crashes or hangs is started again once for every thing that it is asked.

    hello: what it says of itself. settings: what its script is given.
    Raises: OptionError when it cannot be started, StageError when it ends, fails or is not understood before it is
        ready.
    """

    def __init__(self, command: WorkerCommand, settings: Header) -> None:
        self._command = command
        self._settings = {**settings, "threads": command.threads}
        self._has_answered = False
        self._process = self._started()

    def ask(self, header: Header, arrays: Sequence[np.ndarray], read: Callable[[list[np.ndarray]], T], count: int) -> T:
        """What the worker answers.

        Args: read: makes a value of the answer's arrays, or raises WorkerError. count: pairs or images asked for.
        Raises: WorkerError when it cannot do this one thing; StageError when it ends or hangs twice, or when its very
            first answer is unusable: then it is the script that is wrong, not a pair.
        """
        try:
            answer, results = self._answer(header, arrays, count)
            if answer["type"] == "error":
                raise WorkerError(f"{self._command} failed: {answer.get('message')}")
            value = read(results)
        except WorkerError as error:
            if self._has_answered:
                raise
            raise StageError(f"{error}{self._process.told()}") from error
        self._has_answered = True
        return value

    def wrong(self, what: str) -> WorkerError:
        """The error of an answer that is not what it should be."""
        return WorkerError(f"{self._command} {what}")

    def unusable(self, what: str) -> StageError:
        """The error of a worker whose hello is not what it should be; it is ended."""
        return StageError(f"{self._command} {what}{self._process.told()}")

    def close(self) -> None:
        """End the worker."""
        self._process.end()

    def _answer(self, header: Header, arrays: Sequence[np.ndarray], count: int) -> tuple[Header, list[np.ndarray]]:
        seconds = self._command.timeout * count
        try:
            return self._process.exchange(header, arrays, seconds)
        except _EndedError as error:
            _log.warning("%s %s; it is started again", self._command, error)
        self._process = self._started()
        try:
            return self._process.exchange(header, arrays, seconds)
        except _EndedError as error:
            raise StageError(
                f"{self._command} {error}, and did so twice for the same {'pairs' if 'pairs' in header else 'image'}; "
                f"what is done is kept: mend the worker, then start the same command again{self._process.told()}"
            ) from error

    def _started(self) -> _Process:
        command = self._command
        process = _Process(command)
        request = {"type": "hello", "protocol": PROTOCOL, "kind": command.kind, "settings": self._settings}
        try:
            hello, _ = process.exchange(request, (), command.timeout)
        except _EndedError as error:
            served = f"serve_{command.kind}"
            raise StageError(f"{command} {error} before it came to {served}{process.told()}") from error
        wrong = _misunderstanding(hello, command.kind)
        if wrong:
            process.end()
            raise StageError(f"{command} {wrong}{process.told()}")
        self.hello = hello
        return process


def _misunderstanding(hello: Header, kind: str) -> str:
    """Why a worker cannot be used; empty when it can."""
    if hello["type"] == "error":
        return f"could not load its model: {hello.get('message')}"
    if hello["type"] != "hello" or hello.get("protocol") != PROTOCOL:
        return (
            f"speaks version {hello.get('protocol')} of the protocol, this sgam-sfm version {PROTOCOL}; let the script "
            f"use the sgam_worker.py of this sgam-sfm ('{sgam_worker.__file__}')"
        )
    if hello.get("kind") != kind:
        other = hello.get("kind")
        return f"is a {other}; give it by --{other} external --{other}-script"
    return ""


class _EndedError(Exception):
    """A worker that runs no more, and why."""


class _Process:
    """One life of a worker."""

    def __init__(self, command: WorkerCommand) -> None:
        environment = {name: value for name, value in os.environ.items() if name not in _NOT_INHERITED}
        try:
            self._process = subprocess.Popen(
                command.line,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                # What it printed before a crash, and where in its script that was, is worth most.
                env=environment | {"PYTHONUNBUFFERED": "1", "PYTHONFAULTHANDLER": "1"},
                start_new_session=True,  # so that it ends with all that it starts
            )
        except OSError as error:
            reason = error.strerror or error
            raise OptionError(
                f"--{command.kind}-python '{command.python}' cannot be run ({reason}); give a Python"
            ) from error
        self._lines: deque[str] = deque(maxlen=_LAST_LINES)
        log = Thread(target=_read_log, args=(self._process.stderr, self._lines), daemon=True)
        log.start()
        self.end = weakref.finalize(self, _end, self._process, log)

    def exchange(self, header: Header, arrays: Sequence[np.ndarray], seconds: float) -> tuple[Header, list[np.ndarray]]:
        """Send a message and wait for the answer.

        Raises: _EndedError when none comes, or what comes is none; the process has ended then.
        """
        requests, answers = self._process.stdin, self._process.stdout
        assert isinstance(requests, BufferedWriter)
        assert isinstance(answers, BufferedReader)
        late = Event()

        def stop() -> None:
            late.set()
            _kill(self._process)

        timer = Timer(seconds, stop)
        timer.start()
        try:
            write_message(requests, header, arrays)
            return read_message(answers)
        except (EOFError, OSError, ValueError, ProtocolError) as error:
            reason = f"did not answer within {seconds:g} s (--worker-timeout)" if late.is_set() else self._reason(error)
            self.end()
            raise _EndedError(reason) from error
        except BaseException:  # interrupted: what it still answers is not what is asked next
            self.end()
            raise
        finally:
            timer.cancel()
            timer.join()  # it holds on to this process until it ends

    def told(self) -> str:
        """The last lines that the process printed, for the end of a message; it is ended."""
        self.end()
        return "".join(["; its last lines:", *(f"\n  {line}" for line in self._lines)]) if self._lines else ""

    def _reason(self, error: BaseException) -> str:
        if isinstance(error, ProtocolError):
            return f"sent what is no message of the protocol ({error}); nothing else may print where its Python starts"
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_SECONDS_TO_END)
        code = self._process.returncode
        if code is None or code >= 0:
            return "closed its pipe" if code is None else f"ended with exit code {code}"
        memory = ", often for lack of memory" if code == -9 else ""
        return f"was ended by signal {-code} ({signal.strsignal(-code)}{memory})"


def _read_log(stream: IO[bytes], lines: deque[str]) -> None:
    with TextIOWrapper(stream, encoding="utf-8", errors="replace") as text:
        for line in text:
            if line.strip():
                _log.info("worker: %s", line.rstrip())
                lines.append(line.rstrip()[:_LINE_LENGTH])


def _kill(process: subprocess.Popen) -> None:
    with suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _end(process: subprocess.Popen, log: Thread) -> None:
    _kill(process)
    process.wait()
    log.join(_SECONDS_TO_END)
    for stream in (process.stdin, process.stdout):
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.close()
