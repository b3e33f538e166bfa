"""Where blocks of pairs are matched: in this process, or by the workers of a Ray cluster.

A block follows from its pairs and the options alone, so an executor may match blocks anywhere and in any order. It only
matches: one process, the one that started it, writes what it yields to the store.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from sgam_core import PointMatcher
from sgam_sfm.inputs import Inputs
from sgam_sfm.label_maps import LabelMaps
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair
from sgam_sfm.runs.store import PairRecord

Begin = Callable[[Pair], None]


@dataclass(frozen=True, kw_only=True, slots=True)
class MatchingJob:
    """What pairs are matched with. labels: None when the options need none."""

    options: MatchOptions
    inputs: Inputs
    labels: LabelMaps | None


@runtime_checkable
class Executor(Protocol):
    """Matches blocks of pairs.

    device: the torch device that it matches on. own_device: that of this process, for all other work.
    """

    @property
    def device(self) -> str: ...

    @property
    def own_device(self) -> str: ...

    def run(
        self, job: MatchingJob, blocks: Sequence[tuple[int, Sequence[Pair]]], begin: Begin
    ) -> Iterator[tuple[int, Sequence[PairRecord]]]:
        """Match the numbered blocks: the number of a block and the records of its next pairs, as soon as they are done.

        Blocks come in any order, the pairs of each in their own, every pair once.

        Args: begin is told, where a crash would end this process, which pair is next, if it is matched alone.
        Raises: OptionError when the options ignore or mask a label that is none.
        """
        ...

    def facts(self) -> dict[str, Any]:
        """What the summary is to say of the run."""
        ...


@contextmanager
def open_executor(options: MatchOptions, point_matcher: PointMatcher | None = None) -> Iterator[Executor]:
    """The executor of the options, ready to match.

    Args: point_matcher: in place of the one that the options name; the workers of a cluster make their own.
    Raises: OptionError for a model, device or cluster that cannot be used.
    """
    if options.executor == "ray":
        from sgam_sfm.executors.ray import connected

        with connected(options) as executor:
            yield executor
    else:
        from sgam_sfm.executors.local import LocalExecutor

        yield LocalExecutor.of(options, point_matcher)
