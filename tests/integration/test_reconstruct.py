"""`sgam-sfm reconstruct` and `sgam-sfm aggregate`: models from matches that exist."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sgam_sfm import MatchOptions, cli, match_collection
from sgam_sfm.colmap.reading import database_content, read_model, read_poses_and_points
from sgam_sfm.evaluation.pose_errors import compare_poses
from sgam_sfm.exit_codes import DONE, ERROR, USAGE
from tests.arc import ARC, FOCAL, POINTS, ArcMatcher, write_arc


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_arc(tmp_path_factory.mktemp("arc"))


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory) -> Path:
    """A run with known cameras, not mapped."""
    output = tmp_path_factory.mktemp("run") / "out"
    match_collection(
        MatchOptions(
            images=folder / "images",
            cameras=folder / "cameras.txt",
            output=output,
            area_matcher="none",
            mapping=False,
            threads=1,
        ),
        point_matcher=ArcMatcher(ARC),
    )
    return output


@pytest.fixture
def output(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be worked on."""
    return Path(shutil.copytree(finished, tmp_path / "out"))


def record(path: Path) -> dict:
    return json.loads(path.read_text())


@pytest.mark.parametrize("mapper", ["incremental", "global", "hierarchical"])
def test_another_mapper_without_matching_again(folder, output, mapper):
    before = {path: path.stat().st_mtime_ns for path in (output / "pairs").iterdir()}
    database = database_content(output / "database.db")
    assert cli.run(["reconstruct", str(output), "--mapper", mapper]) == DONE
    errors = compare_poses(output / "sparse/0", folder / "truth")
    assert errors.num_images == len(ARC)
    assert errors.max_rotation_deg < 1
    (camera,) = read_model(output / "sparse/0").cameras.values()
    assert camera.params[0] == pytest.approx(FOCAL, abs=1e-9)  # known to the run, so held fixed
    assert before == {path: path.stat().st_mtime_ns for path in (output / "pairs").iterdir()}
    assert database_content(output / "database.db") == database
    summary, options = record(output / "summary.json"), record(output / "options.json")
    assert summary["models"][0]["registered"] == len(ARC)
    assert options["mapper"] == mapper
    assert record(output / "reconstruct.json")["options"]["mapper"] == mapper


def test_the_model_goes_to_another_folder_and_the_run_stays(output, tmp_path, capsys):
    model = tmp_path / "model"
    assert cli.run(["reconstruct", str(output), "--output", str(model), "--refine-intrinsics"]) == DONE
    assert not (output / "sparse").exists()
    assert not (output / "reconstruct.json").exists()
    assert {path.name for path in (model / "sparse").iterdir()} == {"0"}
    assert database_content(model / "database.db") == database_content(output / "database.db")
    (camera,) = read_model(model / "sparse/0").cameras.values()
    assert 0 < abs(camera.params[0] / camera.params[1] - 1) < 0.05  # refined
    capsys.readouterr()
    assert cli.run(["status", str(model)]) == DONE
    status = capsys.readouterr().out
    assert "pairs      15 with matches, 15 verified\nmodel 0    6 of 6 images, " in status
    assert "matched and stored" not in status
    assert cli.run(["reconstruct", str(model)]) == DONE  # the folder serves as OUT
    (camera,) = read_model(model / "sparse/0").cameras.values()
    assert camera.params[0] == pytest.approx(FOCAL, abs=1e-9)


def test_any_database_is_copied_and_its_open_pairs_are_verified(output, tmp_path, folder):
    database = tmp_path / "foreign.db"
    shutil.copy(output / "database.db", database)
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("DELETE FROM two_view_geometries WHERE pair_id % 2")
        connection.execute("PRAGMA journal_mode=DELETE")
        connection.commit()
    before = database.read_bytes()
    given = ["reconstruct", "--database", str(database), "--images", str(folder / "images")]
    assert cli.run([*given, "--output", str(tmp_path / "model")]) == DONE
    assert database.read_bytes() == before
    made = database_content(tmp_path / "model/database.db")["two_view_geometries"]
    assert made == database_content(output / "database.db")["two_view_geometries"]


def test_known_poses_are_kept_and_get_points(folder, output):
    given = ["reconstruct", str(output), "--mapper", "triangulate", "--input-model", str(folder / "truth")]
    assert cli.run(given) == DONE
    true, _ = read_poses_and_points(folder / "truth")
    poses, points = read_poses_and_points(output / "sparse/0")
    assert set(poses) == set(true)
    for name, pose in poses.items():
        np.testing.assert_allclose(pose, true[name], atol=1e-9)
    distances, _ = cKDTree(POINTS).query(points)
    assert len(points) == pytest.approx(len(POINTS), abs=5)
    assert np.quantile(distances, 0.9) < 0.01  # of 6.5 to the middle
    assert "triangulate" not in (output / "options.json").read_text()


