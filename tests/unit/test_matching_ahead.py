"""Pairs are matched alike whether images are read ahead or not, and whatever becomes of the images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations, count
from pathlib import Path
from threading import Barrier

import numpy as np
import PIL.Image
import pytest

from sgam_core import Crop, Matches
from sgam_sfm import read_ahead
from sgam_sfm.executors import MatchingJob
from sgam_sfm.executors.local import LocalExecutor
from sgam_sfm.images import read_image
from sgam_sfm.inputs import Inputs, read_inputs
from sgam_sfm.machine import use_threads
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import blocks
from sgam_sfm.progress import Stages
from sgam_sfm.runs import matching, supervised
from sgam_sfm.runs.store import PairRecord

NUM_IMAGES = 7


@dataclass
class MeanMatcher:
    """One match a pair, at what the crops' means are, so that no image can be taken for another one."""

    calls: list[tuple[str, str]] = field(default_factory=list)
    repeatable: bool = False
    concurrent: bool = False
    resets: int = 0

    def reset(self) -> None:
        self.resets += 1

    def match(self, pairs: Sequence[tuple[Crop, Crop]]) -> list[Matches]:
        self.calls += [(crop0.image.name, crop1.image.name) for crop0, crop1 in pairs]
        means = [[crop.pixels()[..., :2].mean((0, 1)) / 12 for crop in pair] for pair in pairs]
        return [Matches(points0=a[None], points1=b[None], scores=np.ones(1)) for a, b in means]


@pytest.fixture
def options(tmp_path) -> MatchOptions:
    rng = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for number in range(NUM_IMAGES):
        pixels = rng.integers(0, 200, (24, 32, 3), np.uint8) + np.uint8(5 * number)
        PIL.Image.fromarray(pixels).save(tmp_path / "images" / f"{number}.png")
    return MatchOptions(images=tmp_path / "images", output=tmp_path / "out", area_matcher="none", block_images=2)


@pytest.fixture
def inputs(options) -> Inputs:
    return read_inputs(options, Stages(quiet=True))


@pytest.fixture
def four_threads() -> Iterator[None]:
    use_threads(4)
    yield
    use_threads(0)


def matched(
    options: MatchOptions,
    inputs: Inputs,
    matcher: MeanMatcher | None = None,
    begin: Callable[[tuple[str, str]], None] = lambda _: None,
) -> dict[tuple[str, str], tuple[list, str]]:
    """What each pair's record holds."""
    executor = LocalExecutor(device="cpu", point_matcher=matcher or MeanMatcher())
    job = MatchingJob(options=options, inputs=inputs, labels=None)
    numbered = list(enumerate(blocks(inputs.pairs.pairs, options.block_images)))
    found = [(number, record) for number, records in executor.run(job, numbered, begin) for record in records]
    assert [(number, record.pair) for number, record in found] == [(n, pair) for n, block in numbered for pair in block]
    records = [record for _, record in found]
    assert {record.pair for record in records} == set(combinations(sorted(inputs.images), 2))
    return {record.pair: (content(record), record.error) for record in records}


def content(record: PairRecord) -> list:
    result = record.result
    return [] if result is None else [result.matches.points0.tolist(), result.matches.points1.tolist()]


def test_results_do_not_depend_on_reading_ahead(options, inputs, monkeypatch):
    ahead = matched(options, inputs)
    monkeypatch.setattr(read_ahead, "_AHEAD", 0)
    assert matched(options, inputs) == ahead
    assert len({repr(points) for points, _ in ahead.values()}) == NUM_IMAGES * (NUM_IMAGES - 1) // 2


def test_results_do_not_depend_on_how_many_pairs_are_matched_at_once(options, inputs, four_threads):
    told: list[tuple[str, str]] = []
    together, number = Barrier(4, timeout=10), count()

    class Together(MeanMatcher):
        def match(self, pairs):
            if next(number) < 4:
                together.wait()  # passes when four threads are here
            return super().match(pairs)

    one = matched(options, inputs)
    assert matched(options, inputs, Together(repeatable=True, concurrent=True), told.append) == one
    assert told == []  # none of them would be known to have ended this process


@pytest.mark.parametrize(
    ("ends", "alone"),
    [
        ([], 0),
        ([()], 2),
        ([(), ("0.png", "4.png")], 2),
        ([(), ()], 10),
        ([("0.png", "1.png"), ("0.png", "1.png")], 2),
    ],
)
def test_pairs_are_matched_one_by_one_where_one_of_them_ended_the_process(
    options, inputs, monkeypatch, four_threads, ends, alone
):
    expected = matched(options, inputs)
    crashes = tuple(supervised.Crash(signal="SIGKILL", pair=pair) for pair in ends)
    monkeypatch.setattr(supervised._state, "crashes", crashes)
    told: list[tuple[str, str]] = []
    found = matched(options, inputs, MeanMatcher(repeatable=True, concurrent=True), told.append)
    order = blocks(inputs.pairs.pairs, options.block_images)
    assert told == [pair for block in order[:alone] for pair in block]
    given_up = {pair for pair in ends if pair and ends.count(pair) == 2}
    assert {pair for pair in found if found[pair] != expected[pair]} == given_up
    for pair in given_up:
        assert "was ended by SIGKILL (out of memory?) while it matched this pair, 2 times" in found[pair][1]


