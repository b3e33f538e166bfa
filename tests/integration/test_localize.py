"""`sgam-sfm localize`: photos between those of a model find their true poses, others say why they have none."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
from matplotlib.text import Text

from sgam_sfm import MatchOptions, cli, match_collection
from sgam_sfm.colmap.reading import read_poses_and_points
from sgam_sfm.evaluation.ground_truth import camera_table
from sgam_sfm.exit_codes import DONE, ERROR, NO_MODEL, SOME_FAILED, USAGE
from sgam_sfm.pictures import collection_picture
from sgam_sfm.room.rendering import View
from sgam_sfm.runs.results import open_results
from tests.arc import ARC, CAMERA, FOCAL, HEIGHT, WIDTH, ArcMatcher, view, write_arc

NEW = {name: view(name, angle) for name, angle in (("new/x.png", 8.0), ("y.png", -17.0))}
# So far to the side that it shows no point: the matcher finds outliers alone.
AWAY = {
    "away.png": replace(view("away.png", 0.0), camera_matrix=np.array([[FOCAL, 0, 9e3], [0, FOCAL, 9e3], [0, 0, 1]]))
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A run whose model has the true poses."""
    folder = write_arc(tmp_path_factory.mktemp("arc"))
    output = folder / "out"
    options = MatchOptions(
        images=folder / "images", cameras=folder / "cameras.txt", output=output, area_matcher="none", mapping=False
    )
    match_collection(options, point_matcher=ArcMatcher(ARC))
    given = ["--mapper", "triangulate", "--input-model", str(folder / "truth")]
    assert cli.run(["reconstruct", str(output), *given]) == DONE
    return output


@pytest.fixture
def photos(tmp_path: Path, monkeypatch) -> Path:
    """A folder of new photos, and a point matcher that knows what they show."""
    monkeypatch.setattr("sgam_sfm.executors.local.create_matcher", lambda options: ArcMatcher(ARC | NEW | AWAY))
    return write_arc(tmp_path / "new", NEW) / "images"


def record(output: Path) -> dict:
    return json.loads((output / "localize.json").read_text())


def errors(pose: np.ndarray, true: View) -> tuple[float, float]:
    """Of the rotation in degrees and of the centre, 6.5 from the middle of the points."""
    R, T = pose[:, :3], true.cam_from_world[:, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(R @ T.T) - 1) / 2, -1, 1)))
    return float(angle), float(np.linalg.norm(-R.T @ pose[:, 3] - true.centre))


def test_new_photos_find_their_poses(finished, photos, tmp_path):
    output, cameras = tmp_path / "poses", tmp_path / "cameras.txt"
    cameras.write_text(f"* {CAMERA}\n")
    given = ["localize", str(finished), "--images", str(photos), "--output", str(output), "--cameras", str(cameras)]
    assert cli.run(given) == DONE
    content = record(output)
    assert (content["localized"], content["references"], content["pairs"]) == (2, 6, 12)
    poses, _ = read_poses_and_points(output / "sparse/0")
    assert poses.keys() == ARC.keys() | NEW.keys()
    assert cli.run(["show", str(output), "y.png", "a.png"]) == DONE  # of two folders
    table = camera_table.FORMAT.read(output / "poses.csv", None).views
    lines = [line.split(" ") for line in (output / "poses.txt").read_text().splitlines()]
    assert [line[0] for line in lines] == list(table) == sorted(NEW)
    for name, *numbers in lines:
        w, x, y, z, *translation = map(float, numbers)
        pose = np.column_stack([pycolmap.Rotation3d(np.array([x, y, z, w])).matrix(), translation])
        np.testing.assert_allclose(pose, poses[name], atol=1e-9)
        np.testing.assert_allclose(table[name].cam_from_world, poses[name], atol=1e-9)
        np.testing.assert_allclose(table[name].camera_matrix, NEW[name].camera_matrix)
        angle, distance = errors(pose, NEW[name])
        assert angle < 0.02
        assert distance < 0.003
        assert content["photos"][name]["points"] > 200
    model, before = pycolmap.Reconstruction(output / "sparse/0"), pycolmap.Reconstruction(finished / "sparse/0")
    image = model.find_image_with_name("y.png")
    assert image.num_points3D == content["photos"]["y.png"]["points"]
    assert model.compute_mean_reprojection_error() < 0.5
    assert (model.num_points3D(), model.num_cameras()) == (before.num_points3D(), before.num_cameras() + 1)

    stored = {path: path.stat().st_mtime_ns for path in (output / "pairs").iterdir()}
    assert cli.run(given) == DONE  # again: nothing is matched anew
    assert stored == {path: path.stat().st_mtime_ns for path in (output / "pairs").iterdir()}
    assert record(output)["photos"] == content["photos"]


