"""Work done by several threads at once."""

import threading
import time

import pytest

from sgam_sfm.threads import in_order


def test_work_comes_back_in_order_and_an_error_is_not_lost():
    assert list(in_order(lambda number: number**2, range(50))) == [number**2 for number in range(50)]
    with pytest.raises(ZeroDivisionError):
        list(in_order(lambda number: 1 // (3 - number), range(50)))


def test_what_has_not_begun_never_does_after_an_error():
    begun: list[int] = []

    def work(number: int) -> None:
        begun.append(number)
        time.sleep(0.01)
        if number == 3:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(in_order(work, range(100), threads=2))
    assert len(begun) < 12


def test_as_many_work_at_once_as_there_are_threads():
    together = threading.Barrier(3, timeout=10)  # passes when three wait for it at once
    assert list(in_order(lambda number: together.wait() >= 0, range(6), threads=3)) == [True] * 6
