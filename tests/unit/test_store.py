"""Blocks of pair results: what is damaged is found, what was made by hand is refused in one line."""

from __future__ import annotations

import hashlib
import io
import logging
from pathlib import Path

import h5py
import numpy as np
import pytest

from sgam_core import Matches, PairResult
from sgam_core.errors import InputError
from sgam_sfm.store import PairRecord, PairStore, read_outcomes

PAIRS = (("a.jpg", "b.jpg"), ("a.jpg", "c.jpg"))


@pytest.fixture
def store(tmp_path) -> PairStore:
    rng = np.random.default_rng(0)
    matches = Matches(
        points0=rng.uniform(0, 99, (40, 2)), points1=rng.uniform(0, 99, (40, 2)), scores=rng.uniform(size=40)
    )
    result = PairResult(
        matches=matches,
        areas=(),
        two_view=None,
        coverage0=0,
        coverage1=0,
        whole_scale0=1,
        whole_scale1=1,
        fallback="none",
    )
    store = PairStore(folder=tmp_path / "pairs", fingerprint="mark")
    store.write(0, [PairRecord(pair=PAIRS[0], result=result), PairRecord(pair=PAIRS[1], result=None, error="broken")])
    return store


def changed(store: PairStore, change) -> None:
    """Change a block as an HDF5 file, as someone would who knows of the digest."""
    content = io.BytesIO(store.path(0).read_bytes())
    with h5py.File(content, "r+") as file:
        change(file)
    data = content.getvalue()
    store.path(0).write_bytes(hashlib.sha256(data[512:]).hexdigest().encode().ljust(512, b"\0") + data[512:])


def test_a_block_is_there_for_its_own_pairs_and_options_only(store):
    assert store.has(0)
    assert store.has(0, PAIRS)
    assert not store.has(0, PAIRS[::-1])
    assert not store.has(1)
    with pytest.raises(InputError, match="was made from other images, pairs or options; choose a new --output folder"):
        PairStore(folder=store.folder, fingerprint="other").has(0)


@pytest.mark.parametrize("row", [0, 100, 600, 5000, -1])
def test_one_changed_bit_is_found(store, row, caplog):
    data = bytearray(store.path(0).read_bytes())
    data[row] ^= 16
    store.path(0).write_bytes(data)
    assert store.has(0, PAIRS) == (row == 100)  # between the digest and what it is of there is nothing
    if row != 100:
        assert "pairs are matched again, all others are kept" in caplog.text
        with pytest.raises(InputError, match="its content has changed since it was written"):
            list(store.read(0))


@pytest.mark.parametrize("length", [0, 30, 512, 4000])
def test_a_block_that_was_cut_short_is_not_there(store, length, caplog):
    caplog.set_level(logging.WARNING)
    store.path(0).write_bytes(store.path(0).read_bytes()[:length])
    assert not store.has(0, PAIRS)
    assert f"'{store.path(0)}' is damaged" in caplog.text


def replace_points(file: h5py.File, array: object) -> None:
    del file["0/points0"]
    file["0/points0"] = array


def huge(file: h5py.File) -> None:
    del file["0/points0"]
    file["0"].create_dataset("points0", shape=(10**12, 2), dtype="f4", chunks=(1024, 2))


def elsewhere(file: h5py.File) -> None:
    del file["0"]
    file["0"] = h5py.ExternalLink("/etc/passwd", "/0")


def of_another_kind(file: h5py.File) -> None:
    del file["0/points0"]
    file.create_group("0/points0")


FORGERIES = {
    "huge": huge,
    "elsewhere": elsewhere,
    "a group": of_another_kind,
    "text": lambda file: replace_points(file, [b"1"] * 40),
    "other shape": lambda file: replace_points(file, np.zeros((40, 3))),
    "a pickle": lambda file: replace_points(file, np.void(b"\x80\x04\x95")),
    "no attributes": lambda file: file["0"].attrs.clear(),
    "facts that are none": lambda file: file["0/facts"].write_direct(np.array(b"[]", dtype=object)),
    "no facts": lambda file: file["0"].pop("facts"),
    "missing": lambda file: file.pop("0"),
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_block_made_by_hand_is_refused_in_one_line(store, forgery):
    changed(store, FORGERIES[forgery])
    with pytest.raises(InputError, match=r"'.*00000\.h5' is not a file of pair results, or damaged \(") as error:
        list(store.read(0))
    assert "\n" not in str(error.value)


def test_outcomes(store, tmp_path: Path):
    assert [(outcome.pair, outcome.error, outcome.fallback) for outcome in read_outcomes(store.path(0))] == [
        (PAIRS[0], "", "none"),
        (PAIRS[1], "broken", ""),
    ]
    (tmp_path / "text.h5").write_text("text")
    with pytest.raises(InputError, match="is not a file of pair results"):
        read_outcomes(tmp_path / "text.h5")
