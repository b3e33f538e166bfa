"""The output folder of a run: what is read from it, and what is said when something is not there."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from sgam_core.errors import InputError
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches, PairResult, TwoViewModel
from sgam_sfm.commands.show import ShowOptions, default_path
from sgam_sfm.pictures import collection_picture, image_picture, pair_picture
from sgam_sfm.runs.results import find_plain, open_plain, open_results, swapped
from sgam_sfm.runs.store import PairRecord, PairStore

NAMES = ("a.jpg", "b c.jpg", "sub/ü$_.jpg", "d.jpg")
AREA = AreaMatch(
    area0=Area(box=Box(x0=1, y0=2, x1=30, y1=20), kind="object", label=1),
    area1=Area(box=Box(x0=3, y0=4, x1=40, y1=25), kind="object", label=2),
    distance=0.1,
    state=AreaState.REJECTED,
    scale0=0.5,
    scale1=0.25,
)
RESULT = PairResult(
    matches=Matches(
        points0=np.array([[1.5, 2.5], [10, 20]]),
        points1=np.array([[3.5, 4.5], [11, 21]]),
        scores=np.ones(2),
        sigmas0=np.array([1.0, 2]),
        sigmas1=np.array([3.0, 4]),
        area_index=np.array([0, -1], np.int32),
    ),
    areas=(AREA,),
    two_view=TwoViewModel(
        F=np.array([[0, 0, 0], [0, 0, -1], [0, 2, 3.0]]), calibrated=True, num_inliers=1, num_matches=2, planarity=0.5
    ),
    coverage0=0.1,
    coverage1=0.2,
    whole_scale0=1.0,
    whole_scale1=2.0,
    turned=90,
    zoom=0.5,
)
RECORDS = (
    PairRecord(pair=(NAMES[0], NAMES[1]), result=RESULT),
    PairRecord(pair=(NAMES[2], NAMES[0]), result=replace(RESULT, coverage0=0.7)),
    PairRecord(pair=(NAMES[1], NAMES[2]), result=None, error="the mask is broken"),
)


def write_run(folder: Path, images: Path, *, inputs: bool = True, blocks=(RECORDS[:2], RECORDS[2:]), **options) -> Path:
    """An output folder without labels, database and model."""
    store = PairStore(folder=folder / "pairs", fingerprint="")
    for index, records in enumerate(blocks):
        store.write(index, records)
    folder.mkdir(exist_ok=True)
    content = {"images": str(images), "matcher": "xfeat-star", "area_matcher": "sgam"} | options
    (folder / "options.json").write_text(json.dumps(content))
    if inputs:
        pairs = [*(record.pair for record in RECORDS), (NAMES[0], NAMES[3])]
        failed = {"broken.jpg": "'broken.jpg' cannot be decoded (not an image)"}
        record = {"images": dict.fromkeys(NAMES, "digest"), "failed": failed, "pairs": pairs}
        (folder / "inputs.json").write_text(json.dumps(record))
    return folder


@pytest.fixture
def images(tmp_path) -> Path:
    for name in NAMES:
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (64, 48), (90, 120, 150)).save(tmp_path / "images" / name)
    return tmp_path / "images"


@pytest.fixture
def out(tmp_path, images) -> Path:
    return write_run(tmp_path / "out", images)


def message_of(function, *arguments) -> str:
    with pytest.raises(InputError) as error:
        function(*arguments)
    return str(error.value)


def words_of(figure) -> str:
    return " ".join(text.get_text() for part in (figure, *figure.axes) for text in part.texts)


def test_names_pairs_and_failures_are_known(out):
    results = open_results(out)
    assert results.names == ("a.jpg", "b c.jpg", "broken.jpg", "d.jpg", "sub/ü$_.jpg")
    assert results.blocks == {RECORDS[0].pair: 0, RECORDS[1].pair: 0, RECORDS[2].pair: 1}
    assert results.errors == {RECORDS[2].pair: "the mask is broken"}
    assert results.partners("a.jpg") == ("b c.jpg", "d.jpg", "sub/ü$_.jpg")
    assert dict(results.failed) == {"broken.jpg": "'broken.jpg' cannot be decoded (not an image)"}


def test_without_a_record_of_the_inputs_names_come_from_pairs_labels_and_summary(tmp_path, images):
    out = write_run(tmp_path / "out", images, inputs=False)
    (out / "labels").mkdir()
    PIL.Image.new("L", (64, 48)).save(out / "labels" / "d.jpg.png")
    (out / "summary.json").write_text(json.dumps({"images": {"failed": {"broken.jpg": "why"}}}))
    (out / "labels" / "labels.json").write_text(json.dumps({"labels": [{"id": 1, "name": "door"}, {"id": 2}]}))
    results = open_results(out)
    assert results.names == ("a.jpg", "b c.jpg", "broken.jpg", "d.jpg", "sub/ü$_.jpg")
    assert results.label_names() == {1: "door"}
    assert results.labels("d.jpg").shape == (48, 64)
    assert results.labels("a.jpg") is None


def test_a_pair_is_read_in_the_order_it_is_asked_for(out):
    results = open_results(out)
    forth, back = results.result(("sub/ü$_.jpg", "a.jpg")), results.result(("a.jpg", "sub/ü$_.jpg"))
    assert (forth.coverage0, back.coverage0, back.coverage1) == (0.7, 0.2, 0.7)
    np.testing.assert_array_equal(back.matches.points0, forth.matches.points1)
    np.testing.assert_array_equal(back.matches.sigmas1, forth.matches.sigmas0)
    np.testing.assert_array_equal(back.two_view.F, forth.two_view.F.T)
    assert back.areas[0].area0 == AREA.area1
    assert (back.areas[0].scale0, back.areas[0].scale1, back.whole_scale0) == (0.25, 0.5, 2.0)
    assert (forth.turned, back.turned, forth.zoom, back.zoom) == (90, 270, 0.5, 2)
    again = swapped(back)
    assert again.areas == forth.areas
    assert results.result(("b c.jpg", "d.jpg")) is None


def test_the_pairs_of_an_image_have_it_first(out):
    found = dict(open_results(out).results_of("a.jpg"))
    assert list(found) == ["b c.jpg", "sub/ü$_.jpg"]
    assert found["b c.jpg"].areas[0].area0 == AREA.area0
    assert found["sub/ü$_.jpg"].areas[0].area0 == AREA.area1
    assert dict(open_results(out).results_of("d.jpg")) == {}


class TestMessages:
    def test_no_result_folder(self, tmp_path, out):
        expected = "give the --output folder of a match run"
        assert message_of(open_results, tmp_path / "no") == f"'{tmp_path / 'no'}' does not exist; {expected}"
        file = out / "options.json"
        assert message_of(open_results, file) == f"'{file}' is a file; {expected}"
        assert message_of(open_results, out / "pairs") == (
            f"'{out / 'pairs'}' is no result folder (no options.json of a run in it); {expected}"
        )
        assert message_of(open_results, tmp_path) == (
            f"'{tmp_path}' is no result folder (no options.json of a run in it); did you mean '{out}'?"
        )

    def test_unknown_image(self, out):
        results = open_results(out)
        where = f"is not among the 5 images of '{out}'; the nearest name is"
        assert message_of(results.require, "b_c.jpg") == f"'b_c.jpg' {where} 'b c.jpg'"
        assert message_of(results.pair, "a.jpg", "ü$_.jpg") == f"'ü$_.jpg' {where} 'sub/ü$_.jpg'"

    def test_unlisted_pair(self, out):
        results = open_results(out)
        assert message_of(results.pair, "d.jpg", "b c.jpg") == (
            f"the pair 'd.jpg' - 'b c.jpg' was not in the list of '{out}'; 'd.jpg' was listed with 'a.jpg'"
        )
        assert message_of(results.pair, "a.jpg", "a.jpg") == "'a.jpg' was named twice; a pair is two images"

    def test_many_partners_are_counted(self, tmp_path, images):
        records = [PairRecord(pair=("a.jpg", f"p{n:02d}.jpg"), result=RESULT) for n in range(12)]
        out = write_run(
            tmp_path / "out", images, inputs=False, blocks=(records, [replace(RECORDS[0], pair=("x", "y"))])
        )
        message = message_of(open_results(out).pair, "a.jpg", "x")
        assert message.endswith(
            "'a.jpg' was listed with " + ", ".join(f"'p{n:02d}.jpg'" for n in range(8)) + " and 4 more"
        )

    def test_failed_pair(self, out):
        results = open_results(out)
        assert message_of(results.pair, "sub/ü$_.jpg", "b c.jpg") == (
            f"the pair 'sub/ü$_.jpg' - 'b c.jpg' failed in '{out}': the mask is broken"
        )
        assert message_of(results.pair, "a.jpg", "broken.jpg") == (
            f"the pair 'a.jpg' - 'broken.jpg' failed in '{out}': 'broken.jpg' cannot be decoded (not an image)"
        )
        assert message_of(results.usable, "broken.jpg") == (
            f"image 'broken.jpg' could not be used in '{out}': 'broken.jpg' cannot be decoded (not an image)"
        )

    def test_pair_that_is_not_matched_yet(self, out):
        assert message_of(open_results(out).pair, "a.jpg", "d.jpg") == (
            f"the pair 'a.jpg' - 'd.jpg' has not been matched yet in '{out}'; start the same run again"
        )

    def test_moved_images(self, tmp_path, out, images):
        moved = images.rename(tmp_path / "elsewhere")
        assert message_of(open_results, out) == (
            f"the image folder '{images}' does not exist: if it was moved, give the new one with --images DIR"
        )
        assert message_of(open_results, out, tmp_path / "no") == (
            f"the image folder '{tmp_path / 'no'}' does not exist; check --images"
        )
        assert open_results(out, moved).pixels("a.jpg").shape == (48, 64, 3)
        (moved / "a.jpg").unlink()
        assert message_of(open_results(out, moved).pixels, "a.jpg") == (
            f"image 'a.jpg' is no longer in '{moved}'; give its folder with --images DIR"
        )

    def test_broken_pairs(self, out):
        path = out / "pairs" / "00001.h5"
        path.write_bytes(b"not HDF5")
        assert (
            message_of(open_results, out)
            == f"'{path}' is not a file of pair results, or damaged (Unable to synchronously open file (file signature "
            "not found)); start the run again: its pairs are matched again, all others are kept"
        )

    def test_other_plain_matcher(self, out):
        assert message_of(open_plain, out) == (
            f"'{out}' was matched with --area-matcher sgam; --plain expects the output of --area-matcher none"
        )


class TestPlain:
    PAIR = RECORDS[0].pair

    def test_it_is_found_beside_the_run(self, tmp_path, out, images):
        write_run(tmp_path / "other", images.parent, area_matcher="none")
        write_run(tmp_path / "other matcher", images, area_matcher="none", matcher="orb")
        write_run(tmp_path / "some pairs", images, area_matcher="none", blocks=(RECORDS[1:],))
        write_run(tmp_path / "some broken", images, area_matcher="none")
        (tmp_path / "some broken" / "pairs" / "00000.h5").write_bytes(b"")
        assert find_plain(open_results(out), self.PAIR) is None
        plain = write_run(tmp_path / "plain", images, area_matcher="none")
        assert find_plain(open_results(out), self.PAIR).folder == plain
        assert find_plain(open_results(out), self.PAIR[::-1]).folder == plain

    def test_it_is_not_beside_itself(self, tmp_path, images):
        for name in ("plain", "again"):
            write_run(tmp_path / name, images, area_matcher="none")
        assert find_plain(open_results(tmp_path / "plain"), self.PAIR) is None


class TestPicturesOfWhatThereIs:
    def test_a_pair_without_labels_and_database(self, out):
        figure = pair_picture(open_results(out), ("a.jpg", "b c.jpg"))
        expected = "labels of 'a.jpg' and 'b c.jpg' (no label map); COLMAP's inliers (no database.db)"
        assert f"Not in this picture: {expected}." in words_of(figure)

    def test_a_pair_of_the_plain_matcher(self, tmp_path, images):
        bare = replace(RECORDS[0], result=replace(RESULT, areas=()))
        plain = write_run(tmp_path / "plain", images, area_matcher="none", blocks=([bare],))
        words = words_of(pair_picture(open_results(plain), ("a.jpg", "b c.jpg")))
        assert "Not in this picture: areas (the run was made with --area-matcher none)" in words
        assert "Matches on whole images" in words

    def test_an_image(self, out):
        words = words_of(image_picture(open_results(out), "a.jpg"))
        assert "Not in this picture: labels (no label map); keypoints (no database.db)." in words
        assert "2 of 3 pairs matched; no keypoints yet." in words

    def test_a_collection(self, out):
        words = words_of(collection_picture(open_results(out)))
        assert "5 images, 1 of them failed; 4 pairs listed, 2 matched, 1 failed." in words
        missing = "keypoints and verified pairs (no database.db); registered images (no model in sparse)"
        assert f"Not in this picture: {missing}." in words
        assert "broken.jpg: cannot be decoded (not an image)" in words
        inputs = json.loads((out / "inputs.json").read_text())
        (out / "inputs.json").write_text(json.dumps(inputs | {"left_out": [["a.jpg", "broken.jpg"]]}))
        words = words_of(collection_picture(open_results(out)))
        assert "5 images, 1 of them failed; 5 pairs listed, 2 matched, 2 failed." in words

    def test_a_run_that_has_just_begun(self, tmp_path, images):
        out = write_run(tmp_path / "out", images, inputs=False, blocks=())
        assert message_of(collection_picture, open_results(out)) == (
            f"'{out}' knows of no image yet; start the same run again"
        )
        assert (
            message_of(open_results(out).require, "a.jpg")
            == f"'a.jpg' is not among the 0 images of '{out}'; there are none yet"
        )


def test_pictures_go_beneath_the_output():
    assert default_path(Path("out"), ()) == Path("out/pictures/collection.png")
    assert default_path(Path("out"), ("sub/a.jpg", "b.jpg")) == Path("out/pictures/sub-a.jpg--b.jpg.png")
    assert ShowOptions(output=Path("out")).names == ()


def test_a_folder_that_was_copied_elsewhere_is_complete(tmp_path, out):
    copy = shutil.copytree(out, tmp_path / "new" / "out")
    assert open_results(copy).result(("a.jpg", "b c.jpg")).areas == (AREA,)