def test_an_image_that_is_gone_or_broken_is_the_reason_of_its_pairs_alone(options, inputs, monkeypatch):
    (options.images / "3.png").unlink()
    (options.images / "5.png").write_bytes(b"\x89PNG no more")
    ahead = matched(options, inputs)
    monkeypatch.setattr(read_ahead, "_AHEAD", 0)
    assert matched(options, inputs) == ahead
    for pair, (_, error) in ahead.items():
        assert bool(error) == bool({"3.png", "5.png"} & {*pair}), pair
    assert ahead["2.png", "3.png"][1].startswith(f"image '{options.images / '3.png'}' cannot be read")
    assert "'5.png' cannot be decoded" in ahead["4.png", "5.png"][1]


def test_memory_that_does_not_suffice_for_an_image_once(options, inputs, monkeypatch):
    """Whoever reads it: the pair is tried again with empty caches."""
    expected = matched(options, inputs)
    tries: list[Path] = []

    def read(file):
        tries.append(file.path)
        if tries.count(file.path) == 1 and file.name in ("1.png", "4.png"):
            raise MemoryError("Unable to allocate 9 GiB")
        return read_image(file)

    monkeypatch.setattr(matching, "read_image", read)
    assert matched(options, inputs) == expected


def test_a_fault_in_somebodys_matcher_is_the_reason_of_its_pairs_alone(options, inputs, monkeypatch, caplog):
    expected = matched(options, inputs)
    plain = MeanMatcher.match

    def match(self, pairs):
        if pairs[0][0].image.name == "2.png":
            raise ValueError("a late bug\nwith more to tell")
        return plain(self, pairs)

    monkeypatch.setattr(MeanMatcher, "match", match)
    caplog.set_level("INFO")
    for pair, (points, error) in matched(options, inputs).items():
        if pair[0] == "2.png":
            assert error.startswith("ValueError: a late bug (test_matching_ahead.py:")
            assert error.endswith("; the log has the traceback")
        else:
            assert (points, error) == expected[pair]
    assert "with more to tell" in caplog.text
    assert "Traceback (most recent call last)" in caplog.text


@pytest.mark.parametrize(
    ("good", "message", "tried"), [(0, "a bug", 3), (1, "CUDA error: unspecified launch failure", 2)]
)
def test_a_matcher_that_never_works_ends_the_run(options, inputs, monkeypatch, good, message, tried):
    calls = []

    def match(self, pairs):
        calls.append(pairs)
        if len(calls) > good:
            raise RuntimeError(message)
        return [Matches.empty()]

    monkeypatch.setattr(MeanMatcher, "match", match)
    with pytest.raises(RuntimeError, match=message):
        matched(options, inputs)
    assert len(calls) == tried


def test_nothing_is_read_ahead_once_a_process_was_ended_from_outside(options, inputs, monkeypatch):
    """A pair is judged by what ends its process, and that must not be the image of another pair."""
    told: list[tuple[str, int]] = []

    def read(file):
        told.append((file.name, len(matcher.calls)))
        return read_image(file)

    matcher = MeanMatcher()
    monkeypatch.setattr(matching, "read_image", read)
    monkeypatch.setattr(supervised._state, "crashes", (supervised.Crash(signal="SIGKILL"),))
    job = MatchingJob(options=options, inputs=inputs, labels=None)
    order = (("0.png", "2.png"), ("0.png", "3.png"), ("1.png", "2.png"))
    executor = LocalExecutor(device="cpu", point_matcher=matcher)
    list(executor.run(job, [(0, order)], lambda _: None))
    assert told == [("0.png", 0), ("2.png", 0), ("3.png", 1), ("1.png", 2)]


@pytest.mark.parametrize("repeatable", [False, True])
def test_caches_outlive_a_block_where_they_change_no_result(options, inputs, repeatable):
    matcher = MeanMatcher(repeatable=repeatable)
    job = MatchingJob(options=options, inputs=inputs, labels=None)
    numbered = list(enumerate(blocks(inputs.pairs.pairs, options.block_images)))
    assert list(LocalExecutor(device="cpu", point_matcher=matcher).run(job, numbered, lambda _: None))
    assert matcher.resets == 1 + (0 if repeatable else len(numbered))  # it may have matched another collection before
