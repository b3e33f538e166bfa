"""Blocks of pairs matched by this process, one block after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sgam_core import PointMatcher
from sgam_sfm.executors import Begin, MatchingJob
from sgam_sfm.machine import find_device, use_threads
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair
from sgam_sfm.runs.matching import CollectionMatcher, create_matcher
from sgam_sfm.runs.store import PairRecord
from sgam_sfm.runs.supervised import crashes

_BLOCKS_AT_ONCE = 2  # the end of one and the beginning of the next


@dataclass(frozen=True, kw_only=True, slots=True)
class LocalExecutor:
    """See `sgam_sfm.executors.Executor`."""

    device: str
    point_matcher: PointMatcher

    @property
    def own_device(self) -> str:
        return self.device

    @staticmethod
    def of(options: MatchOptions, point_matcher: PointMatcher | None = None) -> LocalExecutor:
        """The device, threads and point matcher of the options. Raises: OptionError for what cannot be used."""
        device = str(find_device(options.device, "--device"))
        use_threads(options.threads)
        point_matcher = point_matcher or create_matcher(replace(options, device=device))
        return LocalExecutor(device=device, point_matcher=point_matcher)

    def run(
        self, job: MatchingJob, blocks: Sequence[tuple[int, Sequence[Pair]]], begin: Begin
    ) -> Iterator[tuple[int, Sequence[PairRecord]]]:
        matcher = CollectionMatcher(job.options, job.inputs, job.labels, self.point_matcher)
        for number, record in matcher.match_blocks(blocks, begin, alone=_blocks_alone(len(blocks))):
            yield number, [record]

    def facts(self) -> dict[str, Any]:
        return {"name": "local"}


def _blocks_alone(count: int) -> int:
    """Blocks whose pairs are matched one by one, so that what ends the process is known to be one of them.

    What ended a process while it matched several pairs is in the first two blocks that are not done. When that happens
    again, it is no single pair: they are too many at once.
    """
    ends = crashes()
    return count if sum(not end.pair for end in ends) > 1 else min(_BLOCKS_AT_ONCE, count) if ends else 0
