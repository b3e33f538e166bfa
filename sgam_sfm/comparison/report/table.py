"""The table of figures, and what each method gains, loses and costs, as text with verdicts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from sgam_core.wording import counted
from sgam_sfm.comparison.figures import FIGURES, TIMES, Figure

MARKS = {"gain": "▲", "loss": "▼", "tie": "="}
"""Beside the colour of a verdict."""

_GROUPS = (
    ("Poses against the truth", ("auc_0.5", "auc_1", "auc_3", "auc_5", "center_error", "rotation_error_deg")),
    ("Model", ("registered", "points", "observations", "images_per_track", "reprojection_error_px")),
    ("Pairs", ("pairs_by_areas", "verified_pairs", "inliers", "inlier_ratio")),
    ("Price", ("megapixels_matched", "megapixels_extracted", "matching_seconds", "total_seconds", "peak_memory_mb")),
)
_PRICES = (
    ("pixels", "megapixels_matched", "Mpx"),
    ("matching", "matching_seconds", "s"),
    ("memory", "peak_memory_mb", "MB"),
)


class Cell(NamedTuple):
    """A figure of a method. change: from the reference; verdict: gain, loss, tie or empty."""

    text: str
    change: str = ""
    verdict: str = ""
    mark: str = ""


class Row(NamedTuple):
    """A figure of all methods. hint: which way it improves."""

    title: str
    hint: str
    cells: tuple[Cell, ...]


class Group(NamedTuple):
    """Rows that belong together."""

    title: str
    rows: tuple[Row, ...]


class Card(NamedTuple):
    """A method at a glance. counts: verdict, mark and how many figures have it. prices: title and text."""

    name: str
    is_reference: bool
    counts: tuple[tuple[str, str, int], ...]
    prices: tuple[tuple[str, str], ...]


def table_groups(content: Mapping[str, Any]) -> list[Group]:
    """The table: figures down, methods across; figures that no method has are left out."""
    figures = {figure.name: figure for figure in (*FIGURES, *TIMES)}
    groups = []
    for title, names in _GROUPS:
        rows = [_row(figures[name], content) for name in names if name in figures]
        rows = [row for row in rows if any(cell.text for cell in row.cells)]
        if rows:
            groups.append(Group(title, tuple(rows)))
    return groups


def cards(content: Mapping[str, Any]) -> list[Card]:
    """Every method at a glance."""
    reference = _reference(content)
    found = []
    for method in content["methods"]:
        verdicts = Counter(method["verdicts"].values())
        own = method is reference
        prices = ((title, _mean(method, name), _mean(reference, name), unit) for title, name, unit in _PRICES)
        found.append(
            Card(
                name=method["name"],
                is_reference=own,
                counts=tuple((verdict, mark, verdicts[verdict]) for verdict, mark in MARKS.items()),
                prices=tuple(
                    (title, f"{_number(value, 0)} {unit}" if own else _times(value, base))
                    for title, value, base, unit in prices
                    if value is not None and (own or base)
                ),
            )
        )
    return found


def remarks(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What a reader must know of a method beside its figures: (method, remark)."""
    found = []
    for method in content["methods"]:
        run = method["runs"][0]
        if run["no_model"]:
            found.append((method["name"], f"no model: {run['no_model']}"))
        if method["cap"]:
            found.append((method["name"], f"its budget could not be met: {method['cap']}"))
        # Whole images are all that `none` matches.
        fallbacks = {} if method["name"].startswith("none:") else run["fallbacks"]
        for reason, count in fallbacks.items():
            found.append((method["name"], f"{counted(count, 'pair')} matched as whole images: {reason}"))
    return found


def _row(figure: Figure, content: Mapping[str, Any]) -> Row:
    hint = {"more": "more is better", "less": "less is better", "": ""}[figure.better]
    reference = _reference(content)
    cells = tuple(_cell(figure, method, reference) for method in content["methods"])
    return Row(figure.titled(content["collection"]["ground_truth"]), hint, cells)


def _cell(figure: Figure, method: Mapping[str, Any], reference: Mapping[str, Any]) -> Cell:
    value = (method["figures"] | method["times"]).get(figure.name)
    if value is None:
        return Cell("")
    text = _number(value["mean"], figure.digits)
    if value["spread"] is not None:
        text += f" ± {_number(value['spread'], figure.digits)}"
    base = _mean(reference, figure.name)
    if method is reference or base is None:
        return Cell(text)
    verdict = method["verdicts"].get(figure.name, "")
    if not verdict:
        return Cell(text, _times(value["mean"], base) if base else "")
    return Cell(text, _signed(figure.shown(value["mean"]) - figure.shown(base), figure.digits), verdict, MARKS[verdict])


def _reference(content: Mapping[str, Any]) -> Mapping[str, Any]:
    methods: Sequence[Mapping[str, Any]] = content["methods"]
    return next(method for method in methods if method["slug"] == content["reference"])


def _mean(method: Mapping[str, Any], name: str) -> float | None:
    value = (method["figures"] | method["times"]).get(name)
    return None if value is None else float(value["mean"])


def _number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}"


def _signed(value: float, digits: int) -> str:
    """A difference; one that rounds to nothing has no sign."""
    text = _number(abs(value), digits)
    return text if not any(char in "123456789" for char in text) else f"{'+' if value > 0 else '-'}{text}"


def _times(value: float | None, base: float | None) -> str:
    return "" if value is None or not base else f"{value / base:.2f}x"