def test_images_without_a_known_pose_are_left_out(folder, output, tmp_path):
    partly = tmp_path / "partly"
    shutil.copytree(folder / "truth", partly)
    lines = (partly / "images.txt").read_text().splitlines(keepends=True)
    missing = lines[-2].split()[-1]
    # Other ids than those of the database, too.
    moved = [
        f"{100 - number} {line.partition(' ')[2]}" if ".png" in line else line for number, line in enumerate(lines)
    ]
    (partly / "images.txt").write_text("".join(moved[:-2]))
    given = ["reconstruct", str(output), "--mapper", "triangulate", "--input-model", str(partly)]
    assert cli.run(given) == DONE
    poses, points = read_poses_and_points(output / "sparse/0")
    assert set(poses) == set(ARC) - {missing}
    assert len(points) > 250


def test_keypoints_are_merged_again(output, tmp_path):
    before = database_content(output / "database.db")
    again = tmp_path / "again"
    assert cli.run(["aggregate", str(output), "--output", str(again), "--no-mapping"]) == DONE
    assert database_content(again / "database.db") == before
    assert not (again / "sparse").exists()

    assert cli.run(["aggregate", str(output), "--keypoints.cluster-radius-px", "2"]) == DONE
    content, summary = record(output / "aggregate.json"), record(output / "summary.json")
    assert content["options"]["keypoints"]["cluster_radius_px"] == 2
    assert content["keypoints"]["duplicates"] > 0
    coarser = database_content(output / "database.db")
    assert sum(map(len, coarser["keypoints"].values())) < sum(map(len, before["keypoints"].values()))
    assert len(coarser["two_view_geometries"]) == len(coarser["matches"])
    assert record(output / "options.json")["keypoints"]["cluster_radius_px"] == 2
    assert summary["keypoints"] == content["keypoints"]
    assert summary["models"] == content["models"] != []
    assert summary["pairs"]["inliers"] == content["inliers"]


WRONG = {
    "nothing": (["reconstruct"], USAGE, "give either OUT, the --output folder of a match run, or --database FILE"),
    "both": (["reconstruct", "{out}", "--database", "a.db"], USAGE, "give either OUT, the --output folder of a match"),
    "bare database": (["reconstruct", "--database", "a.db"], USAGE, "--database needs --images, the folder of its"),
    "no poses": (["reconstruct", "{out}", "--mapper", "triangulate"], USAGE, "--mapper triangulate needs known poses"),
    "poses unused": (
        ["reconstruct", "{out}", "--input-model", "m"],
        USAGE,
        "--input-model is for --mapper triangulate",
    ),
    "no run": (["reconstruct", "{tmp}/nowhere"], ERROR, "'{tmp}/nowhere' does not exist; give the --output folder"),
    "no model": (
        ["reconstruct", "{out}", "--mapper", "triangulate", "--input-model", "{tmp}"],
        ERROR,
        "{tmp} cannot be read as a COLMAP model",
    ),
    "among images": (["aggregate", "{out}", "--output", "{images}/x"], USAGE, "lies in the image folder"),
    "another run": (["aggregate", "{out}", "--output", "{tmp}/other"], USAGE, "'{tmp}/other' holds another run"),
    "missing database": (
        ["reconstruct", "--database", "{tmp}/no.db", "--images", "{images}", "--output", "{tmp}/o"],
        ERROR,
        "--database '{tmp}/no.db' does not exist; give a COLMAP database",
    ),
    "its own copy": (
        ["reconstruct", "--database", "{tmp}/database.db", "--images", "{images}", "--output", "{tmp}"],
        USAGE,
        "--database '{tmp}/database.db' would be overwritten by its copy",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_line(folder, finished, tmp_path, capsys, case):
    arguments, code, expected = WRONG[case]
    (tmp_path / "other").mkdir()
    (tmp_path / "other/options.json").write_text('{"fingerprint": "another"}')
    names = {"out": finished, "tmp": tmp_path, "images": folder / "images"}
    assert cli.run([argument.format(**names) for argument in arguments]) == code
    (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert expected.format(**names) in error


def test_an_unfinished_run_has_no_database(output, capsys):
    (output / "database.db").unlink()
    assert cli.run(["reconstruct", str(output)]) == ERROR
    assert f"'{output}' has no database.db yet; start the same match again" in capsys.readouterr().err


def test_what_is_not_matched_yet_is_not_merged(output, capsys):
    max(output.glob("pairs/*.h5")).unlink()
    assert cli.run(["aggregate", str(output)]) == ERROR
    error = " ".join(capsys.readouterr().err.split())
    assert f"15 of 15 pairs have no result in '{output}/pairs'; start the same match again, it continues" in error


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("640 480", "1280 960"), "is 1280x960 in {model} but 640x480 (width x height) in the database"),
        ((".png", ".jpg"), "none of the 6 images with a pose in {model}, such as 'a.jpg'"),
        (("PINHOLE 640 480 5", "PINHOLE 640 480 6"), "share a camera in the database but have two in {model}"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(folder, output, tmp_path, capsys, change, expected):
    model = Path(shutil.copytree(folder / "truth", tmp_path / "model"))
    once = 1 if change[0].startswith("PINHOLE") else -1
    for name in ("cameras.txt", "images.txt"):
        (model / name).write_text((model / name).read_text().replace(*change, once))
    given = ["reconstruct", str(output), "--mapper", "triangulate", "--input-model", str(model)]
    assert cli.run(given) == ERROR
    assert expected.format(model=model) in capsys.readouterr().err
