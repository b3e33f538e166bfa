"""Pairs that one method did best and worst at against another, as pictures that the page carries inside it."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sgam_core import Matches, PairResult
from sgam_core.errors import InputError
from sgam_sfm.colmap.reading import read_pair_inliers
from sgam_sfm.comparison.report.bounds import Bounds, evenly_of
from sgam_sfm.comparison.report.runs import MethodRun, has_store, read_matches
from sgam_sfm.images import read_image
from sgam_sfm.pairs import Pair
from sgam_sfm.pictures.canvas import WIDTH, ImageView
from sgam_sfm.pictures.pair import Matching, PairPicture, draw_pair
from sgam_sfm.runs.results import Results, open_results

_QUALITY = 72


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """A picture as a data URI."""

    uri: str
    width: int
    height: int
    alt: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Entry:
    """A pair of the gallery, with the inliers of the method and of the reference. problem: why there is no picture."""

    pair: Pair
    inliers: tuple[int, int]
    pictures: tuple[Picture, ...]
    problem: str = ""

    @property
    def change(self) -> int:
        """Inliers more than the reference's."""
        return self.inliers[0] - self.inliers[1]


@dataclass(frozen=True, kw_only=True, slots=True)
class Gallery:
    """As many pairs that gained most as pairs that lost most, of one method against the reference."""

    method: str
    reference: str
    gained: tuple[Entry, ...]
    lost: tuple[Entry, ...]


def make_gallery(runs: Sequence[MethodRun], reference: MethodRun, images: Path, bounds: Bounds) -> Gallery | None:
    """The gallery of the first method with areas (else the first other one); None where nothing can be compared."""
    others = [run for run in runs if run is not reference]
    method = next((run for run in others if run.has_areas), next(iter(others), None))
    if method is None:
        return None
    best, worst = extremes(method, reference, bounds.gallery)
    if not best:
        return None
    sides = [_Side(run, _open(run, images)) for run in (method, reference)]
    gained, lost = (tuple(_entry(pair, sides, images, bounds) for pair in pairs) for pairs in (best, worst))
    return Gallery(method=method.name, reference=reference.name, gained=gained, lost=lost)


def extremes(method: MethodRun, reference: MethodRun, wanted: int) -> tuple[list[Pair], list[Pair]]:
    """The pairs with most inliers more than the reference, and as many with most inliers less, the worst first.

    Both lists are equally long and share no pair, also where no pair lost: its least gained ones are shown then.
    """
    pairs = {*method.pairs, *reference.pairs}
    ranked = sorted(pairs, key=lambda pair: (reference.facts(pair).inliers - method.facts(pair).inliers, pair))
    count = min(wanted, len(ranked) // 2)
    return ranked[:count], ranked[::-1][:count]


def thumbnails(names: Sequence[str], images: Path, bounds: Bounds) -> dict[str, str]:
    """Small pictures of images as data URIs, by name; images that cannot be read have none."""
    found = {}
    for name in evenly_of(names, bounds.thumbnails):
        try:
            with PIL.Image.open(images / name) as picture:
                picture.draft("RGB", (2 * bounds.thumbnail_side,) * 2)  # a JPEG is decoded at a fraction of its size
                small = picture.convert("RGB")
        except (OSError, ValueError):
            continue
        small.thumbnail((bounds.thumbnail_side,) * 2)
        found[name] = _uri(small, 60)
    return found


def image_sizes(names: Sequence[str], images: Path) -> dict[str, tuple[int, int]]:
    """Width and height of images, of those that can be read."""
    found = {}
    for name in names:
        try:
            with PIL.Image.open(images / name) as picture:
                found[name] = picture.size
        except (OSError, ValueError):
            continue
    return found


class _Side(NamedTuple):
    """One of two methods. results: None where it has no store of its own, as SIFT."""

    run: MethodRun
    results: Results | None


def _entry(pair: Pair, sides: Sequence[_Side], images: Path, bounds: Bounds) -> Entry:
    inliers = (sides[0].run.facts(pair).inliers, sides[1].run.facts(pair).inliers)
    try:
        figures = _figures(pair, sides, images)
    except InputError:
        return Entry(pair=pair, inliers=inliers, pictures=(), problem="its images can no longer be read.")
    names = " and ".join(pair)
    pictures = tuple(
        _picture(figure, f"{title} of {names}: areas and point matches drawn over both images", bounds)
        for title, figure in figures.items()
    )
    return Entry(pair=pair, inliers=inliers, pictures=pictures)


def _figures(pair: Pair, sides: Sequence[_Side], images: Path) -> dict[str, Figure]:
    """One picture with both methods beneath each other; a reference with areas of its own has a second one."""
    pixels = [read_image(images / name) for name in pair]
    found = [_matching(side, pair) for side in sides]
    if found[1].result.areas:
        return {
            side.run.name: _draw(pair, pixels, side.results, matching, None)
            for side, matching in zip(sides, found, strict=True)
        }
    title = f"{sides[0].run.name}, and beneath {sides[1].run.name}"
    return {title: _draw(pair, pixels, sides[0].results, found[0], found[1])}


def _open(run: MethodRun, images: Path) -> Results | None:
    return open_results(run.folder, images) if has_store(run.folder) and images.is_dir() else None


def _matching(side: _Side, pair: Pair) -> Matching:
    run = side.run
    result = _database_result(run, pair) if side.results is None else side.results.result(pair)
    inliers = read_pair_inliers(run.database, pair) if run.database.is_file() else None
    return Matching(title=run.name, result=_nothing() if result is None else result, inliers=inliers)


def _database_result(run: MethodRun, pair: Pair) -> PairResult | None:
    """What the database of a run without a store has of a pair."""
    found = next(read_matches(run.folder, {pair}), None)
    if found is None:
        return None
    matches = Matches(points0=found.points0, points1=found.points1, scores=np.ones(len(found.points0), np.float32))
    return _result(matches)


def _nothing() -> PairResult:
    return _result(Matches.empty())


def _result(matches: Matches) -> PairResult:
    return PairResult(
        matches=matches, areas=(), two_view=None, coverage0=0.0, coverage1=0.0, whole_scale0=1.0, whole_scale1=1.0
    )


def _draw(
    pair: Pair, pixels: Sequence[np.ndarray], results: Results | None, matching: Matching, plain: Matching | None
) -> Figure:
    views = [
        ImageView.of(name, image, None if results is None else results.labels(name))
        for name, image in zip(pair, pixels, strict=True)
    ]
    names: Mapping[int, str] = {} if results is None else results.label_names()
    return draw_pair(PairPicture(views=(views[0], views[1]), matching=matching, plain=plain, label_names=names))


def _picture(figure: Figure, alt: str, bounds: Bounds) -> Picture:
    figure.set_dpi(figure.dpi * min(bounds.picture_width / WIDTH, 1.0))
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    picture = PIL.Image.fromarray(np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    return Picture(uri=_uri(picture, _QUALITY), width=picture.width, height=picture.height, alt=alt)


def _uri(picture: PIL.Image.Image, quality: int) -> str:
    content = io.BytesIO()
    picture.save(content, format="webp", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode()}"
