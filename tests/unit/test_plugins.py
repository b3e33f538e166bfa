"""Matchers and segmenters that somebody else wrote, and that do what they may not."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from sgam_core import Image, Matches, SGAMOptions, WholeImages, match_described
from sgam_core.errors import InputError, OptionError, ShapeError
from sgam_sfm import registry
from sgam_sfm.images import ImageFile
from sgam_sfm.label_maps import write_label_maps
from sgam_sfm.options import MatchOptions
from sgam_sfm.progress import Stages
from sgam_sfm.runs.matching import create_matcher

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


class Segments:
    def __init__(self, *made) -> None:
        self._made = made

    def segment(self, images, advance):
        yield from zip(images, self._made, strict=False)


GOOD = np.ones((24, 32), np.int64)


def segmented(folder: Path, *made):
    images = {name: ImageFile(name=name, path=Path(name), width=32, height=24, digest=name) for name in ("a", "b")}
    return write_label_maps(Segments(GOOD, *made), "mine", images, folder, Stages(quiet=True), full_size=False).failed


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (GOOD - 2, "ids from -1 to -1 for 'b'; expected 0 (unknown) to 65535"),
        (GOOD * 70_000, "ids from 70000 to 70000 for 'b'; expected 0 (unknown) to 65535"),
        (
            GOOD.astype(float),
            "float64 (24, 32) for 'b'; expected integers (24, 32), or another size of the same aspect",
        ),
        (GOOD[:, :24], "int64 (24, 24) for 'b'; expected integers (24, 32)"),
        (GOOD.T, "int64 (32, 24) for 'b'; expected integers (24, 32)"),
        ([[1]], "list for 'b'; expected integers (24, 32)"),
    ],
)
def test_what_a_segmenter_may_not_give_is_the_reason_of_its_image(tmp_path, made, said):
    assert segmented(tmp_path, made)["b"].startswith(f"the segmenter Segments gave {said}")


def test_maps_of_other_sizes_and_what_is_missing(tmp_path):
    assert segmented(tmp_path / "half", GOOD[::2, ::2]) == {}
    assert segmented(tmp_path / "one") == {"b": "the segmenter Segments gave nothing for 'b'"}


def test_labels_that_no_image_can_use_end_the_run(tmp_path):
    image = {"a": ImageFile(name="a", path=Path("a"), width=32, height=24, digest="a")}
    with pytest.raises(
        InputError, match="none of the 1 images has a label map that can be used: the segmenter Segments"
    ):
        write_label_maps(Segments(-GOOD), "mine", image, tmp_path, Stages(quiet=True), full_size=False)


def test_weights_for_a_matcher_that_has_none(tmp_path):
    options = MatchOptions(images=tmp_path, output=tmp_path, matcher="sift", weights=tmp_path / "a.pt")
    with pytest.raises(OptionError, match=r"a\.pt': 'sift' has none; leave it out"):
        create_matcher(options)
