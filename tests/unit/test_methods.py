"""Methods by name: what they mean, which folder they get, what is wrong with them."""

from pathlib import Path

import pytest

from sgam_core.errors import OptionError
from sgam_sfm.comparison.methods import budget_reference, parse_method, parse_methods
from sgam_sfm.options import MatchOptions

COMMON = MatchOptions(images=Path("photos"), output=Path("out"))


def test_a_method_names_its_area_matcher_point_matcher_and_options():
    method = parse_method("none:xfeat-star@budget=match,image-size=1600,rejection.rule=paper")
    assert (method.area_matcher, method.matcher, method.same_budget) == ("none", "xfeat-star", True)
    options = method.applied(COMMON, Path("there"), seed=3)
    assert (options.area_matcher, options.matcher, options.output, options.seed) == (
        *("none", "xfeat-star", Path("there")),
        3,
    )
    assert options.crop.image_size == 1600
    assert options.rejection.rule == "paper"
    assert options.images == COMMON.images


@pytest.mark.parametrize(
    ("name", "slug"),
    [
        ("sift", "sift"),
        ("none:xfeat-star@budget=match", "none_xfeat-star_budget-match"),
        ("sgam:xfeat-star@image-size=1600,area-size=800", "sgam_xfeat-star_image-size-1600_area-size-800"),
    ],
)
def test_folders_are_safe_names(name, slug):
    assert parse_method(name).slug == slug


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("xfeat-star", "method 'xfeat-star' cannot be understood; expected area-matcher:point-matcher"),
        ("sgam:", "cannot be understood"),
        ("sgma:xfeat-star", "method 'sgma:xfeat-star': --area-matcher 'sgma' is unknown; did you mean 'sgam'?"),
        ("sgam:xfeat", "method 'sgam:xfeat': --matcher 'xfeat' is unknown; did you mean 'xfeat-star'?"),
        ("none:xfeat-star@fast", "method 'none:xfeat-star@fast': 'fast' is no option; expected option=value"),
        ("none:xfeat-star@budget=12", "budget is '12'; expected match"),
    ],
)
def test_what_is_no_method_is_told(name, expected):
    with pytest.raises(OptionError) as error:
        parse_method(name)
    assert expected in str(error.value)


def test_an_option_that_match_does_not_have():
    method = parse_method("none:xfeat-star@imagesize=3")
    with pytest.raises(OptionError) as error:
        method.applied(COMMON, Path("x"), 0)
    assert str(error.value) == (
        "method 'none:xfeat-star@imagesize=3': option 'imagesize' is unknown; did you mean 'image_size'?"
    )


def test_methods_are_named_once_and_a_budget_needs_its_reference():
    with pytest.raises(OptionError, match=r"'sift' is named twice \(folder 'sift'\)"):
        parse_methods(["sift", "sift"])
    with pytest.raises(OptionError, match=r"no method to compare"):
        parse_methods([])
    with pytest.raises(OptionError) as error:
        parse_methods(["sgam:coarse-loftr", "none:xfeat-star@budget=match"])
    assert str(error.value) == (
        "method 'none:xfeat-star@budget=match' is to match as many pixels as SGAM does; name 'sgam:xfeat-star' too"
    )
    methods = parse_methods(["none:xfeat-star@budget=match", "sgam:xfeat-star"])
    assert budget_reference(methods, methods[0]) is methods[1]
