"""Match the blocks of pairs that the store does not hold yet, wherever the executor does so, into the store."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress

from sgam_sfm.executors import Executor, MatchingJob
from sgam_sfm.pairs import Pair
from sgam_sfm.progress import Stages
from sgam_sfm.runs.store import PairRecord, PairStore, read_outcomes

_MOST_LOST_SECONDS = 30.0  # of matching, besides the pair in work


def match_blocks(
    work: Sequence[Sequence[Pair]],
    store: PairStore,
    executor: Executor,
    job: MatchingJob,
    stages: Stages,
    numbers: Collection[int] | None = None,
) -> dict[str, float]:
    """Match every block that the store does not hold yet, and give the seconds that each step took, of all workers.

    A block follows from its pairs and the options alone: where its caches could decide how it batches, the point
    matcher starts each one with empty ones. What is done of a block is kept twice a minute and when the run is stopped,
    so that a stop costs little however slow the matcher is. Pairs that are matched once more (`retry_failed`) take
    their places in a block when all of these are done.

    Args: numbers: of the blocks to see to; all of them by default.
    """
    wanted = range(len(work)) if numbers is None else numbers
    kept = {number for number in wanted if store.has(number, work[number])}
    failed = {number: store.failed(number) for number in kept} if job.options.retry_failed else {}
    retried = {number for number, pairs in failed.items() if pairs}
    count_outcomes(stages, store, kept - retried)
    count_outcomes(stages, store, retried, with_failures=False)
    opened: dict[int, list[PairRecord]] = {number: [] for number in retried}
    waiting: list[tuple[int, Sequence[Pair]]] = []
    for number in wanted:
        if number in retried:
            waiting.append((number, failed[number]))
        elif number not in kept:
            opened[number] = begun = store.begun(number, work[number])
            _count(stages, begun)
            if len(begun) == len(work[number]):  # stopped while it was written
                store.write(number, opened.pop(number))
            else:
                waiting.append((number, work[number][len(begun) :]))
    num_pairs = sum(len(work[number]) for number in wanted)
    seconds: dict[str, float] = {}

    def keep(number: int) -> None:
        if opened[number] and number not in retried:
            store.write_begun(number, opened[number])

    with stages.stage("Matching pairs", num_pairs, num_pairs - sum(len(rest) for _, rest in waiting)) as advance:
        saved = time.monotonic()
        try:
            for number, found in executor.run(job, waiting, stages.working_on):
                records = opened[number]
                records += found
                if len(records) == len(failed[number] if number in retried else work[number]):
                    write = store.replace if number in retried else store.write
                    write(number, records)
                    del opened[number]  # not before: a stop while it is written keeps it
                    saved = time.monotonic()
                elif time.monotonic() - saved > _MOST_LOST_SECONDS:
                    keep(number)
                    saved = time.monotonic()
                _count(stages, found)
                for record in found:
                    for step, spent in (record.result.seconds if record.result else {}).items():
                        seconds[step] = seconds.get(step, 0.0) + spent
                advance(len(found))
        except BaseException:
            with suppress(OSError):  # what stops the run is to be told, and may be a full disk
                for number in opened:
                    keep(number)
            raise
    return seconds


def count_outcomes(stages: Stages, store: PairStore, blocks: Iterable[int], *, with_failures: bool = True) -> None:
    """Count how the pairs of blocks that are done have ended."""
    for block in blocks:
        for outcome in read_outcomes(store.path(block)):
            if with_failures or not outcome.error:
                stages.counts.update(_counted(outcome.error, outcome.fallback))


def _count(stages: Stages, records: Iterable[PairRecord]) -> None:
    for record in records:
        stages.counts.update(_counted(record.error, record.result.fallback if record.result else ""))


def _counted(error: str, fallback: str) -> tuple[str, ...]:
    """How a pair ended, in the words of heartbeats."""
    if error:
        return ("pairs_failed",)
    return ("pairs_done", "fallbacks") if fallback else ("pairs_done",)
