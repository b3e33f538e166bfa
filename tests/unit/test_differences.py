"""What runs differ in, as users are told."""

import pytest

from sgam_sfm.runs.differences import difference, goes_on

INPUTS = {"images": {"a.jpg": "1", "b.jpg": "2"}, "pairs": [["a.jpg", "b.jpg"]]}


def run(options=None, **inputs):
    return options or {"matcher": "sift"}, INPUTS | inputs


@pytest.mark.parametrize(
    ("here", "told"),
    [
        (run({"matcher": "loftr"}), "--matcher (sift there, loftr here)"),
        (run({"matcher": "sift", "threads": 2}), "cameras"),  # results do not follow from the number of threads
        (run({"matcher": "sift", "crop": {"area_size": 3}}), "--area-size (None there, 3 here)"),
        (run({"matcher": "sift", "labels_sha256": "3"}), "content of --labels"),
        (run(images={"a.jpg": "3", "b.jpg": "2"}), "images (1 with another content, 'a.jpg' for one)"),
        (
            run(images={"a.jpg": "1", "c.jpg": "2", "d.jpg": "4"}),
            "images (1 only there, 'b.jpg' for one; 2 only here, 'c.jpg' for one)",
        ),
        (
            run({"matcher": "loftr"}, pairs=[]),
            "--matcher (sift there, loftr here), pairs (1 only there, 'a.jpg b.jpg' for one)",
        ),
        (run(pairs=[]), "pairs (1 only there, 'a.jpg b.jpg' for one)"),
        (run(), "cameras"),
        (
            ({"matcher": "sift"}, {}),
            "images (2 only there, 'a.jpg' for one), pairs (1 only there, 'a.jpg b.jpg' for one)",
        ),
    ],
)
def test_what_differs_is_named(here, told):
    assert difference(run(), here) == told


MORE = {"images": INPUTS["images"] | {"c.jpg": "3"}, "pairs": [*INPUTS["pairs"], ["b.jpg", "c.jpg"]]}


@pytest.mark.parametrize(
    ("here", "expected"),
    [
        (run(**MORE), True),
        (run(pairs=[*INPUTS["pairs"], ["b.jpg", "a.jpg"]]), True),
        (run({"matcher": "sift", "mask_path_sha256": "3"}, **MORE), True),
        (run(), False),  # cameras
        (run({"matcher": "loftr"}, **MORE), False),
        (run(**(MORE | {"pairs": [["b.jpg", "c.jpg"]]})), False),
        (run(**(MORE | {"images": {"a.jpg": "3", "b.jpg": "2", "c.jpg": "3"}})), False),
    ],
)
def test_a_run_of_the_same_and_more_is_told_from_another_one(here, expected):
    assert goes_on(run(), here) is expected
