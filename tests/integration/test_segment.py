"""Label maps from end to end: made, drawn, read back, ignored and masked."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest

from sgam_core.errors import StageError, WeightsError
from sgam_sfm import cli, registry
from sgam_sfm.colmap.reading import database_content
from sgam_sfm.exit_codes import DONE, ERROR, SOME_FAILED, USAGE
from sgam_sfm.images import ImageFile, read_label_map
from sgam_sfm.inputs import read_images
from sgam_sfm.label_maps import make_label_maps, write_label_maps
from sgam_sfm.label_set import read_label_set
from sgam_sfm.options import MatchOptions
from sgam_sfm.progress import Stages
from sgam_sfm.room.furniture import LABELS
from sgam_sfm.runs.store import read_pairs_of
from sgam_sfm.segmenters.ade20k import CLASSES
from tests.paths import weights_of
from tests.room import Room, write_room


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    return write_room(room, tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def segmented(folder: Path, tmp_path_factory) -> Path:
    """The label maps that `sgam-sfm segment` makes."""
    output = tmp_path_factory.mktemp("segment") / "labels"
    command = ["segment", "--images", str(folder / "images"), "--output", str(output), "--num-labels", "8"]
    assert cli.run([*command, "--ignore-labels", "3"]) == DONE
    return output


def pngs(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.png"))}


def test_segment_writes_maps_overlays_and_what_they_mean(room, segmented):
    found = read_label_set(segmented)
    assert (found.segmenter, found.ignored, found.failed) == ("coseg", (3,), {})
    assert {label.id for label in found.labels} <= set(range(1, 9))
    assert sum(label.share for label in found.labels) == pytest.approx(1, abs=1e-3)
    assert len({label.colour for label in found.labels}) == len(found.labels)
    for name, image in room.images.items():
        assert read_label_map(segmented / f"{name}.png").shape == (image.height, image.width)
        with PIL.Image.open(segmented / "overlays" / f"{name}.jpg") as overlay:
            assert overlay.size == (image.width, image.height)  # smaller than 1200 pixels


def test_labels_reads_back_identically_what_segment_wrote(folder, segmented, tmp_path):
    images = read_images(folder / "images", tmp_path / "none", Stages(quiet=True)).images
    common = {"images": folder / "images"}
    direct = make_label_maps(MatchOptions(**common, output=tmp_path / "a", num_labels=8), images, Stages(quiet=True))
    read = make_label_maps(MatchOptions(**common, output=tmp_path / "b", labels=segmented), images, Stages(quiet=True))
    assert pngs(direct.folder) == pngs(read.folder)
    assert [label.id for label in read.set.labels] == [label.id for label in direct.set.labels]
    assert read.set.ignored == (3,)


def test_maps_larger_than_areas_need_are_reduced_and_enlarged_without_loss(tmp_path):
    rng = np.random.default_rng(0)
    small = rng.choice(60000, 900)[rng.integers(0, 900, (427, 640))].astype(np.uint16)
    (tmp_path / "labels").mkdir()
    (tmp_path / "images").mkdir()
    size = (3072, 2048)
    PIL.Image.new("RGB", size).save(tmp_path / "images" / "a.jpg")
    PIL.Image.fromarray(small).save(tmp_path / "labels" / "a.png")
    command = ["--images", str(tmp_path / "images"), "--labels", str(tmp_path / "labels"), "--resize-labels"]
    assert cli.run(["segment", *command, "--output", str(tmp_path / "full"), "--overlay-size", "0"]) == DONE
    full = read_label_map(tmp_path / "full" / "a.jpg.png")
    assert full.shape == size[::-1]
    images = read_images(tmp_path / "images", tmp_path / "none", Stages(quiet=True)).images
    options = MatchOptions(images=tmp_path / "images", output=tmp_path / "out", labels=tmp_path / "full")
    made = make_label_maps(options, images, Stages(quiet=True))
    np.testing.assert_array_equal(made.read("a.jpg"), small)


def test_labels_of_another_size_fail_unless_they_may_be_resized(folder, tmp_path, capsys):
    maps = tmp_path / "labels"
    shutil.copytree(folder / "labels", maps)
    (maps / "view02.jpg.png").unlink()
    PIL.Image.fromarray(np.ones((48, 64), np.uint8)).save(maps / "view02.png")
    command = ["segment", "--images", str(folder / "images"), "--labels", str(maps), "--overlay-size", "0"]
    assert cli.run([*command, "--output", str(tmp_path / "a")]) == SOME_FAILED
    reason = (
        "labels for 'view02.jpg' are 48x64 but the image is 480x640 (height x width); export them again at the image's "
        "size, or pass --resize-labels"
    )
    assert read_label_set(tmp_path / "a").failed == {"view02.jpg": reason}
    assert cli.run([*command, "--output", str(tmp_path / "b"), "--resize-labels"]) == DONE
    assert read_label_map(tmp_path / "b" / "view02.jpg.png").shape == (480, 640)
    capsys.readouterr()


class Faulty:
    """A segmenter of somebody else's."""

    def __init__(self, *given: object) -> None:
        self._given = given

    def segment(self, images, advance):
        yield from self._given
        raise KeyError("wall")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((), r"the segmenter Faulty failed: KeyError: 'wall' \(test_segment.py:\d+\); the log has the traceback"),
        ((np.ones((3, 4), np.int32),), r"the segmenter Faulty gave ndarray; expected \(image, label map\)"),
    ],
)
def test_a_segmenter_that_fails_is_named(folder, tmp_path, given, expected):
    images = read_images(folder / "images", tmp_path / "none", Stages(quiet=True)).images
    with pytest.raises(StageError, match=expected):
        write_label_maps(Faulty(*given), "faulty", images, tmp_path / "labels", Stages(quiet=True), full_size=False)


