"""`sgam-sfm compare` and `evaluate` on the rendered room, against its exact truth."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import PIL.Image
import pytest

from sgam_core.errors import InputError
from sgam_core.options import CropOptions
from sgam_sfm import cli
from sgam_sfm.evaluation.evaluate import with_dataset
from sgam_sfm.evaluation.options import EvaluateOptions
from sgam_sfm.exit_codes import DONE, ERROR, USAGE
from sgam_sfm.images import read_image
from sgam_sfm.scene import write_ground_truth
from tests.room import Room, write_room

METHODS = ("sgam:xfeat-star", "none:xfeat-star", "covisible:xfeat-star@budget=match", "sift")


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    """Four neighbours of the room, and their true poses."""
    folder = write_room(room, tmp_path_factory.mktemp("room"))
    for name in list(room.images)[4:]:
        (folder / "images" / name).unlink()
    (folder / "pairs.txt").unlink()
    (folder / "truth").mkdir()
    write_ground_truth(folder / "truth", list(room.views.values())[:4])
    return folder


def common(folder: Path, output: Path) -> list[str]:
    return [
        *("--images", str(folder / "images"), "--labels", str(folder / "labels"), "--output", str(output)),
        *("--cameras", str(folder / "cameras.txt"), "--ground-truth", str(folder / "truth")),
        *("--area-size", "320", "--image-size", "480", "--max-crop-pixels", "400000"),
    ]


@pytest.fixture(scope="module")
def compared(folder: Path, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("compare") / "out"
    assert cli.run(["compare", *common(folder, output), "--methods", *METHODS]) == DONE
    return output


def content_of(output: Path) -> dict:
    return json.loads((output / "compare.json").read_text())


def without_times(content: dict) -> dict:
    """What two runs with one seed have in common."""
    for method in content["methods"]:
        del method["times"]
        for run in method["runs"]:
            del run["times"], run["folder"]
    return content


def test_every_method_has_its_figures_and_its_price(compared):
    content = content_of(compared)
    assert content["reference"] == "none_xfeat-star"
    assert [method["name"] for method in content["methods"]] == list(METHODS)
    for method in content["methods"]:
        figures = {name: value and value["mean"] for name, value in method["figures"].items()}
        assert figures["registered"] == 4
        assert figures["auc_3"] > 50
        assert figures["points"] > 100
        assert figures["center_error"] < 0.05
        assert method["times"]["matching_seconds"]["mean"] > 0
        assert (compared / method["slug"] / "database.db").exists()
    assert "sgam:xfeat-star" in (compared / "report.html").read_text(encoding="utf-8")
    sgam, plain, covisible, _ = content["methods"]
    assert sgam["figures"]["megapixels_matched"]["mean"] > plain["figures"]["megapixels_matched"]["mean"]
    assert sgam["verdicts"]["points"] == "gain"
    assert set(plain["verdicts"].values()) <= {"tie", ""}
    fallbacks = sum(sgam["runs"][0]["fallbacks"].values())
    assert sgam["figures"]["pairs_by_areas"]["mean"] == pytest.approx(100 * (1 - fallbacks / 6))
    assert plain["figures"]["pairs_by_areas"] is content["methods"][3]["figures"]["pairs_by_areas"] is None
    assert content["options"]["crop"]["image_size"] == 480
    assert plain["options"] == {"area_matcher": "none", "matcher": "xfeat-star"}
    spent = covisible["figures"]["megapixels_matched"]["mean"]
    assert covisible["cap"] or spent == pytest.approx(sgam["figures"]["megapixels_matched"]["mean"], rel=0.02)


def test_one_seed_gives_one_result_but_for_times(folder, compared, tmp_path):
    assert cli.run(["compare", *common(folder, tmp_path / "out"), "--no-report", "--methods", *METHODS]) == DONE
    assert not (tmp_path / "out" / "report.html").exists()
    assert without_times(content_of(tmp_path / "out")) == without_times(content_of(compared))


def test_started_again_it_runs_nothing_that_is_there(folder, compared):
    summaries = {path: path.stat().st_mtime_ns for path in compared.glob("*/summary.json")}  # of the runs
    assert len(summaries) == len(METHODS)
    before = without_times(content_of(compared))
    assert cli.run(["compare", *common(folder, compared), "--no-report", "--methods", *METHODS]) == DONE
    assert summaries == {path: path.stat().st_mtime_ns for path in compared.glob("*/summary.json")}
    assert without_times(content_of(compared)) == before


@pytest.fixture
def begun(compared, tmp_path) -> Path:
    """A finished comparison that a test may go on from."""
    return Path(shutil.copytree(compared, tmp_path / "out"))


def test_other_options_of_mapping_make_the_model_anew_from_the_matches_that_are_there(folder, begun):
    names = ("none:xfeat-star", "sift")
    stored = {path: path.stat().st_mtime_ns for path in begun.glob("none_xfeat-star/pairs/*")}
    before = {method["name"]: method for method in content_of(begun)["methods"]}
    again = ["compare", *common(folder, begun), "--no-report", "--methods", *names]
    assert cli.run([*again, "--keypoints.track-radius-px", "0", "--no-mapping"]) == DONE
    after = {method["name"]: method for method in content_of(begun)["methods"]}
    for name in names:
        assert before[name]["figures"]["registered"]["mean"] == 4
        assert after[name]["figures"]["registered"]["mean"] == 0
    plain, made = before["none:xfeat-star"], after["none:xfeat-star"]
    assert stored
    assert stored == {path: path.stat().st_mtime_ns for path in begun.glob("none_xfeat-star/pairs/*")}
    assert made["figures"]["megapixels_matched"] == plain["figures"]["megapixels_matched"]
    assert made["figures"]["megapixels_extracted"] == plain["figures"]["megapixels_extracted"]
    assert made["times"]["matching_seconds"] == plain["times"]["matching_seconds"]


def test_a_method_that_was_interrupted_is_charged_with_all_of_its_matches(folder, begun):
    method = begun / "none_xfeat-star"
    before = content_of(begun)["methods"]
    (method / "result.json").unlink()
    (method / "summary.json").unlink()
    assert cli.run(["compare", *common(folder, begun), "--no-report", "--methods", *METHODS]) == DONE
    for one, other in zip(before, content_of(begun)["methods"], strict=True):
        assert one["figures"] == other["figures"]
    matching = json.loads((method / "result.json").read_text())
    assert matching["pixels_extracted"] > 0
    assert matching["saved_seconds"] > 0  # which an earlier session has spent


def test_figures_of_other_pairs_are_never_shown(folder, begun, capsys):
    fewer = ["compare", *common(folder, begun), "--no-report", "--max-pairs", "3", "--methods"]
    assert cli.run([*fewer, "none:xfeat-star"]) == USAGE
    error = capsys.readouterr().err
    assert "none_xfeat-star' was begun with other pairs (3 only there," in error
    assert "choose a new --output folder" in error
    assert cli.run([*fewer, "sift"]) == DONE  # which keeps no matches of its own to go on from
    content = content_of(begun)
    assert content["collection"]["num_pairs"] == 3
    assert content["methods"][0]["figures"]["verified_pairs"]["mean"] <= 3


def test_matches_of_crops_are_shared_between_methods(compared):
    content = content_of(compared)
    sgam, plain = (
        json.loads((compared / slug / "result.json").read_text()) for slug in ("sgam_xfeat-star", "none_xfeat-star")
    )
    assert sgam["saved_seconds"] < 0.5
    assert plain["saved_seconds"] > 0.5 * content["methods"][1]["times"]["matching_seconds"]["mean"]


def test_a_harder_cut_keeps_truth_cameras_and_labels_in_agreement(folder, tmp_path):
    arguments = [*common(folder, tmp_path / "out"), "--methods", "sgam:xfeat-star", "none:xfeat-star"]
    assert cli.run(["compare", *arguments, "--hard", "zoom=1.25", "--scene-scale", "0.9"]) == DONE
    content = content_of(tmp_path / "out")
    assert content["collection"]["hard"] == "scale=0.9 zoom=1.25"
    for method in content["methods"]:
        assert method["figures"]["registered"]["mean"] == 4
        assert method["figures"]["auc_3"]["mean"] > 50
        assert method["figures"]["reprojection_error_px"]["mean"] < 1.5
    report = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "made harder by <b>scale=0.9 zoom=1.25</b>" in report


def test_wrong_methods_are_told_before_anything_runs(folder, tmp_path, capsys):
    assert cli.run(["compare", *common(folder, tmp_path / "out"), "--methods", "sgam:xfeat"]) == USAGE
    assert "method 'sgam:xfeat': --matcher 'xfeat' is unknown; did you mean 'xfeat-star'?" in capsys.readouterr().err
    assert not (tmp_path / "out" / "labels").exists()


def test_missing_weights_are_told_before_anything_runs(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    command = ["compare", *common(folder, tmp_path / "out"), "--methods", "none:sift", "none:loftr"]
    assert cli.run(command) == ERROR
    assert "run `sgam-sfm models get loftr`" in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "out" / "none_sift").exists()


def test_evaluate_judges_matches_poses_and_areas(folder, tmp_path):
    output = tmp_path / "out"
    assert cli.run(["evaluate", *common(folder, output), "--ablation", "--max-pairs", "3"]) == DONE
    content = json.loads((output / "evaluate.json").read_text())
    assert content["num_pairs"] == 3
    figures = {variant["name"]: variant["figures"] for variant in content["variants"]}
    assert figures["whole images"]["mma_3"] > 85
    assert figures["full"]["mma_1"] > 60
    assert figures["full"]["auc_5"] > 60
    assert figures["SOA"]["areas_sia"] == figures["SIA"]["areas_soa"] == 0
    assert figures["SOA+SIA"]["areas_all"] >= max(figures["SOA"]["areas_all"], figures["SIA"]["areas_all"])
    assert figures["full"]["amp_after_gr"] >= figures["SOA+SIA"]["amp_all"]
    assert figures["whole images"]["aor_all"] is None
    assert figures["whole images"]["fallbacks"] is None
    assert figures["full"]["fallbacks"] is not None
    assert content["options"]["crop"]["image_size"] == 480
    full = next(variant for variant in content["variants"] if variant["name"] == "full")
    for by in ("rotation, degrees", "overlap", "labels in both"):
        assert sum(part["num_pairs"] for part in full["slices"] if part["by"] == by) == 3
    assert {part["part"]: part["num_pairs"] for part in full["slices"] if part["by"] == "place"} == {
        "indoor": 0,
        "outdoor": 0,
    }
    assert {"area matching", "point matching", "GP", "GR", "GMC"} <= set(full["seconds"])


def test_a_pair_that_cannot_be_matched_counts_as_failed(folder, tmp_path, capsys, monkeypatch):
    names = sorted(path.name for path in (folder / "images").iterdir())

    def read(file):
        if file.name == names[0]:
            raise InputError(f"'{file.name}' has gone")
        return read_image(file)

    monkeypatch.setattr("sgam_sfm.runs.matching.read_image", read)
    arguments = [*common(folder, tmp_path / "out"), "--area-matcher", "covisible"]
    assert cli.run(["evaluate", *arguments]) == DONE
    assert "3 pairs could not be matched, counted as failed" in capsys.readouterr().err
    for variant in json.loads((tmp_path / "out" / "evaluate.json").read_text())["variants"]:
        failed = [pair for pair in variant["pairs"] if names[0] in pair["pair"]]
        assert all(pair["error"] == f"'{names[0]}' has gone" for pair in failed)
        assert all(set(pair["pose_errors_deg"]) == {180} and pair["num_matches"] == 0 for pair in failed)
        assert sum(max(pair["pose_errors_deg"]) < 5 for pair in variant["pairs"]) >= 2


def test_evaluate_takes_frames_that_are_so_far_apart_and_the_angles_of_a_data_set(folder, tmp_path):
    output = tmp_path / "out"
    command = ["evaluate", *common(folder, output), "--area-matcher", "none", "--frame-difference", "2"]
    assert (
        cli.run([*command, "--dataset", "matterport3d", "--ground-truth-format", "colmap"]) == ERROR
    )  # its own format
    assert cli.run(command) == DONE
    content = json.loads((output / "evaluate.json").read_text())
    pairs = [tuple(pair["pair"]) for pair in content["variants"][0]["pairs"]]
    assert pairs == [("view02.jpg", "view04.jpg"), ("view03.jpg", "view05.jpg")]


def test_methods_name_their_matchers(folder, tmp_path, capsys):
    given = ["compare", *common(folder, tmp_path / "out"), "--methods", *METHODS, "--area-matcher", "tiles"]
    assert cli.run(given) == USAGE
    assert "here methods name theirs: --methods tiles:xfeat-star ..." in " ".join(capsys.readouterr().err.split())


def test_sizes_and_angles_that_are_given_are_not_those_of_the_data_set(tmp_path):
    given = EvaluateOptions(images=tmp_path, output=tmp_path, ground_truth=tmp_path, dataset="matterport3d")
    assert (with_dataset(given).crop.area_size, with_dataset(given).auc_degrees) == (480, (10, 20, 30))
    given = replace(given, crop=CropOptions(area_size=700), auc_degrees=(3.0,))
    assert (with_dataset(given).crop.area_size, with_dataset(given).auc_degrees) == (700, (3.0,))


def test_evaluate_without_a_known_pose_says_how_names_differ(folder, tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for number, name in enumerate(("view02.jpg", "view03.jpg")):
        (images / f"other{number}.jpg").symlink_to(folder / "images" / name)
    command = ["--images", str(images), "--ground-truth", str(folder / "truth"), "--output", str(tmp_path / "out")]
    assert cli.run(["evaluate", *command, "--area-matcher", "none"]) == ERROR
    error = capsys.readouterr().err
    assert "none of the 1 pairs has a known pose in" in error
    assert "its images are named like 'view02.jpg', the first pair is 'other0.jpg' - 'other1.jpg'" in error


def test_evaluate_refuses_images_that_the_true_cameras_do_not_fit(folder, tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for name in ("view02.jpg", "view03.jpg"):
        with PIL.Image.open(folder / "images" / name) as image:
            image.resize((320, 240)).save(images / name)
    command = ["--images", str(images), "--ground-truth", str(folder / "truth"), "--output", str(tmp_path / "out")]
    assert cli.run(["evaluate", *command, "--area-matcher", "none"]) == ERROR
    error = capsys.readouterr().err
    assert "'view02.jpg' has 320x240 pixels, its camera in" in error
    assert "is of 640x480; evaluate images of that size (`sgam-sfm compare --scene-scale` scales" in error


def test_an_unknown_data_set_is_told_with_the_nearest(folder, tmp_path, capsys):
    assert cli.run(["evaluate", *common(folder, tmp_path / "out"), "--dataset", "scanet"]) == USAGE
    assert (
        "--dataset 'scanet' is unknown; did you mean 'scannet'? known: scannet, scannet1500" in capsys.readouterr().err
    )
