"""Point matchers that somebody else wrote, and that do what they may not."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from sgam_core import Image, Matches, SGAMOptions, WholeImages, match_described
from sgam_core.errors import OptionError, ShapeError
from sgam_sfm import registry

POINTS = np.random.default_rng(0).uniform((1, 1), (31, 23), (20, 2))


def matches(points0: np.ndarray = POINTS, scores: np.ndarray | None = None, **sigmas: np.ndarray) -> Matches:
    return Matches(points0=points0, points1=POINTS, scores=np.ones(len(POINTS)) if scores is None else scores, **sigmas)


class Gives:
    def __init__(self, give: Callable) -> None:
        self._give = give

    def match(self, pairs):
        return self._give(pairs)


def matched(give: Callable):
    image = Image(name="a", pixels=np.zeros((24, 32, 3), np.uint8))
    return match_described(image, image, None, None, WholeImages(), Gives(give), SGAMOptions())


def spoilt(value: float) -> np.ndarray:
    return np.concatenate([POINTS[:-1], [(value, 3.0)]])


@pytest.mark.parametrize(
    ("give", "said"),
    [
        (lambda pairs: [matches(spoilt(np.nan))], "points or scores that are not finite"),
        (lambda pairs: [matches(scores=np.full(20, np.inf))], "points or scores that are not finite"),
        (lambda pairs: [matches(scores=np.full(20, 80.0))], r"scores from 80 to 80; expected \[0, 1\]"),
        (lambda pairs: [matches(sigmas0=np.zeros(20))], "sigmas that are not above 0"),
        (lambda pairs: [], "0 Matches for 1 pairs of crops; expected one for each"),
        (lambda pairs: None, r"no list; expected a list of sgam_core\.Matches"),
        (lambda pairs: [(POINTS, POINTS)], r"tuple; expected a list of sgam_core\.Matches"),
        (lambda pairs: (matches() for _ in pairs), "no list; expected a list"),
    ],
)
def test_what_a_point_matcher_may_not_return_is_refused_by_its_name(give, said):
    with pytest.raises(ShapeError, match=f"^the point matcher Gives gave {said}"):
        matched(give)


@pytest.mark.parametrize("value", [-0.01, 32.01, 1e9])
def test_points_outside_of_their_crop_are_dropped_and_counted(value):
    result = matched(lambda pairs: [matches(spoilt(value))])
    np.testing.assert_allclose(result.matches.points0, POINTS[:-1])
    assert "1 of 20 matches of a crop lie outside of it, and are dropped" in result.notes


class NeedsMore:
    def __init__(self, model_path, device="cpu", **_):
        pass


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (f"{__name__}:NeedsMore", "its constructor needs 'model_path', which no option gives; let it have a default"),
        (f"{__name__}:Missing", f"there is no '{__name__}:Missing', as its package says"),
    ],
)
def test_a_plugin_that_cannot_be_made(monkeypatch, value, said):
    plugin = EntryPoint(name="mine", value=value, group=registry.KINDS["matcher"])
    monkeypatch.setattr(registry, "available", lambda kind: {"mine": plugin})
    with pytest.raises(OptionError) as told:
        registry.create("matcher", "mine", device="cpu")
    assert str(told.value).startswith(f"--matcher 'mine': {said}")
