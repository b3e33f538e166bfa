"""What a process under supervision knows of its run, and tells: see `supervision`."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any

TRIES = 2
"""Of a pair, and of a place outside of pairs."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Crash:
    """A process of this run that was ended from outside: by which signal, and what it was working on then.

    done: steps of the stage. pair: empty when it was between pairs, or in a stage without them.
    """

    signal: str
    stage: str = ""
    done: float = 0.0
    pair: tuple[str, ...] = ()

    @property
    def told(self) -> str:
        """In words."""
        hint = " (out of memory?)" if self.signal == "SIGKILL" else ""
        return f"ended by {self.signal}{hint}"

    @staticmethod
    def of(told: dict[str, Any]) -> Crash:
        """The one that was told as JSON."""
        return Crash(**(told | {"pair": tuple(told["pair"])}))

    def same_place(self, other: Crash) -> bool:
        """Whether nothing was done between the two ends."""
        return (self.stage, self.done, self.pair) == (other.stage, other.done, other.pair)


@dataclass
class _Supervised:
    crashes: tuple[Crash, ...] = ()
    to_parent: IO[str] | None = None


_state = _Supervised()


def begin(crashes: Iterable[dict[str, Any]], pipe: int) -> None:
    """Be supervised from now on.

    Args: crashes: of the processes before this one, as JSON. pipe: file descriptor that the supervisor reads from.
    """
    _state.crashes = tuple(map(Crash.of, crashes))
    _state.to_parent = os.fdopen(pipe, "w", encoding="utf-8")


def crashes() -> tuple[Crash, ...]:
    """How the processes before this one were ended, of the same run."""
    return _state.crashes


def given_up(pair: Sequence[str]) -> str:
    """Why a pair is not to be tried again, empty when it is."""
    ends = [crash for crash in _state.crashes if crash.pair == tuple(pair)]
    if len(ends) < TRIES:
        return ""
    what = f"the process was {ends[-1].told} while it matched this pair, {len(ends)} times"
    return f"{what}; lower --image-size and --area-size, or take another --matcher"


def tell(stage: str, done: float, pair: Sequence[str]) -> None:
    """Tell the supervisor, if there is one, what is worked on from now on."""
    if _state.to_parent is not None:
        with suppress(OSError):  # the supervisor is gone, and this process soon
            _state.to_parent.write(json.dumps({"stage": stage, "done": done, "pair": list(pair)}) + "\n")
            _state.to_parent.flush()