def matching(folder: Path, output: Path, *more: str) -> list[str]:
    return [
        *("match", "--images", str(folder / "images"), "--pairs", str(folder / "pairs.txt"), "--output", str(output)),
        *("--labels", str(folder / "labels"), "--no-mapping", "--area-size", "320", "--image-size", "480"),
        *("--max-crop-pixels", "300000", *more),
    ]


def test_ignored_labels_form_no_area_and_masked_ones_no_match(room, folder, tmp_path):
    output = tmp_path / "out"
    flags = ("--ignore-labels", "wall,Floor", "--mask-matches", "ceiling,relief")
    assert cli.run(matching(folder, output, *flags)) == DONE
    records = list(read_pairs_of(output))
    labels = {area.area0.label for record in records for area in record.result.areas}
    assert labels
    assert not labels & {LABELS[name] for name in ("wall", "floor", "ceiling", "relief")}
    points = database_content(output / "database.db")["keypoints"]
    masked = on_masked = 0
    for name, rendering in room.renderings.items():
        hidden = np.isin(rendering.labels, [LABELS["ceiling"], LABELS["relief"]])
        hidden = cv2.erode(hidden.astype(np.uint8), np.ones((5, 5)))  # crops see the mask at their own resolution
        masked += hidden.sum()
        for record in records:
            for side in (0, 1):
                if record.pair[side] == name:
                    found = (record.result.matches.points0, record.result.matches.points1)[side]
                    x, y = found.astype(int).T
                    on_masked += hidden[y, x].sum()
    assert masked > 10_000
    assert on_masked == 0
    assert sum(map(len, points.values())) > 500


def test_masking_by_labels_works_for_whole_images_too(room, folder, tmp_path, capsys):
    folder, output = shutil.copytree(folder, tmp_path / "room"), tmp_path / "out"
    assert cli.run(matching(folder, output, "--area-matcher", "none", "--mask-matches", "wall")) == DONE
    for record in read_pairs_of(output):
        x, y = record.result.matches.points0.astype(int).T
        hidden = (room.renderings[record.pair[0]].labels == LABELS["wall"]).astype(np.uint8)
        assert not cv2.erode(hidden, np.ones((5, 5)))[y, x].any()
        assert record.result.fallback == "no area match"
    changed = next((folder / "labels").glob("*.png"))
    PIL.Image.fromarray(np.ones_like(read_label_map(changed), np.uint8)).save(changed)
    assert cli.run(matching(folder, output, "--area-matcher", "none", "--mask-matches", "wall")) == USAGE
    assert "was begun with other content of --labels; choose a new --output" in " ".join(
        capsys.readouterr().err.split()
    )


def test_label_maps_are_made_once_from_the_same(tmp_path):
    image = ImageFile(name="a.jpg", path=tmp_path / "a.jpg", width=40, height=30, digest="1")
    for folder, ids in (("two", 2), ("three", 3)):
        (tmp_path / folder).mkdir()
        PIL.Image.fromarray(np.arange(1200, dtype=np.uint8).reshape(30, 40) % ids).save(tmp_path / folder / "a.jpg.png")

    def made(labels: str) -> int:
        options = MatchOptions(images=tmp_path, output=tmp_path / "out", labels=tmp_path / labels)
        return len(make_label_maps(options, {"a.jpg": image}, Stages(quiet=True)).set.labels)

    assert (made("two"), made("three")) == (1, 2)  # 0 is unknown
    written = (tmp_path / "out" / "labels" / "labels.json").stat().st_mtime_ns
    assert made("three") == 2
    assert (tmp_path / "out" / "labels" / "labels.json").stat().st_mtime_ns == written


