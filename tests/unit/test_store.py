import json

import h5py
import numpy as np
import pytest

from sgam_core import Area, AreaMatch, Box, Matches, PairResult, TwoViewModel
from sgam_core.errors import InputError
from sgam_sfm.store import PairRecord, PairStore, read_pair_outcomes, read_pairs_of


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


def test_a_file_with_a_group_for_every_pair_is_read_too(tmp_path):
    new = PairStore(folder=tmp_path / "new", fingerprint="x")
    new.write(0, RECORDS)
    (tmp_path / "pairs").mkdir()
    with h5py.File(new.path(0)) as flat, h5py.File(tmp_path / "pairs" / "00000.h5", "w", track_order=True) as file:
        file.attrs["fingerprint"] = "x"
        begin = 0
        for number, (facts, end) in enumerate(zip(json.loads(flat["facts"][()].tobytes()), flat["ends"], strict=True)):
            group = file.create_group(str(number))
            group.attrs["name0"], group.attrs["name1"] = facts.pop("pair")
            group.attrs["error"] = error = facts.pop("error")
            if not error:
                group.attrs["fallback"] = facts.pop("fallback")
                group["facts"] = json.dumps(facts)
                for name in ("points0", "points1", "scores", "sigmas0", "sigmas1", "area_index"):
                    group[name] = flat[name][begin:end]
            begin = end
    assert_same(list(read_pairs_of(tmp_path)), RECORDS)
    assert [(o.pair, o.error, o.fallback) for o in read_pair_outcomes(tmp_path)] == [
        (("a", "b"), "", ""),
        (("a", "c"), "cannot be read", ""),
        (("b", "ü"), "", "no areas"),
        (("c", "d"), "", ""),
    ]
