"""The command `sgam-sfm show` on the output of real runs over the rendered room."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from sgam_sfm import cli
from sgam_sfm.colmap.reading import (
    read_counts,
    read_database,
    read_keypoints,
    read_model_image,
    read_model_names,
    read_pair_inliers,
)
from sgam_sfm.commands import show
from sgam_sfm.exit_codes import DONE, ERROR, USAGE
from sgam_sfm.pictures import image_picture, pair_picture
from sgam_sfm.runs.results import find_plain, open_results
from tests.room import Room, write_room


@pytest.fixture(scope="module")
def runs(room: Room, tmp_path_factory) -> Path:
    """A folder with the outputs of the areas (`sgam`) and of the plain matcher (`none`) on four images."""
    folder = write_room(room, tmp_path_factory.mktemp("show"))
    for name in list(room.images)[4:]:
        (folder / "images" / name).unlink()
    lines = (folder / "pairs.txt").read_text().splitlines()
    kept = [line for line in lines if set(line.split()) <= set(list(room.images)[:4])]
    (folder / "pairs.txt").write_text("\n".join(kept))
    for area_matcher in ("sgam", "none"):
        arguments = [
            *("match", "--images", str(folder / "images"), "--pairs", str(folder / "pairs.txt")),
            *("--cameras", str(folder / "cameras.txt"), "--labels", str(folder / "labels")),
            *(
                "--max-crop-pixels",
                "1000000",
                "--guidance.no-enabled",
                "--area-matcher",
                area_matcher,
                "--output",
                str(folder / area_matcher),
            ),
        ]
        assert cli.run(arguments) == DONE
    return folder


@pytest.fixture(scope="module")
def names(runs) -> tuple[str, ...]:
    return tuple(sorted(path.name for path in (runs / "images").iterdir()))


def run(runs: Path, *arguments: str) -> int:
    return cli.run(["show", str(runs / "sgam"), *arguments])


def said(error: str) -> str:
    return " ".join(error.split())


def test_every_picture_is_written_where_it_is_printed(runs, names, capsys):
    expected = {
        (): "collection.png",
        names[:1]: f"{names[0]}.png",
        names[1::-1]: f"{names[1]}--{names[0]}.png",
    }
    for chosen, file in expected.items():
        assert run(runs, *chosen) == DONE
        path = runs / "sgam" / "pictures" / file
        assert f"picture {path}" in said(capsys.readouterr().err)
        picture = cv2.imread(str(path))
        assert picture.shape[1] == 1600
        assert picture.std() > 30  # photos, not a blank page


def test_save_chooses_the_file_and_makes_its_folder(runs, names, tmp_path):
    path = tmp_path / "new" / "picture.jpg"
    assert run(runs, *names[:2], "--save", str(path)) == DONE
    assert cv2.imread(str(path)).shape[1] == 1600


def test_a_pair_shows_what_the_store_and_the_database_hold(runs, names):
    results, pair = open_results(runs / "sgam"), (names[1], names[0])
    plain = find_plain(results, pair)
    assert plain.folder == runs / "none"
    figure = pair_picture(results, pair, plain)
    words = " ".join(text.get_text() for text in figure.texts)
    result = results.result(pair)
    inliers = read_counts(runs / "sgam" / "database.db").inliers[names[0], names[1]]
    assert f"{names[1]} - {names[0]}" in words
    assert f"{len(result.areas)} area matches, {len(result.matches)} point matches" in words
    assert f"{inliers} inliers after COLMAP's verification" in words
    assert "The plain matcher on whole images (none)" in words
    assert f"{len(plain.result(pair).matches)} point matches" in words
    assert "Not in this picture" not in words


def test_the_plain_matcher_can_be_named(runs, names, capsys):
    assert run(runs, *names[:2], "--plain", str(runs / "none")) == DONE
    assert run(runs, *names[:2], "--plain", str(runs / "sgam")) == ERROR
    assert "--plain expects the output of --area-matcher none" in said(capsys.readouterr().err)
    assert run(runs, names[0], "--plain", str(runs / "none")) == USAGE
    assert "--plain is drawn beneath a pair; give the names of two images" in said(capsys.readouterr().err)


def test_inliers_of_a_pair_are_those_of_the_database(runs, names):
    database = runs / "sgam" / "database.db"
    content = read_database(database)
    pair = (names[0], names[1])
    indices = content["two_view_geometries"][pair]["inlier_matches"]
    points0, points1 = read_pair_inliers(database, pair)
    np.testing.assert_array_equal(points0, content["keypoints"][names[0]][indices[:, 0]])
    np.testing.assert_array_equal(points1, content["keypoints"][names[1]][indices[:, 1]])
    back = read_pair_inliers(database, pair[::-1])
    np.testing.assert_array_equal(back[0], points1)
    assert read_pair_inliers(database, (names[0], "other.jpg")) is None
    assert read_counts(database).inliers == {
        pair: len(geometry["inlier_matches"]) for pair, geometry in content["two_view_geometries"].items()
    }
    assert read_counts(database).keypoints == {name: len(points) for name, points in content["keypoints"].items()}


def test_tracks_are_those_of_the_model(runs, names):
    model = runs / "sgam" / "sparse" / "0"
    assert read_model_names(model) == names
    found = read_model_image(model, names[0])
    with h5py.File(runs / "sgam" / "keypoints.h5") as file:
        np.testing.assert_allclose(found.points, file[names[0]]["keypoints"][()] + 0.5, atol=1e-3)
    np.testing.assert_array_equal(found.points, read_keypoints(runs / "sgam" / "database.db", names[0]))
    assert set(np.unique(found.track_lengths)) <= {0, 2, 3, 4}
    assert np.count_nonzero(found.track_lengths) > 100
    words = " ".join(text.get_text() for text in image_picture(open_results(runs / "sgam"), names[0]).texts)
    assert (
        f"{len(found.points)} keypoints, {np.count_nonzero(found.track_lengths)} of them with a point in model 0"
        in words
    )


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (("view3.jpg",), ERROR, "'view3.jpg' is not among the 4 images of '{out}'; the nearest name is 'view03.jpg'"),
        (("a", "b", "c"), USAGE, "3 image names were given; give two for a pair, one for an image, or none"),
        (("--save", "picture.xyz"), ERROR, "cannot write picture 'picture.xyz': its name ends in none of .png"),
        (("--images", "moved"), ERROR, "the image folder 'moved' does not exist; check --images"),
    ],
)
def test_errors_are_one_line(runs, capsys, arguments, code, expected):
    assert run(runs, *arguments) == code
    error = capsys.readouterr().err
    assert said(error).startswith("error: " + expected.format(out=runs / "sgam"))
    assert error.count("\n") == 1


def test_no_folder_of_results(runs, capsys):
    assert cli.run(["show", str(runs / "images")]) == ERROR
    assert "is no result folder (no options.json of a run in it)" in said(capsys.readouterr().err)


def test_the_module_loads_nothing_heavy():
    heavy = {"h5py", "matplotlib", "pycolmap", "torch"}
    assert not heavy & vars(show).keys()