def test_listed_pairs_failures_and_an_unknown_focal_length(finished, photos, tmp_path, capsys):
    (photos / "broken.png").write_bytes(b"no image")
    PIL.Image.new("RGB", (WIDTH, HEIGHT)).save(photos / "away.png")
    PIL.Image.new("RGB", (WIDTH, HEIGHT)).save(photos / "alone.png")
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("y.png a.png\nb.png y.png\nnew/x.png d.png\nnew/x.png e.png\naway.png c.png\nbroken.png c.png\n")
    output = tmp_path / "poses"
    given = ["localize", str(finished), "--images", str(photos), "--output", str(output), "--pairs", str(pairs)]
    assert cli.run(given) == SOME_FAILED
    content = record(output)
    assert content["localized"] == 2
    assert content["failed"].keys() == {"broken.png", "away.png", "alone.png"}
    assert "cannot be decoded" in content["failed"]["broken.png"]
    assert content["failed"]["alone.png"] == (
        "'alone.png' is in no pair with an image of the model; name some in --pairs"
    )
    assert content["failed"]["away.png"].endswith("are needed (--min-inliers)")
    assert "2 of 5 photos, with 5 references" in capsys.readouterr().err
    assert cli.run(["status", str(output)]) == DONE
    status = capsys.readouterr().out
    assert "poses      2 of 5 photos, with 5 references\n" in status
    assert f"failed     away.png: {content['failed']['away.png']}\n" in status
    sheet = collection_picture(open_results(output))
    written = " ".join(text.get_text() for text in sheet.findobj(Text))
    assert "keypoints and verified pairs (`localize` makes no database)" in written
    assert f"away.png: {content['failed']['away.png']}" in written
    assert content["photos"]["y.png"]["references"] == 2
    focal = content["photos"]["y.png"]["camera"]["params"][0]  # COLMAP's guess was 1.2 * 640
    assert focal == pytest.approx(FOCAL, rel=0.05)
    poses, _ = read_poses_and_points(output / "sparse/0")
    assert errors(poses["y.png"], NEW["y.png"])[0] < 3  # the principal point is not the true one


def test_no_photo_with_a_pose(finished, photos, tmp_path):
    output = tmp_path / "poses"
    given = ["localize", str(finished), "--images", str(photos), "--output", str(output), "--min-inliers", "400"]
    (tmp_path / "pairs.txt").write_text("y.png a.png\n")
    assert cli.run([*given, "--pairs", str(tmp_path / "pairs.txt")]) == NO_MODEL
    reason = record(output)["failed"]["y.png"]
    assert "matches with 1 reference show " in reason
    assert reason.endswith(" points of the model; 400 are needed (--min-inliers)")
    assert (output / "poses.txt").read_text() == ""


WRONG = {
    "no model": (["--model", "{tmp}/none"], ERROR, "there is no model at {tmp}/none; `sgam-sfm reconstruct OUT` makes"),
    "other model": (
        ["--model", "{tmp}/other"],
        ERROR,
        "image 'zz.png' of the model is not among the images of '{out}'",
    ),
    "same name": (
        ["--images", "{out}/../images"],
        ERROR,
        "has the name of an image of the model; put the photos into a",
    ),
    "two photos": (["--pairs", "{tmp}/photos.txt"], ERROR, "pairs 'new/x.png' with 'y.png', two photos; expected `ph"),
    "unknown name": (["--pairs", "{tmp}/names.txt"], ERROR, "line 1: 'q.png' is not among the 8 images"),
    "inliers": (["--min-inliers", "3"], USAGE, "--min-inliers is 3; expected at least 4, since 3 points fit any pose"),
    "radius": (["--radius-px", "0"], USAGE, "--radius-px is 0.0; expected more than 0 pixels"),
    "area matcher": (["--area-matcher", "nine"], USAGE, "--area-matcher 'nine' is unknown; did you mean 'none'?"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_line(finished, photos, tmp_path, capsys, case):
    arguments, code, expected = WRONG[case]
    other = Path(shutil.copytree(finished.parent / "truth", tmp_path / "other"))
    (other / "images.txt").write_text((other / "images.txt").read_text().replace("a.png", "zz.png"))
    (tmp_path / "photos.txt").write_text("new/x.png y.png\n")
    (tmp_path / "names.txt").write_text("q.png a.png\n")
    names = {"out": finished, "tmp": tmp_path}
    given = ["localize", str(finished), "--images", str(photos), "--output", str(tmp_path / "poses")]
    assert cli.run([*given, *(argument.format(**names) for argument in arguments)]) == code
    (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert expected.format(**names) in error
