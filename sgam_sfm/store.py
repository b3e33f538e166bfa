"""Raw pair results on disk, one HDF5 file per block of pairs: the unit of work and of resume.

A block's file appears under its name only when it is whole, so that a block either counts as done or is done again.

    pairs/00000.h5          attributes: fingerprint
      /0, /1, ...           one group a pair, in the block's order
         attributes         name0, name1, error and fallback (empty: none)
         facts              areas, two-view geometry, ... as JSON
         points0, points1   (M, 2) float32 pixels, corner origin
         scores, sigmas0, sigmas1, area_index  (M,)
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from pydantic import TypeAdapter
from pydantic_core import to_jsonable_python

from sgam_core import AreaMatch, Matches, PairResult, TwoViewModel
from sgam_core.errors import InputError
from sgam_sfm.files import replacing
from sgam_sfm.pairs import Pair

_ARRAYS = tuple(array.name for array in fields(Matches))
_AREAS = TypeAdapter(tuple[AreaMatch, ...])


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

    def has(self, block: int) -> bool:
        """Whether the block is done under the same fingerprint.

        Raises: InputError when it was made under another one.
        """
        path = self.path(block)
        if not path.exists():
            return False
        with h5py.File(path, "r") as file:
            if file.attrs["fingerprint"] != self.fingerprint:
                raise InputError(f"'{path}' was made from other images, pairs or options; choose a new --output folder")
        return True

    def write(self, block: int, records: Sequence[PairRecord]) -> None:
        """Keep a whole block."""
        content = io.BytesIO()  # HDF5 ends the process when it closes a file that the disk has no room for
        with h5py.File(content, "w", track_order=True) as file:
            file.attrs["fingerprint"] = self.fingerprint
            for index, record in enumerate(records):
                _write_record(file.create_group(str(index)), record)
        with replacing(self.path(block)) as partial:
            partial.write_bytes(content.getbuffer())

    def read(self, block: int) -> Iterator[PairRecord]:
        """The records of a block, in its order."""
        with h5py.File(self.path(block), "r") as file:
            for index in range(len(file)):
                yield _read_record(file[str(index)])

    def read_all(self, blocks: int) -> Iterator[PairRecord]:
        """The records of blocks 0, 1, ... in order, one block in memory at a time."""
        for block in range(blocks):
            yield from self.read(block)


def _write_record(group: h5py.Group, record: PairRecord) -> None:
    group.attrs["name0"], group.attrs["name1"] = record.pair
    group.attrs["error"] = record.error
    result = record.result
    if result is None:
        return
    group.attrs["fallback"] = result.fallback
    group.create_dataset("facts", data=json.dumps(_facts(result)))
    for name in _ARRAYS:
        array = getattr(result.matches, name)
        array = array.astype(np.float32) if array.dtype == np.float64 else array
        group.create_dataset(name, data=array, compression="lzf" if len(array) else None)


def _facts(result: PairResult) -> dict[str, Any]:
    """A result but for its matches, fallback and times (times differ between runs, a block's content does not)."""
    facts = {
        name: getattr(result, name)
        for name in ("coverage0", "coverage1", "whole_scale0", "whole_scale1", "notes", "pixels_matched")
    }
    model = result.two_view
    two_view = None if model is None else {name: getattr(model, name) for name in TwoViewModel.__slots__}
    if two_view is not None:
        two_view["F"] = model.F.tolist()  # type: ignore[union-attr]
    facts |= {"areas": _AREAS.dump_python(result.areas, mode="json"), "two_view": two_view}
    return to_jsonable_python(facts)


def _read_record(group: h5py.Group) -> PairRecord:
    pair = (str(group.attrs["name0"]), str(group.attrs["name1"]))
    error = str(group.attrs["error"])
    if error:
        return PairRecord(pair=pair, result=None, error=error)
    facts = json.loads(group["facts"][()])
    two_view = facts.pop("two_view")
    if two_view is not None:
        two_view = TwoViewModel(**(two_view | {"F": np.array(two_view["F"])}))
    return PairRecord(
        pair=pair,
        result=PairResult(
            matches=Matches(**{name: group[name][()] for name in _ARRAYS}),
            areas=_AREAS.validate_python(facts.pop("areas")),
            two_view=two_view,
            fallback=str(group.attrs["fallback"]),
            **(facts | {"notes": tuple(facts["notes"])}),
        ),
    )


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
        try:
            with h5py.File(path, "r") as file:
                for group in file.values():
                    name0, name1, error = (str(group.attrs[name]) for name in ("name0", "name1", "error"))
                    fallback = "" if error else str(group.attrs["fallback"])
                    yield PairOutcome(pair=(name0, name1), block=int(path.stem), error=error, fallback=fallback)
        except (OSError, KeyError, ValueError) as reason:
            raise InputError(f"'{path}' is not a file of pair results; remove it and start the run again") from reason