@pytest.mark.parametrize("flag", ["--ignore-labels", "--mask-matches"])
def test_a_misspelt_label_is_a_usage_error(folder, tmp_path, capsys, flag):
    assert cli.run(matching(folder, tmp_path / "out", flag, "wal")) == USAGE
    assert f"{flag} 'wal' is no label; did you mean 'wall'? known: book, cabinet" in capsys.readouterr().err
    # Nothing is matched yet, so that the corrected command may use the same folder.
    assert cli.run([*matching(folder, tmp_path / "out", flag, "wall"), "--area-matcher", "none"]) == DONE


def test_a_damaged_labels_json_is_named(folder, tmp_path, capsys):
    maps = tmp_path / "labels"
    shutil.copytree(folder / "labels", maps)
    (maps / "labels.json").write_text('{"labels": [{"name": "wall"}]}')
    assert (
        cli.run(["segment", "--images", str(folder / "images"), "--labels", str(maps), "--output", str(tmp_path / "x")])
        == ERROR
    )
    assert f"'{maps}/labels.json' cannot be used (labels.0.id: Field required)" in capsys.readouterr().err


def test_a_model_of_the_hub_segments_and_its_names_are_ignored(folder, tmp_path, hub_model):
    model = f"hf:{hub_model('segformer')}"
    command = ["segment", "--images", str(folder / "images"), "--overlay-size", "0", "--segmenter", model]
    assert cli.run([*command, "--output", str(tmp_path / "labels"), "--ignore-labels", "person,car,sky"]) == DONE
    found = read_label_set(tmp_path / "labels")
    assert (found.segmenter, found.ignored) == (model, (2, 3, 4))
    assert [label.name for label in found.labels] == ["wall", "sky-other-merged", "person", "car, auto"]
    assert read_label_map(tmp_path / "labels" / "view02.jpg.png").shape == (480, 640)


def test_maps_of_a_data_set_are_ignored_and_masked_by_name(folder, tmp_path, capsys):
    """The room's labels 1 and 2, as persons and cars of Cityscapes' instance maps."""
    maps = tmp_path / "maps"
    for path in (folder / "labels").glob("*.png"):
        labels = read_label_map(path)
        maps.mkdir(exist_ok=True)
        values = np.where(labels == 1, 24_003, np.where(labels == 2, 26_000, 11)).astype(np.uint16)
        PIL.Image.fromarray(values).save(maps / path.name)
    command = ["segment", "--images", str(folder / "images"), "--overlay-size", "0", "--labels", str(maps)]
    output = tmp_path / "labels"
    flags = ["--label-names", "cityscapes", "--ignore-labels", "person,car,sky"]
    assert cli.run([*command, *flags, "--output", str(output)]) == DONE
    found = read_label_set(output)
    assert (found.ignored, found.names) == ((23, 24, 26), "")
    assert {label.name for label in found.labels if label.share} == {"person", "car", "building"}
    assert set(np.unique(read_label_map(output / "view02.jpg.png"))) <= {11, 24, 26}
    capsys.readouterr()
    assert cli.run([*command, "--output", str(tmp_path / "b"), "--label-names", "cityscape"]) == USAGE
    assert "--label-names 'cityscape' is unknown; did you mean 'cityscapes'?" in capsys.readouterr().err
    without = [*command[:-2], "--output", str(tmp_path / "c"), "--label-names", "cityscapes"]
    assert cli.run(without) == USAGE
    assert "--label-names 'cityscapes' says how --labels are written; give --labels too" in capsys.readouterr().err


def test_ade20k_names_what_photos_show(data, tmp_path):
    """Provenance: castle-P19/0000.jpg is a courtyard, two thirds building, a sixth sky, a fifth ground."""
    try:
        segmenter = registry.create("segmenter", "ade20k", weights=weights_of("ade20k"))
    except WeightsError as error:
        pytest.skip(f"{error}; or set SGAM_SFM_WEIGHTS")
    images = tmp_path / "images"
    images.mkdir()
    (images / "a.jpg").symlink_to((data / "strecha" / "castle-P19" / "images" / "0000.jpg").resolve())
    files = read_images(images, tmp_path / "none", Stages(quiet=True)).images
    ((_, labels),) = segmenter.segment(tuple(files.values()), lambda share: None)
    share = {name: (labels == number).mean() for number, name in enumerate(CLASSES, start=1)}
    assert share["building"] > 0.5
    assert 0.1 < share["sky"] < 0.25
    assert share["road"] + share["sidewalk"] > 0.1
    assert json.loads(json.dumps({label.name: label.id for label in segmenter.label_set.labels}))["sky"] == 3
