"""What is asked for by name, read once and kept while there is room; what comes next is read meanwhile."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from threading import Lock
from typing import Generic, TypeVar

T = TypeVar("T")
_AHEAD = 2  # that the thread has been asked for, one of which it reads


class ReadAhead(Generic[T]):
    """Values by name; the least recently used are dropped first. Threads may ask at once.

    The thread changes nothing but the time at which a value is read: one that it fails to read is read again when it is
    asked for, and raises what it raises then.

    Args:
        read: the value of a name; called by one other thread too.
        capacity: most values in memory, those that are being read included.
    """

    def __init__(self, read: Callable[[str], T], capacity: int) -> None:
        self._read, self._capacity = read, capacity
        self._kept: OrderedDict[str, T] = OrderedDict()
        self._coming: deque[str] = deque()  # names of the plan that have not been asked for
        self._planned: frozenset[str] = frozenset()
        self._asked: dict[str, Future[T]] = {}
        self._thread: ThreadPoolExecutor | None = None
        self._lock = Lock()

    def __call__(self, name: str) -> T:
        """The value of a name, read now when it is not there. Raises: what reading it raises."""
        with self._lock:
            if name not in self._kept:
                if name in self._coming:
                    self._coming.remove(name)
                self._kept[name] = self._arrived(name)
            self._kept.move_to_end(name)
            value = self._kept[name]
            self._ask()  # drops it where it is not of this plan, but of the one before
            return value

    @contextmanager
    def ahead(self, names: Iterable[str]) -> Iterator[None]:
        """Read ahead what will be asked for inside, in the order of the names; repeated ones are read once."""
        with self._lock:
            self._planned = frozenset(plan := dict.fromkeys(names))
            self._coming = deque(name for name in plan if name not in self._kept)
            self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read ahead")
        try:
            yield
        finally:
            with self._lock:
                self._stop()

    def clear(self) -> None:
        """Forget all, and read nothing ahead until the next plan."""
        with self._lock:
            self._stop()
            self._kept.clear()

    def _arrived(self, name: str) -> T:
        if name in self._asked:
            with suppress(Exception):
                return self._asked.pop(name).result()
        self._make_room(at_any_cost=True)
        return self._read(name)

    def _ask(self) -> None:
        """Let the thread read what comes next, where that drops nothing that the plan has use for."""
        while self._thread is not None and self._coming and len(self._asked) < _AHEAD and self._make_room():
            name = self._coming.popleft()
            self._asked[name] = self._thread.submit(self._read, name)

    def _make_room(self, *, at_any_cost: bool = False) -> bool:
        """Drop values until one more has room, False when it gets none; those of the plan only at any cost."""
        while self._kept and len(self._kept) + len(self._asked) >= self._capacity:
            idle = next((name for name in self._kept if name not in self._planned), None)
            if idle is None and not at_any_cost:
                return False
            del self._kept[next(iter(self._kept)) if idle is None else idle]
        return True

    def _stop(self) -> None:
        self._coming.clear()
        self._planned = frozenset()
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
            self._thread = None
        self._asked.clear()
