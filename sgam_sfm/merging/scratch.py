"""Arrays that are too long for memory: rows in files, and rows sorted by a small number."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from threading import Lock
from typing import TypeVar

import numpy as np

from sgam_sfm.merging.sorting import stable_order

_BUFFERED = 2**25  # bytes that wait in memory before they are written
_ROWS_AT_ONCE = 2**19

Item = TypeVar("Item")


class Scratch:
    """A folder for what a computation needs on disk, removed at the end of the context, also after an error."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._open: list[Rows] = []

    def __enter__(self) -> Scratch:
        shutil.rmtree(self.folder, ignore_errors=True)  # of a run that was killed
        self.folder.mkdir(parents=True)
        return self

    def __exit__(self, *_: object) -> None:
        for rows in self._open:
            rows.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def rows(self, name: str, width: int, dtype: type[np.generic]) -> Rows:
        """An empty file of rows."""
        self._open.append(Rows(self.folder / name, width, dtype))
        return self._open[-1]

    def sorted(self, name: str, width: int, dtype: type[np.generic]) -> Sorted:
        """No rows under no label."""
        return Sorted(self.folder / name, width, dtype)


class Rows:
    """Rows of equal length in a file, which threads may read and write."""

    def __init__(self, path: Path, width: int, dtype: type[np.generic]) -> None:
        self._file = path.open("w+b")
        self._lock, self._width, self._dtype = Lock(), width, np.dtype(dtype)
        self._row_bytes = width * self._dtype.itemsize
        self.count = 0

    def append(self, rows: np.ndarray) -> None:
        """Add rows (n, width) at the end."""
        self.write(self.count, rows)

    def write(self, begin: int, rows: np.ndarray) -> None:
        """Put rows (n, width) from a row on."""
        data = np.ascontiguousarray(rows, self._dtype)
        with self._lock:
            self._file.seek(begin * self._row_bytes)
            self._file.write(data.data)
        self.count = max(self.count, begin + len(rows))

    def read(self, begin: int, count: int) -> np.ndarray:
        """The rows (count, width) from a row on."""
        return self.read_parts([(begin, count)])

    def read_parts(self, parts: Sequence[tuple[int, int]]) -> np.ndarray:
        """The same of several parts (begin, count), one after the other."""
        rows = np.empty((sum(count for _, count in parts), self._width), self._dtype)
        place = 0
        with self._lock:
            for begin, count in parts:
                self._file.seek(begin * self._row_bytes)
                self._file.readinto(rows[place : place + count].data)
                place += count
        return rows

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


class Sorted:
    """Rows under labels; those of a label stay in the order in which they came. In a file per label."""

    def __init__(self, folder: Path, width: int, dtype: type[np.generic]) -> None:
        folder.mkdir(exist_ok=True)
        self._folder, self._width, self._dtype = folder, width, np.dtype(dtype)
        self._waiting: list[tuple[np.ndarray, np.ndarray]] = []
        self._bytes = 0
        self.labels: set[int] = set()

    def put(self, labels: np.ndarray, rows: np.ndarray) -> None:
        """Add rows (n, width) under labels (n,)."""
        if not len(rows):
            return
        self._waiting.append((labels.astype(np.int32), np.ascontiguousarray(rows, self._dtype)))
        self._bytes += sum(part.nbytes for part in self._waiting[-1])
        if self._bytes > _BUFFERED:
            self._flush()

    def take(self) -> Iterator[np.ndarray]:
        """All rows, by ascending label, in arrays (n, width) of limited length."""
        self._flush()
        for label in sorted(self.labels):
            with self._path(label).open("rb") as file:
                while len(rows := np.fromfile(file, self._dtype, _ROWS_AT_ONCE * self._width)):
                    yield rows.reshape(-1, self._width)
            self._path(label).unlink()

    def take_label(self, label: int) -> np.ndarray:
        """All rows (n, width) of a label."""
        rows = np.fromfile(self._path(label), self._dtype).reshape(-1, self._width)
        self._path(label).unlink()
        return rows

    def finish(self) -> list[int]:
        """Write what still waits. Returns: the labels that have rows, sorted."""
        self._flush()
        return sorted(self.labels)

    def _flush(self) -> None:
        if not self._waiting:
            return
        labels, rows = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
        self._waiting, self._bytes = [], 0
        order = stable_order(labels)
        labels, rows = labels[order], rows[order]
        begins = np.flatnonzero(np.diff(labels, prepend=labels[:1] - 1))
        for label, part in zip(labels[begins].tolist(), np.split(rows, begins[1:]), strict=True):
            with self._path(label).open("ab") as file:
                part.tofile(file)
            self.labels.add(label)

    def _path(self, label: int) -> Path:
        return self._folder / f"{label}.rows"


def batches(items: Iterable[Item], size: Callable[[Item], int], limit: int) -> Iterator[list[Item]]:
    """Successive items whose sizes sum to no more than a limit, one at least."""
    batch: list[Item] = []
    total = 0
    for item in items:
        if batch and total + size(item) > limit:
            yield batch
            batch, total = [], 0
        batch.append(item)
        total += size(item)
    if batch:
        yield batch
