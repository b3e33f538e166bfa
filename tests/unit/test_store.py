"""Blocks of pair results: what is damaged is found, what was made by hand is refused in one line."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from sgam_core import Area, AreaMatch, Box, Matches, PairResult, TwoViewModel
from sgam_core.errors import InputError
from sgam_sfm.runs.store import PairRecord, PairStore, read_outcomes, read_pair_outcomes, stored_files
from tests.pair_results import whole_images

PAIRS = (("a.jpg", "b.jpg"), ("a.jpg", "c.jpg"))


@pytest.fixture
def store(tmp_path) -> PairStore:
    rng = np.random.default_rng(0)
    matches = Matches(
        points0=rng.uniform(0, 99, (40, 2)), points1=rng.uniform(0, 99, (40, 2)), scores=rng.uniform(size=40)
    )
    result = whole_images(matches, fallback="none")
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
    del file["points0"]
    file["points0"] = array


def huge(file: h5py.File) -> None:
    del file["points0"]
    file.create_dataset("points0", shape=(10**12, 2), dtype="f4", chunks=(1024, 2))


def elsewhere(file: h5py.File) -> None:
    del file["facts"]
    file["facts"] = h5py.ExternalLink("/etc/passwd", "/facts")


def of_another_kind(file: h5py.File) -> None:
    del file["points0"]
    file.create_group("points0")


def telling(facts: object) -> Callable[[h5py.File], None]:
    """Facts of a block as someone would write them."""

    def change(file: h5py.File) -> None:
        del file["facts"]
        file["facts"] = np.frombuffer(json.dumps(facts).encode(), np.uint8)

    return change


FORGERIES = {
    "huge": huge,
    "elsewhere": elsewhere,
    "a group": of_another_kind,
    "text": lambda file: replace_points(file, [b"1"] * 40),
    "other shape": lambda file: replace_points(file, np.zeros((40, 3))),
    "fewer points": lambda file: replace_points(file, np.zeros((30, 2))),
    "a pickle": lambda file: replace_points(file, np.void(b"\x80\x04\x95")),
    "no names": telling([{"error": ""}, {"error": ""}]),
    "numbers": telling([1, 2]),
    "no JSON": lambda file: file["facts"].write_direct(np.full(file["facts"].shape, 255, np.uint8)),
    "facts of other pairs": telling([]),
    "no facts": lambda file: file.pop("facts"),
    "no ends": lambda file: file.pop("ends"),
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


def result_of(count, **changes):
    rng = np.random.default_rng(count)
    area = Area(box=Box(x0=1.0, y0=2.0, x1=30.0, y1=40.0), kind="object", label=3)
    values = {
        "matches": Matches(
            points0=rng.uniform(0, 99, (count, 2)).astype(np.float32),
            points1=rng.uniform(0, 99, (count, 2)).astype(np.float32),
            scores=rng.random(count),
            sigmas0=np.full(count, 1.5),
            area_index=np.zeros(count, np.int32),
        ),
        "areas": (AreaMatch(area0=area, area1=area, distance=0.25),),
        "two_view": TwoViewModel(F=np.eye(3), calibrated=True, num_inliers=2, num_matches=count, planarity=0.5),
        "coverage0": 0.4,
        "coverage1": 0.6,
        "whole_scale0": 0.5,
        "whole_scale1": 0.5,
    }
    return PairResult(**(values | changes))


RECORDS = (
    PairRecord(pair=("a", "b"), result=result_of(3)),
    PairRecord(pair=("a", "c"), result=None, error="cannot be read"),
    PairRecord(pair=("b", "ü"), result=result_of(0, two_view=None, areas=(), fallback="no areas", notes=("limit",))),
    PairRecord(pair=("c", "d"), result=result_of(2)),
)


def assert_same(read, written):
    assert [record.pair for record in read] == [record.pair for record in written]
    for one, other in zip(read, written, strict=True):
        assert one.error == other.error
        assert (one.result is None) == (other.result is None)
        if one.result is None:
            continue
        for name in ("areas", "coverage0", "coverage1", "whole_scale0", "fallback", "notes"):
            assert getattr(one.result, name) == getattr(other.result, name)
        for name in ("points0", "points1", "scores", "sigmas0", "sigmas1", "area_index"):
            np.testing.assert_array_equal(getattr(one.result.matches, name), getattr(other.result.matches, name))
        assert (one.result.two_view is None) == (other.result.two_view is None)
        if one.result.two_view is not None:
            np.testing.assert_array_equal(one.result.two_view.F, np.eye(3))
            assert one.result.two_view.num_inliers == 2


def test_a_block_is_read_as_it_was_written(tmp_path):
    store = PairStore(folder=tmp_path / "pairs", fingerprint="x")
    store.write(0, RECORDS)
    store.write(1, RECORDS[1:2])  # no match at all
    assert_same(list(store.read_all(2)), RECORDS + RECORDS[1:2])
    outcomes = [(o.pair, o.block, o.error, o.fallback) for o in read_pair_outcomes(tmp_path)]
    assert outcomes == [
        (("a", "b"), 0, "", ""),
        (("a", "c"), 0, "cannot be read", ""),
        (("b", "ü"), 0, "", "no areas"),
        (("c", "d"), 0, "", ""),
        (("a", "c"), 1, "cannot be read", ""),
    ]
    assert store.has(0)
    with pytest.raises(InputError, match="was made from other images, pairs or options"):
        PairStore(folder=store.folder, fingerprint="y").has(0)


def test_a_block_that_was_completed_as_its_run_was_killed_counts_once(store):
    store.write_begun(0, list(store.read(0)))
    store.write_begun(1, list(store.read(0)))
    assert [path.name for path in stored_files(store.folder.parent)] == ["00000.h5", "00001.begun"]
