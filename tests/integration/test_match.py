"""The command `sgam-sfm match`, whole: real models on the rendered room, resume after SIGKILL, bad input."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import PIL.Image
import pytest

from sgam_sfm import cli
from sgam_sfm.colmap.reading import database_content
from sgam_sfm.evaluation.pose_errors import compare_poses
from sgam_sfm.exit_codes import DONE, ERROR, SOME_FAILED, USAGE
from sgam_sfm.runs.matching import CollectionMatcher
from sgam_sfm.runs.store import read_pairs_of
from sgam_sfm.scene import write_ground_truth
from tests.room import Room, write_room


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    return write_room(room, tmp_path_factory.mktemp("room"))


def arguments(folder: Path, output: Path, *more: str) -> list[str]:
    return [
        *("match", "--images", str(folder / "images"), "--pairs", str(folder / "pairs.txt")),
        *("--cameras", str(folder / "cameras.txt"), "--labels", str(folder / "labels")),
        *("--output", str(output), "--block-images", "2", "--max-crop-pixels", "600000"),
        *("--image-size", "400", *more),
    ]


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory) -> Path:
    """The output of an undisturbed run."""
    output = tmp_path_factory.mktemp("run") / "out"
    assert cli.run(arguments(folder, output)) == DONE
    return output


def summary_of(output: Path) -> dict:
    return json.loads((output / "summary.json").read_text())


def test_the_model_agrees_with_the_truth(room, finished, tmp_path):
    summary = summary_of(finished)
    assert summary["models"][0]["registered"] == len(room.images)
    assert summary["models"][0]["points"] > 300
    write_ground_truth(tmp_path, list(room.views.values()))
    errors = compare_poses(finished / "sparse" / "0", tmp_path)
    assert errors.num_images == len(room.images)
    assert errors.median_rotation_deg < 1.0  # centres along an arc leave a turn about it open
    assert errors.median_center < 0.03  # metres, in a room of six


def test_the_summary_counts_what_happened(finished):
    summary = summary_of(finished)
    pairs = summary["pairs"]
    assert pairs["listed"] == pairs["matched"] == 15
    assert pairs["areas"]["guided_kept"] >= 6
    assert summary["keypoints"]["raw_matches"] == pairs["raw_matches"]
    dropped = sum(summary["keypoints"][name] for name in ("duplicates", "conflicts", "inconsistent"))
    assert summary["keypoints"]["matches"] == pairs["raw_matches"] - dropped
    assert {"Reading images", "Segmenting images", "Matching pairs", "Mapping"} <= set(summary["seconds"])
    assert summary["peak_memory_mb"]["matching"] > 100


def test_outputs_are_where_colmap_users_look_for_them(finished):
    for name in ("database.db", "keypoints.h5", "matches.h5", "options.json", "summary.json", "log.txt"):
        assert (finished / name).stat().st_size > 0
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (finished / "sparse" / "0" / name).exists()
    content = database_content(finished / "database.db")
    with h5py.File(finished / "keypoints.h5") as file:
        for name, points in content["keypoints"].items():
            np.testing.assert_allclose(file[name]["keypoints"][()] + 0.5, np.array(points), atol=1e-3)


def test_started_again_it_does_nothing_anew(folder, finished):
    before = {path: path.stat().st_mtime_ns for path in (finished / "pairs").iterdir()}
    content = database_content(finished / "database.db")
    assert cli.run(arguments(folder, finished)) == DONE
    assert before == {path: path.stat().st_mtime_ns for path in (finished / "pairs").iterdir()}
    assert database_content(finished / "database.db") == content


@pytest.mark.parametrize("moment", ["labels/labels.json", "pairs/00001.h5", "database.db"])
def test_a_killed_run_continues_to_the_same_database(folder, finished, tmp_path, moment):
    output = tmp_path / "out"
    command = [sys.executable, "-m", "sgam_sfm", *arguments(folder, output)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    while not (output / moment).exists():
        assert process.poll() is None, "the run ended before it could be killed"
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (output / "summary.json").exists()
    assert cli.run(arguments(folder, output)) == DONE
    assert database_content(output / "database.db") == database_content(finished / "database.db")


def test_other_options_need_another_folder(folder, finished, capsys):
    assert cli.run(arguments(folder, finished, "--area-size", "320")) == USAGE
    error = " ".join(capsys.readouterr().err.split())
    assert "was begun with other --area-size (800 there, 320 here)" in error
    assert error.endswith("choose a new --output folder")


def test_photos_that_came_later_are_matched_into_the_database(folder, tmp_path, capsys):
    shutil.copytree(folder, more := tmp_path / "more")
    pairs, database = more / "pairs.txt", tmp_path / "out" / "database.db"
    (later := more / "images" / "view06.jpg").rename(hidden := tmp_path / "view06.jpg")
    pairs.write_text("view03.jpg view04.jpg\nview04.jpg view05.jpg\n")
    assert cli.run(arguments(more, tmp_path / "out")) == DONE
    before = database_content(database)

    hidden.rename(later)
    pairs.write_text(pairs.read_text() + "view05.jpg view06.jpg\n")
    assert cli.run(arguments(more, tmp_path / "out")) == USAGE
    error = " ".join(capsys.readouterr().err.split())
    assert "was begun with other images (1 only here, 'view06.jpg' for one), pairs (1 only here," in error
    assert error.endswith(f"new --output folder, and list the later pairs alone, with --database {database}")

    pairs.write_text("view05.jpg view06.jpg\n")
    assert cli.run(arguments(more, tmp_path / "out2", "--database", str(database))) == DONE
    after = database_content(database)
    assert len(after["two_view_geometries"]) == len(before["two_view_geometries"]) + 1 == 3


def test_options_of_a_run_are_a_config_and_flags_win_over_them(folder, finished, tmp_path):
    config = ["--config", str(finished / "options.json"), "--output", str(tmp_path / "out"), "--no-mapping"]
    assert cli.run(["match", *config, "--area-matcher", "none"]) == DONE
    options = json.loads((tmp_path / "out" / "options.json").read_text())
    assert options["area_matcher"] == "none"
    assert options["block_images"] == 2
    assert summary_of(tmp_path / "out")["pairs"]["fallbacks"] == {"no area match": 15}
    assert not (tmp_path / "out" / "sparse").exists()
    assert database_content(tmp_path / "out" / "database.db")["two_view_geometries"]


def test_bad_images_and_labels_are_counted_and_lose_nothing_else(room, folder, tmp_path):
    spoilt = tmp_path / "room"
    shutil.copytree(folder, spoilt)
    names = list(room.images)
    (spoilt / "images" / names[0]).write_bytes(b"not an image")
    (spoilt / "labels" / f"{names[1]}.png").unlink()
    PIL.Image.new("L", (10, 10)).save(spoilt / "labels" / f"{names[2]}.png")
    (spoilt / "images" / "notes.txt").write_text("a file that is no image")
    output = tmp_path / "out"
    assert cli.run(arguments(spoilt, output, "--no-mapping")) == SOME_FAILED
    summary = summary_of(output)
    assert list(summary["images"]["failed"]) == [names[0]]
    assert summary["images"]["other_files"] == 1
    assert summary["pairs"]["of_unusable_images"] == 5
    assert summary["pairs"]["matched"] == 10
    assert summary["pairs"]["fallbacks"]["no usable label map"] == 7
    assert sorted(summary["labels"]["failed"]) == names[1:3]
    assert "10x10" in summary["labels"]["failed"][names[2]]


def test_failed_pairs_are_matched_once_more(room, folder, tmp_path, monkeypatch, capsys):
    output, wrong = tmp_path / "out", tuple(sorted(room.images)[:2])
    given = arguments(folder, output, "--area-matcher", "none", "--no-mapping")
    match = CollectionMatcher._match

    def failing(self, pair):
        if pair == wrong:
            raise ValueError("a cable was loose")
        return match(self, pair)

    with monkeypatch.context() as broken:
        broken.setattr(CollectionMatcher, "_match", failing)
        assert cli.run(given) == SOME_FAILED
    assert cli.run(given) == SOME_FAILED
    capsys.readouterr()
    assert cli.run(["status", str(output)]) == DONE
    told = capsys.readouterr().out
    assert "14 of 15 matched and stored, 1 failed" in told
    again = f"sgam-sfm match --config '{output / 'options.json'}' --retry-failed"
    assert f"next       {again}\n" in told
    assert cli.run(shlex.split(again)[1:]) == DONE
    assert cli.run(arguments(folder, tmp_path / "well", "--area-matcher", "none", "--no-mapping")) == DONE
    assert database_content(output / "database.db") == database_content(tmp_path / "well" / "database.db")
    capsys.readouterr()
    assert cli.run([*given, "--retry-failed"]) == DONE
    assert "nothing has changed since" in " ".join(capsys.readouterr().err.split())


def test_masked_ground_has_no_match(room, folder, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for name, image in room.images.items():
        mask = np.full((image.height, image.width), 255, np.uint8)
        mask[:, : image.width // 2] = 0
        PIL.Image.fromarray(mask).save(masks / f"{name}.png")
    output = tmp_path / "out"
    assert cli.run(arguments(folder, output, "--no-mapping", "--mask-path", str(masks))) == DONE
    for result in (record.result for record in read_pairs_of(output)):
        both = np.concatenate([result.matches.points0, result.matches.points1])
        assert not len(both) or both[:, 0].min() > 640 // 2 - 0.5
    points = np.concatenate([np.array(p) for p in database_content(output / "database.db")["keypoints"].values() if p])
    assert len(points) > 200
    assert points[:, 0].min() >= 640 // 2
    before = database_content(output / "database.db")
    assert cli.run(["aggregate", str(output), "--no-mapping"]) == DONE
    assert database_content(output / "database.db")["keypoints"] == before["keypoints"]


def test_masks_that_are_missing_named_otherwise_or_of_another_size_are_told_at_once(room, folder, tmp_path, capsys):
    masks, output = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    _, a, b, c, *_ = sorted(Path(name).stem for name in room.images)
    PIL.Image.new("L", (640, 480), 255).save(masks / f"{a}.png")
    given = arguments(folder, output, "--area-matcher", "none", "--no-mapping", "--mask-path", str(masks))
    assert cli.run(given) == ERROR
    error = capsys.readouterr().err
    assert f"--mask-path '{masks}' holds no mask of 6 images; COLMAP's name for the mask of '{a}.jpg' is" in error
    assert f"'{a}.jpg.png'; '{a}.png' is there, and must be renamed" in error
    shutil.copy(masks / f"{a}.png", masks / f"{b}.jpg.png")
    PIL.Image.new("L", (48, 64), 255).save(masks / f"{c}.jpg.png")
    assert cli.run(given) == SOME_FAILED
    assert "for 4 of 5 images; COLMAP's name for the mask of" in " ".join(capsys.readouterr().err.split())
    summary = summary_of(output)
    assert summary["images"]["failed"].keys() == {f"{c}.jpg"}
    assert f"mask of '{c}.jpg' is 64x48 but the image is 480x640" in summary["images"]["failed"][f"{c}.jpg"]
    assert not summary["pairs"]["failed"]


def test_images_that_get_no_pose_are_named(room, folder, tmp_path, capsys):
    pairs, masks, output = tmp_path / "pairs.txt", tmp_path / "masks", tmp_path / "out"
    a, b, c, d, e, f = sorted(room.images)
    pairs.write_text(f"{a} {b}\n{b} {c}\n{a} {c}\n{c} {f}\n")
    masks.mkdir()
    PIL.Image.new("L", (640, 480)).save(masks / f"{f}.png")  # nothing is matched there
    changes = ["--area-matcher", "none", "--mask-path", str(masks), "--pairs", str(pairs)]
    assert cli.run(arguments(folder, output, *changes)) == DONE
    told = " ".join(capsys.readouterr().err.split())
    assert f"in no pair, so without a pose: 2 of 6 images, '{d}', '{e}'" in told
    assert f"no pose '{d}', '{e}', '{f}'" in told
    assert summary_of(output)["without_pose"] == [d, e, f]
    assert cli.run(["status", str(output)]) == DONE
    assert f"no pose    '{d}', '{e}', '{f}'\n" in capsys.readouterr().out


ONE_LINE_ERRORS = {
    "no folder": (["--images", "{tmp}/nowhere"], "image folder '{tmp}/nowhere' does not exist; give the folder that"),
    "empty folder": (
        ["--images", "{tmp}/empty"],
        "image folder '{tmp}/empty' holds no image (0 other files); expected jpg",
    ),
    "output among the images": (["--images", "{tmp}"], "--output '{tmp}/out' lies in the image folder"),
    "no pair list": (["--pairs", "{tmp}/no.txt"], "cannot read the pair list {tmp}/no.txt"),
    "matcher": (["--matcher", "xfeat-sta"], "--matcher 'xfeat-sta' is unknown; did you mean 'xfeat-star'?"),
    "segmenter": (["--segmenter", "cosec"], "--segmenter 'cosec' is unknown; did you mean 'coseg'?"),
    "area matcher": (["--area-matcher", "sgma"], "--area-matcher 'sgma' is unknown; did you mean 'sgam'?"),
    "device": (["--device", "cuda:7"], "--device 'cuda:7' cannot be used"),
    "camera": (["--camera-params", "1,2"], "camera model SIMPLE_RADIAL has 4 parameters"),
    "masks": (["--mask-path", "{tmp}/masks"], "--mask-path '{tmp}/masks' does not exist"),
    "labels": (["--labels", "{tmp}/labels"], "--labels '{tmp}/labels' does not exist"),
    "block images": (["--block-images", "0"], "--block-images is 0; expected at least 1"),
    "image size": (["--max-image-size", "-5"], "--max-image-size is -5; expected at least 1"),
    "threads": (["--threads", "-1"], "--threads is -1; expected a number of cores, or 0 for all"),
    "area size": (["--area-size=0"], "--area-size is 0; expected at least 1 pixel"),
    "keypoints": (
        ["--keypoints.cluster-radius-px", "-1"],
        "--keypoints.cluster-radius-px is -1.0; expected a positive",
    ),
    "config": (["--config", "{tmp}/c.toml"], "--config '{tmp}/c.toml' does not exist"),
    "a label's name": (
        ["--mask-matches", "sky"],
        "--mask-matches 'sky': labels of 'coseg' have no names; give ids, or",
    ),
}


@pytest.mark.parametrize("case", ONE_LINE_ERRORS)
def test_wrong_input_is_one_line(folder, tmp_path, capsys, case):
    changes, expected = ONE_LINE_ERRORS[case]
    given = ["match", "--images", str(folder / "images"), "--output", str(tmp_path / "out")]
    given += [change.format(tmp=tmp_path) for change in changes]
    (tmp_path / "empty").mkdir()
    assert cli.run(given) in (ERROR, USAGE)
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert expected.format(tmp=tmp_path) in errors[0]
    assert not (tmp_path / "out" / "cameras.db").exists()  # told before images are read


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("view02.jpg view99.jpg", "line 1: 'view99.jpg' is not among the 6 images; the closest name is 'view"),
        ("view02.jpg", "line 1: expected two image names but found 1"),
        ("view02.jpg view02.jpg", "names no pair of two different images"),
    ],
)
def test_pair_lists_are_checked(folder, tmp_path, capsys, line, expected):
    pairs = tmp_path / "pairs.txt"
    pairs.write_text(line)
    given = ["match", "--images", str(folder / "images"), "--output", str(tmp_path / "out"), "--pairs", str(pairs)]
    assert cli.run(given) == ERROR
    assert expected in capsys.readouterr().err


def test_an_unknown_command_is_told_with_the_nearest(capsys):
    assert cli.run(["mach", "--images", "photos"]) == USAGE
    assert "command 'mach' is unknown; did you mean 'match'? known: match, reconstruct," in capsys.readouterr().err


def test_a_refused_output_among_the_images_leaves_nothing_there(folder, capsys):
    inside = folder / "images" / "out"
    assert cli.run(["match", "--images", str(folder / "images"), "--output", str(inside)]) == USAGE
    assert not inside.exists()
    capsys.readouterr()


def test_a_missing_flag_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.run(["match", "--images", "photos"])
    assert ended.value.code == USAGE
    printed = capsys.readouterr()
    assert "--output" in printed.out + printed.err
