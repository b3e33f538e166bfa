"""Raw pair results on disk, one HDF5 file per block of pairs: the unit of work.

A block's file appears under its name only when it is whole; until then, its first pairs are kept in one of the same
kind from time to time. A file begins with a digest of what follows, so that one that the disk has damaged is found, and
its pairs are matched again. The matches of its pairs follow each other in one array per field: HDF5 needs about as long
for an array of one pair as for one of thousands of matches.

    pairs/00000.h5          user block: SHA-256 of the rest; attributes: fingerprint
      facts                 JSON: for every pair its names, error, fallback, areas, two-view geometry, ...
      ends                  (P,) the row after the last match of every pair
      points0, points1      (M, 2) float32 pixels, corner origin
      scores, sigmas0, sigmas1, area_index  (M,)
    pairs/00001.begun       the same of a block that is in work
"""

from __future__ import annotations

import hashlib
import io
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic import TypeAdapter
from pydantic_core import from_json, to_json

from sgam_core import AreaMatch, Matches, PairResult, TwoViewModel
from sgam_core.errors import InputError, SGAMError
from sgam_sfm.files import replacing
from sgam_sfm.pairs import Pair

_ARRAYS = tuple(array.name for array in fields(Matches))
_PACKED = ("sigmas0", "sigmas1", "area_index")
_FACTS = (
    *("fallback", "coverage0", "coverage1", "whole_scale0", "whole_scale1"),
    *("notes", "pixels_matched", "turned", "zoom"),
)
_AREAS = TypeAdapter(tuple[AreaMatch, ...])
_BEGUN = ".begun"
_DIGEST_BLOCK = 512  # bytes before the HDF5 file proper: the smallest user block there is
_MAX_MATCHES = 10**8  # of a block: a file made by hand can claim any number in a few bytes
# What h5py, json and pydantic are known to raise on files that are damaged or made by hand.
_UNREADABLE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, IndexError, SGAMError)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PairRecord:
    """What the store holds of a pair: its result, or the error that stopped it."""

    pair: Pair
    result: PairResult | None
    error: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PairStore:
    """The blocks of one run. fingerprint: of everything that the results follow from."""

    folder: Path
    fingerprint: str

    def path(self, block: int) -> Path:
        """Where a block is kept."""
        return self.folder / f"{block:05d}.h5"

    def has(self, block: int, pairs: Sequence[Pair] = ()) -> bool:
        """Whether the block is done under the same fingerprint; one that is damaged is not, which the log tells.

        Args: pairs: what it has to hold, in this order; any when empty.
        Raises: InputError when it was made under another one.
        """
        names = self._pairs_in(self.path(block))
        return names is not None and (not pairs or names == list(pairs))

    def write(self, block: int, records: Sequence[PairRecord]) -> None:
        """Keep a whole block."""
        self._write(self.path(block), records)
        self._path_of_begun(block).unlink(missing_ok=True)

    def begun(self, block: int, pairs: Sequence[Pair]) -> list[PairRecord]:
        """The records of a block's first pairs, as far as they were matched and kept before it was whole.

        Args: pairs: all of the block.
        Raises: InputError when they were made under another fingerprint.
        """
        path = self._path_of_begun(block)
        names = self._pairs_in(path) or []
        return list(_read_file(path)) if names and names == list(pairs[: len(names)]) else []

    def write_begun(self, block: int, records: Sequence[PairRecord]) -> None:
        """Keep the first pairs of a block that is in work."""
        self._write(self._path_of_begun(block), records)

    def read(self, block: int) -> Iterator[PairRecord]:
        """The records of a block, in its order.

        Raises: InputError for a file that is damaged, or none of a store.
        """
        return _read_file(self.path(block))

    def failed(self, block: int) -> list[Pair]:
        """The pairs of a whole block that failed."""
        return [outcome.pair for outcome in read_outcomes(self.path(block)) if outcome.error]

    def replace(self, block: int, records: Sequence[PairRecord]) -> None:
        """Put records in the places of those that a whole block has of the same pairs."""
        new = {record.pair: record for record in records}
        self.write(block, [new.get(record.pair, record) for record in self.read(block)])

    def read_all(self, blocks: int) -> Iterator[PairRecord]:
        """The records of blocks 0, 1, ... in order, one block in memory at a time."""
        for block in range(blocks):
            yield from self.read(block)

    def _path_of_begun(self, block: int) -> Path:
        return self.path(block).with_suffix(_BEGUN)

    def _pairs_in(self, path: Path) -> list[Pair] | None:
        """The pairs of a file; None where there is none, or it is damaged."""
        if not path.exists():
            return None
        try:
            _check_digest(path)
            with h5py.File(path, "r") as file:
                mark = str(file.attrs["fingerprint"])
                names = [_pair_of(told) for told in _read_facts(file)]
        except _UNREADABLE as error:
            _log.warning("'%s' is damaged (%s): its pairs are matched again, all others are kept", path, _line(error))
            return None
        if mark != self.fingerprint:
            raise InputError(f"'{path}' was made from other images, pairs or options; choose a new --output folder")
        return names

    def _write(self, path: Path, records: Sequence[PairRecord]) -> None:
        content = io.BytesIO()  # HDF5 ends the process when it closes a file that the disk has no room for
        with h5py.File(content, "w", track_order=True, userblock_size=_DIGEST_BLOCK) as file:
            file.attrs["fingerprint"] = self.fingerprint
            _write_records(file, records)
        view = content.getbuffer()
        digest = hashlib.sha256(view[_DIGEST_BLOCK:]).hexdigest().encode()
        view[: len(digest)] = digest
        with replacing(path) as partial:
            partial.write_bytes(view)


