"""Match the blocks of pairs that the store does not hold yet, wherever the executor does so, into the store."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from sgam_sfm.executors import Executor, MatchingJob
from sgam_sfm.pairs import Pair
from sgam_sfm.progress import Stages
from sgam_sfm.store import PairStore, read_outcomes


def match_blocks(
    work: Sequence[Sequence[Pair]],
    store: PairStore,
    executor: Executor,
    job: MatchingJob,
    stages: Stages,
    numbers: Collection[int] | None = None,
) -> dict[str, float]:
    """Match every block that the store does not hold yet, and give the seconds that each step took, of all workers.

    A block follows from its pairs and the options alone: the point matcher starts each one with empty caches, so that
    what it did before cannot decide how it batches.

    Args: numbers: of the blocks to see to; all of them by default.
    """
    wanted = range(len(work)) if numbers is None else numbers
    kept = {number for number in wanted if store.has(number, work[number])}
    count_outcomes(stages, store, kept)
    done = sum(len(work[number]) for number in kept)
    seconds: dict[str, float] = {}
    with stages.stage("Matching pairs", sum(len(work[number]) for number in wanted), done) as advance:
        waiting = [(number, work[number]) for number in wanted if number not in kept]
        for number, records in executor.run(job, waiting, advance, stages.working_on):
            store.write(number, records)
            for record in records:
                result = record.result
                stages.counts.update(_counted(record.error, result.fallback if result else ""))
                for step, spent in (result.seconds if result else {}).items():
                    seconds[step] = seconds.get(step, 0.0) + spent
    return seconds


def count_outcomes(stages: Stages, store: PairStore, blocks: Iterable[int]) -> None:
    """Count how the pairs of blocks that are done have ended."""
    for block in blocks:
        for outcome in read_outcomes(store.path(block)):
            stages.counts.update(_counted(outcome.error, outcome.fallback))


def _counted(error: str, fallback: str) -> tuple[str, ...]:
    """How a pair ended, in the words of heartbeats."""
    if error:
        return ("pairs_failed",)
    return ("pairs_done", "fallbacks") if fallback else ("pairs_done",)
