"""Figures over seeds, and when a difference is one."""

import pytest

from sgam_sfm.comparison.figures import FIGURES, Spread, over_seeds, times_of, verdict

MORE = next(figure for figure in FIGURES if figure.name == "points")
LESS = next(figure for figure in FIGURES if figure.name == "reprojection_error_px")
PRICE = next(figure for figure in FIGURES if figure.name == "megapixels_matched")


def test_mean_and_spread_over_seeds():
    found = over_seeds([{"a": 1.0, "b": None}, {"a": 4.0, "b": 2.0}])
    assert found == {"a": Spread(mean=2.5, spread=1.5), "b": None}
    assert over_seeds([{"a": 1.0}]) == {"a": Spread(mean=1.0, spread=None)}


@pytest.mark.parametrize(
    ("figure", "one", "other", "expected"),
    [
        (MORE, (12.0, None), (10.0, None), "gain"),
        (LESS, (12.0, None), (10.0, None), "loss"),
        (MORE, (10.0, None), (10.0, None), "tie"),
        (MORE, (12.0, 1.0), (10.0, 1.0), "tie"),
        (MORE, (12.1, 1.0), (10.0, 1.0), "gain"),
        (LESS, (0.4004, None), (0.4001, None), "tie"),  # 0.400 both
        (LESS, (0.4006, None), (0.4004, None), "loss"),  # 0.401 and 0.400
        (PRICE, (12.0, None), (10.0, None), ""),
    ],
)
def test_a_difference_within_the_spread_is_a_tie(figure, one, other, expected):
    assert verdict(figure, Spread(mean=one[0], spread=one[1]), Spread(mean=other[0], spread=other[1])) == expected


def test_lengths_are_in_the_unit_of_the_truth():
    centre = next(figure for figure in FIGURES if figure.name == "center_error")
    assert centre.titled({"unit": "metres"}) == "centre error, metres"
    assert centre.titled({"unit": "unknown"}) == centre.titled(None) == "centre error, units of the truth"
    assert LESS.titled(None) == "reprojection, px"


def test_nothing_is_said_where_a_figure_is_missing():
    assert verdict(MORE, None, Spread(mean=1.0, spread=None)) == ""


def test_looked_up_results_are_charged_to_the_run():
    summary = {
        "seconds": {"Matching pairs": 2.0, "Mapping": 3.0},
        "peak_memory_mb": {"matching": 900.0, "mapping": None},
    }
    times = times_of({"summary": summary, "saved_seconds": 10.0})
    assert times == {"matching_seconds": 12.0, "total_seconds": 15.0, "peak_memory_mb": 900.0}