def _read_file(path: Path) -> Iterator[PairRecord]:
    with _readable(path):
        _check_digest(path)  # first: on damaged files HDF5's own code can fail in ways that end the process
    with _readable(path), h5py.File(path, "r") as file:
        yield from _read_records(file)


def _write_records(file: h5py.File, records: Sequence[PairRecord]) -> None:
    told = [
        {"pair": record.pair, "error": record.error} | ({} if record.result is None else _facts(record.result))
        for record in records
    ]
    parts = [Matches.empty() if record.result is None else record.result.matches for record in records]
    file.create_dataset("facts", data=np.frombuffer(to_json(told), np.uint8))
    file.create_dataset("ends", data=np.cumsum([len(part) for part in parts], dtype=np.int64))
    joined = Matches.concatenate(parts)
    for name in _ARRAYS:
        array = getattr(joined, name)
        array = array.astype(np.float32) if array.dtype == np.float64 else array
        # Points and scores are as good as random: packing them costs time and saves nothing.
        pack = bool(len(array)) and name in _PACKED
        file.create_dataset(name, data=array, compression="lzf" if pack else None)


def _facts(result: PairResult) -> dict[str, Any]:
    """A result but for its matches and times (times differ between runs, a block's content does not)."""
    facts = {name: getattr(result, name) for name in _FACTS}
    model = result.two_view
    two_view = None if model is None else {name: getattr(model, name) for name in TwoViewModel.__slots__}
    if two_view is not None:
        two_view["F"] = model.F.tolist()  # type: ignore[union-attr]
    return facts | {"areas": _AREAS.dump_python(result.areas, mode="json"), "two_view": two_view}


def _read_records(file: h5py.File) -> Iterator[PairRecord]:
    arrays = {name: _array(file, name) for name in _ARRAYS}
    begin = 0
    for told, end in zip(_read_facts(file), _array(file, "ends").tolist(), strict=True):
        yield _record(told, {name: array[begin:end] for name, array in arrays.items()})
        begin = end


def _read_facts(file: h5py.File) -> list[dict[str, Any]]:
    """What a block tells of its pairs but for their matches."""
    facts: list[dict[str, Any]] = from_json(_array(file, "facts").tobytes())
    return facts


def _pair_of(told: dict[str, Any]) -> Pair:
    name0, name1 = map(str, told["pair"])
    return name0, name1


def _record(told: dict[str, Any], arrays: dict[str, np.ndarray]) -> PairRecord:
    pair, error = _pair_of(told), str(told["error"])
    if error:
        return PairRecord(pair=pair, result=None, error=error)
    facts = {name: value for name, value in told.items() if name not in ("pair", "error")}
    two_view = facts.pop("two_view")
    if two_view is not None:
        two_view = TwoViewModel(**(two_view | {"F": np.array(two_view["F"])}))
    return PairRecord(
        pair=pair,
        result=PairResult(
            matches=Matches(**arrays),
            areas=_AREAS.validate_python(facts.pop("areas")),
            two_view=two_view,
            **(facts | {"notes": tuple(facts["notes"])}),
        ),
    )


def _array(file: h5py.File, name: str) -> np.ndarray:
    """A whole array, by HDF5's own functions: h5py's take several times as long for small ones."""
    data = h5py.h5d.open(file.id, name.encode())
    if data.dtype.kind not in "fiu" or data.rank > 2 or math.prod(data.shape) > 2 * _MAX_MATCHES:
        raise ValueError(f"{name} has shape {data.shape} of {data.dtype}")
    array = np.empty(data.shape, data.dtype)
    data.read(h5py.h5s.ALL, h5py.h5s.ALL, array)
    return array


def stored_files(output: Path) -> list[Path]:
    """The blocks of a run's output folder that are done, then those in work."""
    done = sorted((output / "pairs").glob("*.h5"))
    begun = sorted((output / "pairs").glob(f"*{_BEGUN}"))
    # Where a run was killed as it completed a block, there are both.
    return [*done, *(path for path in begun if path.with_suffix(".h5") not in done)]


def read_pairs_of(output: Path) -> Iterator[PairRecord]:
    """The records of a finished run, from its output folder."""
    for path in sorted((output / "pairs").glob("*.h5")):
        yield from PairStore(folder=path.parent, fingerprint="").read(int(path.stem))


@dataclass(frozen=True, kw_only=True, slots=True)
class PairOutcome:
    """How a pair ended, without its matches, and in which block it is. error, fallback: empty when there was none."""

    pair: Pair
    block: int
    error: str
    fallback: str


def read_pair_outcomes(output: Path) -> Iterator[PairOutcome]:
    """How the pairs that are done so far ended.

    Raises: InputError for a file that is none of a store.
    """
    for path in sorted((output / "pairs").glob("*.h5")):
        yield from read_outcomes(path)


def read_outcomes(path: Path) -> list[PairOutcome]:
    """How the pairs of a block ended.

    Raises: InputError for a file that is none of a store.
    """
    with _readable(path), h5py.File(path, "r") as file:
        return [
            PairOutcome(
                pair=_pair_of(told),
                block=int(path.stem),
                error=str(told["error"]),
                fallback=str(told.get("fallback", "")),
            )
            for told in _read_facts(file)
        ]


def _check_digest(path: Path) -> None:
    """Raises: ValueError when a file is not what was written."""
    with path.open("rb") as file:
        said = file.read(_DIGEST_BLOCK)[:64]
        found = hashlib.file_digest(file, "sha256").hexdigest().encode()
    if said != found:
        raise ValueError("its content has changed since it was written")


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except _UNREADABLE as error:
        raise InputError(
            f"'{path}' is not a file of pair results, or damaged ({_line(error)}); start the run again: its pairs are "
            "matched again, all others are kept"
        ) from error


def _line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
