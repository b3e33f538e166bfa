"""The precision of point matchers: a choice that few have, and that others need not know of."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from sgam_core.errors import OptionError
from sgam_sfm import registry
from sgam_sfm.executors.ray import on_this_cpu
from sgam_sfm.inputs import Inputs
from sgam_sfm.match_cache import CachedMatcher
from sgam_sfm.matchers.xfeat import XFeatStar
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import PairList
from sgam_sfm.runs.matching import create_matcher


class Plain:
    """A matcher of a user, who has never heard of precision."""

    def match(self, pairs):
        return []


class Choosing(Plain):
    """One that has a choice."""

    def __init__(self, *, precision: str) -> None:
        self.precision = precision


def given(matcher: str, **options: object) -> MatchOptions:
    return MatchOptions(images=Path("photos"), output=Path("out"), matcher=matcher, device="cpu", **options)


@pytest.fixture(autouse=True)
def entries(monkeypatch):
    kinds = {"plain": Plain, "choosing": Choosing}
    group = registry.KINDS["matcher"]
    known = {name: EntryPoint(name, f"{__name__}:{kind.__name__}", group) for name, kind in kinds.items()}
    installed = registry.available("matcher")
    monkeypatch.setattr(registry, "available", lambda kind: installed | known)


@pytest.mark.parametrize("precision", ["auto", "full", "half"])
def test_a_matcher_that_has_the_choice_is_told(precision):
    assert create_matcher(given("choosing", precision=precision)).precision == precision


def test_a_matcher_that_has_none_works_as_before_and_says_so_when_it_is_asked_for():
    assert isinstance(create_matcher(given("plain")), Plain)
    for name in ("plain", "sift"):
        with pytest.raises(OptionError, match=f"^--precision full: '{name}' has no choice of it; leave it out$"):
            create_matcher(given(name, precision="full"))


def test_half_precision_without_a_gpu_is_refused_before_anything_is_matched():
    with pytest.raises(OptionError, match=r"^--precision half: on the CPU networks take"):
        create_matcher(given("xfeat-star", precision="half"))
    assert isinstance(create_matcher(given("xfeat-star", precision="full")), XFeatStar)


def test_a_machine_without_a_gpu_may_start_workers_that_have_one():
    assert on_this_cpu(given("choosing", precision="half")).precision == "full"
    assert on_this_cpu(given("choosing")).precision == "auto"


def test_matches_on_disk_are_those_of_their_precision(tmp_path):
    inputs = Inputs(images={}, cameras={}, failed={}, num_other_files=0, pairs=PairList(pairs=()))
    keys = {CachedMatcher.of(given("choosing", precision=p), inputs, tmp_path).key for p in ("auto", "full")}
    assert len(keys) == 2
