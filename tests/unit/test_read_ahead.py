"""Reading ahead changes when a value is read, and nothing else."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable

import pytest

from sgam_sfm.read_ahead import ReadAhead

WAIT = 10.0  # seconds, for what must happen at once


class Value:
    def __init__(self, name: str) -> None:
        self.name = name


class Reader:
    """Counts reads, who made them, and how many values were alive at most. failing: what a thread's read raises."""

    def __init__(self, failing: Callable[[], BaseException] | None = None) -> None:
        self.reads: list[tuple[str, bool]] = []  # name, by the thread
        self.alive: weakref.WeakSet[Value] = weakref.WeakSet()
        self.most = 0
        self.failing = failing

    def __call__(self, name: str) -> Value:
        by_thread = threading.current_thread() is not threading.main_thread()
        self.reads.append((name, by_thread))
        if by_thread and self.failing is not None:
            raise self.failing()
        value = Value(name)
        self.alive.add(value)
        self.most = max(self.most, len(self.alive))
        return value


def test_what_comes_next_is_read_by_the_thread_meanwhile_and_only_once():
    reader = Reader()
    values = ReadAhead(reader, 4)
    with values.ahead(["a", "b", "a", "c"]):
        assert values("a").name == "a"
        for name in ("b", "a", "c", "a"):
            assert values(name).name == name
    assert sorted(reader.reads) == [("a", False), ("b", True), ("c", True)]


def test_it_reads_while_this_thread_is_at_work():
    reader = Reader()
    values = ReadAhead(reader, 4)
    with values.ahead(["a", "b"]):
        values("a")
        deadline = time.monotonic() + WAIT
        while ("b", True) not in reader.reads and time.monotonic() < deadline:
            time.sleep(0.01)
        assert reader.reads == [("a", False), ("b", True)]  # before it was asked for


def test_without_a_plan_nothing_is_read_but_what_is_asked_for():
    reader = Reader()
    values = ReadAhead(reader, 2)
    for name in "abcab":
        values(name)
    assert [name for name, _ in reader.reads] == ["a", "b", "c", "a", "b"]  # the least recently used were dropped
    assert not any(by_thread for _, by_thread in reader.reads)


@pytest.mark.parametrize("capacity", [2, 4, 6])
def test_never_more_values_are_in_memory_than_there_is_room_for(capacity):
    """Blocks of as many names as there is room for, which follow each other and share some."""
    reader = Reader()
    values = ReadAhead(reader, capacity)
    names = [f"{number}" for number in range(4 * capacity)]
    for start in range(0, len(names) - capacity + 1, capacity // 2):
        block = names[start : start + capacity]
        pairs = [(a, b) for a in block[: capacity // 2] for b in block[capacity // 2 :]]
        with values.ahead(name for pair in pairs for name in pair):
            for pair in pairs:
                assert tuple(values(name).name for name in pair) == pair
    assert reader.most <= capacity
    assert sorted(name for name, _ in reader.reads) == sorted(names)  # what blocks share is read once


def test_a_plan_for_more_than_there_is_room_for_is_followed_as_far_as_there_is():
    reader = Reader()
    values = ReadAhead(reader, 3)
    with values.ahead("abcdef"):
        assert [values(name).name for name in "abcdef"] == list("abcdef")
    assert reader.most <= 3


@pytest.mark.parametrize("failing", [lambda: OSError("broken"), lambda: MemoryError("none left")])
def test_what_the_thread_fails_to_read_is_read_when_it_is_asked_for(failing):
    reader = Reader(failing)
    values = ReadAhead(reader, 4)
    with values.ahead(["a", "b"]):
        values("a")
        assert values("b").name == "b"
    assert reader.reads == [("a", False), ("b", True), ("b", False)]


def test_an_error_is_raised_each_time_it_is_asked_for():
    def read(name: str) -> Value:
        if name == "broken":
            raise OSError(name)
        return Value(name)

    values = ReadAhead(read, 4)
    with values.ahead(["a", "broken", "b"]):
        values("a")
        for _ in range(2):
            with pytest.raises(OSError, match="broken"):
                values("broken")
        assert values("b").name == "b"


def test_after_clearing_all_is_read_anew_and_nothing_ahead():
    reader = Reader()
    values = ReadAhead(reader, 4)
    with values.ahead(["a", "b", "c"]):
        values("a")
        values.clear()
        before = len(reader.reads)
        for name in "abc":
            values(name)
    assert reader.reads[before:] == [("a", False), ("b", False), ("c", False)]


def test_an_interruption_leaves_no_thread_and_no_reading_behind():
    started, go_on = threading.Event(), threading.Event()

    def read(name: str) -> Value:
        if threading.current_thread() is not threading.main_thread():
            started.set()
            assert go_on.wait(WAIT)
        reads.append(name)
        return Value(name)

    reads: list[str] = []
    before = threading.active_count()

    def interrupted() -> None:
        values = ReadAhead(read, 8)
        with values.ahead("abcdef"):
            values("a")
            assert started.wait(WAIT)
            timer.start()
            raise KeyboardInterrupt

    timer = threading.Timer(0.2, go_on.set)
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    timer.join()
    assert reads == ["a", "b"]  # the one that was being read, none of those that were to come
    assert threading.active_count() == before
