"""A block that is stopped in the middle goes on there."""

from __future__ import annotations

import errno
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sgam_core import Matches
from sgam_core.errors import InputError
from sgam_sfm.executors import Begin, MatchingJob
from sgam_sfm.inputs import Inputs
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair, PairList
from sgam_sfm.progress import Stages
from sgam_sfm.runs import block_matching
from sgam_sfm.runs.block_matching import match_blocks
from sgam_sfm.runs.store import PairRecord, PairStore, stored_files
from tests.pair_results import whole_images

NAMES = "abcdefg"
WORK = tuple(tuple((name, str(number)) for number in range(4)) for name in NAMES[:2])


class PairByPair:
    """Matches nothing, a pair at a time, until something stops it before a pair; what is broken fails."""

    device = own_device = "cpu"

    def __init__(self, stops: dict[Pair, BaseException] | None = None, *, broken: str = "1") -> None:
        self.stops, self.broken = stops or {}, broken
        self.asked: list[Pair] = []

    def run(
        self, job: MatchingJob, blocks: Sequence[tuple[int, Sequence[Pair]]], begin: Begin
    ) -> Iterator[tuple[int, Sequence[PairRecord]]]:
        for number, pairs in blocks:
            for pair in pairs:
                if pair in self.stops:
                    raise self.stops[pair]
                self.asked.append(pair)
                yield number, [record(pair, self.broken)]

    def facts(self) -> dict[str, Any]:
        return {}


def record(pair: Pair, broken: str = "1") -> PairRecord:
    if pair[1] == broken:
        return PairRecord(pair=pair, result=None, error="broken")
    points = np.random.default_rng(NAMES.index(pair[0]) * 10 + int(pair[1])).uniform(0, 99, (5, 2))
    matches = Matches(points0=points, points1=points + 1, scores=np.ones(5))
    result = whole_images(matches, fallback="none", seconds={"point matching": 1.0})
    return PairRecord(pair=pair, result=result)


def matched(folder: Path, executor: PairByPair, fingerprint: str = "mark", **options: Any) -> Stages:
    stages = Stages(quiet=True)
    inputs = Inputs(images={}, cameras={}, failed={}, num_other_files=0, pairs=PairList(pairs=()))
    job = MatchingJob(options=MatchOptions(images=folder, output=folder, **options), inputs=inputs, labels=None)
    match_blocks(WORK, PairStore(folder=folder / "pairs", fingerprint=fingerprint), executor, job, stages)
    return stages


@pytest.fixture
def undisturbed(tmp_path) -> dict[str, bytes]:
    matched(tmp_path / "undisturbed", PairByPair())
    return content(tmp_path / "undisturbed")


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in stored_files(folder)}


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), RuntimeError("a fault of ours")])
def test_a_run_that_is_stopped_goes_on_with_the_next_pair(tmp_path, undisturbed, stop):
    with pytest.raises(type(stop)):
        matched(tmp_path, PairByPair({("b", "2"): stop}))
    assert [path.name for path in stored_files(tmp_path)] == ["00000.h5", "00001.begun"]
    rest = PairByPair()
    stages = matched(tmp_path, rest)
    assert rest.asked == [("b", "2"), ("b", "3")]
    assert stages.counts == {"pairs_done": 6, "pairs_failed": 2, "fallbacks": 6}
    assert content(tmp_path) == undisturbed


def test_a_stop_while_a_block_is_written_costs_nothing_of_it(tmp_path, undisturbed, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(PairStore, "write", stopped)
        with pytest.raises(KeyboardInterrupt):
            matched(tmp_path, PairByPair())
    rest = PairByPair()
    matched(tmp_path, rest)
    assert rest.asked == list(WORK[1])
    assert content(tmp_path) == undisturbed


def test_what_is_done_of_a_block_is_kept_while_it_lasts(tmp_path, undisturbed, monkeypatch):
    monkeypatch.setattr(block_matching, "_MOST_LOST_SECONDS", -1.0)
    store = PairStore(folder=tmp_path / "pairs", fingerprint="mark")
    kept = []

    class Watched(PairByPair):
        def run(self, job, blocks, begin):
            for found in super().run(job, blocks, begin):
                kept.append([len(store.begun(number, pairs)) for number, pairs in enumerate(WORK)])
                yield found

    matched(tmp_path, Watched())
    assert kept == [[0, 0], [1, 0], [2, 0], [3, 0], [0, 0], [0, 1], [0, 2], [0, 3]]
    assert content(tmp_path) == undisturbed


def test_a_damaged_beginning_is_told_and_matched_again(tmp_path, undisturbed, caplog):
    caplog.set_level(logging.WARNING)
    with pytest.raises(KeyboardInterrupt):
        matched(tmp_path, PairByPair({("b", "2"): KeyboardInterrupt()}))
    begun = tmp_path / "pairs" / "00001.begun"
    begun.write_bytes(begun.read_bytes()[:-7])
    again = PairByPair()
    matched(tmp_path, again)
    assert again.asked == list(WORK[1])
    assert f"'{begun}' is damaged" in caplog.text
    assert content(tmp_path) == undisturbed


def test_failed_pairs_are_matched_once_more_when_asked_for(tmp_path):
    matched(tmp_path / "well", PairByPair(broken=""))
    matched(tmp_path / "out", PairByPair())
    untouched = PairByPair(broken="")
    matched(tmp_path / "out", untouched)
    assert untouched.asked == []
    with pytest.raises(KeyboardInterrupt):
        matched(tmp_path / "out", PairByPair({("b", "1"): KeyboardInterrupt()}, broken=""), retry_failed=True)
    again = PairByPair(broken="")
    stages = matched(tmp_path / "out", again, retry_failed=True)
    assert again.asked == [("b", "1")]
    assert stages.counts == {"pairs_done": 8, "fallbacks": 8}
    assert content(tmp_path / "out") == content(tmp_path / "well")


def test_the_beginning_of_another_run_is_refused(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        matched(tmp_path, PairByPair({("a", "2"): KeyboardInterrupt()}))
    with pytest.raises(InputError, match="made from other images, pairs or options"):
        matched(tmp_path, PairByPair(), fingerprint="other")


def test_a_full_disk_is_what_is_told(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, "No space left on device")

    def fail(*_):
        raise full

    monkeypatch.setattr(PairStore, "_write", fail)
    with pytest.raises(OSError, match="No space left on device") as told:
        matched(tmp_path, PairByPair())
    assert told.value is full
