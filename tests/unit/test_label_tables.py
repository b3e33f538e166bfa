"""Label maps as public data sets write them: ids, names, instances, segments, and maps of another kind."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage

from sgam_core.errors import InputError, OptionError, SGAMError
from sgam_sfm.images import ImageFile
from sgam_sfm.label_set import LabelSet
from sgam_sfm.label_tables import DESCRIPTIONS, PANOPTIC, find_table
from sgam_sfm.segmenters.labels import LabelFolder


def save(path: Path, values: list[int]) -> Path:
    """A map of one row: 8 bits where they suffice, else 16."""
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.uint8 if max(values) < 256 else np.uint16
    PillowImage.fromarray(np.array([values], depth)).save(path)
    return path


def save_segments(path: Path, ids: list[int]) -> Path:
    rgb = np.array([[(number % 256, number // 256 % 256, number // 65536) for number in ids]], np.uint8)
    PillowImage.fromarray(rgb).save(path)
    return path


def image_file(name: str, width: int) -> ImageFile:
    return ImageFile(name=name, path=Path("images") / name, width=width, height=1, digest="0")


def read(folder: Path, values: list[int], label_names: str, name: str = "a.png") -> tuple[list[int], LabelSet]:
    """What a folder makes of one map, and what it says of its ids."""
    save(folder / name, values)
    maps = LabelFolder(folder, label_names=label_names)
    ((_, labels),) = maps.segment([image_file("a.jpg", len(values))], lambda share: None)
    if isinstance(labels, Exception):
        raise labels
    return labels[0].tolist(), maps.label_set


def names(labels: LabelSet) -> dict[int, str]:
    return {label.id: label.name for label in labels.labels}


@pytest.mark.parametrize(
    ("label_names", "values", "expected"),
    [
        ("nyu40", [0, 1, 24, 40], ["", "wall", "refridgerator", "otherprop"]),
        ("ade20k", [0, 1, 3, 13, 21, 150], ["", "wall", "sky", "person", "car", "flag"]),
        ("coco", [0, 1, 62, 157, 187, 200], ["", "person", "chair", "sky-other", "sky-other-merged", "rug-merged"]),
        (
            "coco-stuff",
            [255, 0, 2, 90, 91, 156, 181],
            ["", "person", "car", "hair brush", "banner", "sky-other", "wood"],
        ),
        (
            "seem",
            [0, 2, 79, 80, 119, 132, 255],
            ["person", "car", "toothbrush", "banner", "sky-other-merged", "rug-merged", ""],
        ),
        ("cityscapes", [0, 7, 23, 24, 26, 33, 255], ["", "road", "sky", "person", "car", "bicycle", ""]),
        ("cityscapes-train", [0, 10, 11, 13, 18, 255], ["road", "sky", "person", "car", "bicycle", ""]),
        ("kitti360", [0, 11, 26, 37, 44], ["", "building", "car", "smallpole", "unknown object"]),
    ],
)
def test_maps_of_public_data_sets_speak_in_names(tmp_path, label_names, values, expected):
    labels, label_set = read(tmp_path, values, label_names)
    assert [names(label_set).get(label, "") for label in labels] == expected
    assert [label == 0 for label in labels] == [name == "" for name in expected]


def test_every_table_is_whole():
    sizes = {name: len(find_table(name).names) for name in DESCRIPTIONS}
    assert sizes == {
        **{"nyu40": 40, "ade20k": 150, "coco": 200, "coco-stuff": 200, "seem": 200},
        **{"cityscapes": 33, "cityscapes-train": 33, "kitti360": 44},
    }
    assert len(PANOPTIC) == len(set(PANOPTIC)) == 133
    for name in DESCRIPTIONS:
        table = find_table(name)
        assert min(table.names) == 1
        assert all(table.names.values())


@pytest.mark.parametrize("label_names", ["nyu40", "ade20k", "coco", "coco-stuff", "seem", "cityscapes", "kitti360"])
def test_names_work_wherever_ids_do(tmp_path, label_names):
    _, label_set = read(tmp_path, [1, 2], label_names)
    indoor = label_names == "nyu40"
    for name in ("person", "ceiling" if indoor else "sky", "chair" if indoor else "car"):
        (*ids,) = label_set.ids(name, "--ignore-labels")
        assert all(name in names(label_set)[label] for label in ids)
        assert ids


def test_short_names_of_merged_classes_and_of_synonyms(tmp_path):
    _, label_set = read(tmp_path, [1], "coco")
    assert label_set.ids("sky", "--ignore-labels") == (157, 187)
    assert label_set.ids("tree", "--ignore-labels") == (169,)  # a class of its own, so not tree-merged
    with pytest.raises(
        OptionError, match=r"--ignore-labels 'skies' is no label; did you mean 'skis'\? known: airplane, "
    ):
        label_set.ids("skies", "--ignore-labels")


# --- Instances


@pytest.mark.parametrize("label_names", ["cityscapes", "kitti360"])
def test_instances_become_their_classes_or_stay_apart(tmp_path, label_names):
    values = [0, 7, 24, 24000, 26001, 26012, 33999]
    labels, label_set = read(tmp_path, values, label_names)
    assert labels == [0, 7, 24, 24, 26, 26, 33]
    assert label_set.ids("car", "--mask-matches") == (26,)
    labels, label_set = read(tmp_path, values, f"{label_names}:instances")
    assert labels == values
    assert label_set.ids("person,car", "--mask-matches") == (24, 24000, 26, 26001, 26012)
    assert label_set.ids("sky", "--mask-matches") == (23,)
    assert names(label_set)[33999] == "bicycle"


def test_the_names_of_cityscapes_files(tmp_path):
    save(tmp_path / "aachen/a_0_gtFine_labelIds.png", [26, 23])
    save(tmp_path / "aachen/a_0_gtFine_instanceIds.png", [26001, 23])
    image = image_file("aachen/a_0_leftImg8bit.png", 2)
    for label_names, expected in (("cityscapes", [26, 23]), ("cityscapes:instances", [26001, 23])):
        ((_, labels),) = LabelFolder(tmp_path, label_names=label_names).segment([image], lambda share: None)
        assert labels.tolist() == [expected]
    ((_, error),) = LabelFolder(tmp_path).segment([image_file("b_leftImg8bit.png", 2)], lambda share: None)
    assert str(error) == (
        "no labels for 'b_leftImg8bit.png'; expected 'b_leftImg8bit.png.png' or 'b_leftImg8bit.png' or "
        f"'b_gtFine_labelIds.png' in '{tmp_path}'"
    )


# --- Tables that users have


TSV = (
    "id\traw_category\tcategory\tcount\tnyu40id\teigen13id\tnyuClass\tnyu40class\n"
    "1\twall\twall\t8277\t1\t12\twall\twall\n2\tchair\tchair\t4646\t5\t4\tchair\tchair\n"
    '1163\tobject 6" wide\tobject\t1\t40\t7\tobject\totherprop\n1357\toffice chair\tchair\t1\t5\t4\tchair\tchair\n'
)


def test_scannet_raw_ids_by_their_table(tmp_path):
    table = tmp_path / "scannetv2-labels.combined.tsv"
    table.write_text(TSV)
    values = [0, 1, 2, 1163, 1357]
    for label_names in (str(table), f"{table}:raw"):
        labels, label_set = read(tmp_path / "maps", values, label_names)
        assert labels == values
        assert names(label_set) == {1: "wall", 2: "chair", 1163: 'object 6" wide', 1357: "office chair"}
    labels, label_set = read(tmp_path / "maps", values, f"{table}:nyu40")
    assert labels == [0, 1, 5, 40, 5]
    assert names(label_set) == {1: "wall", 5: "chair", 40: "otherprop"}


def panoptic(folder: Path) -> Path:
    path = folder / "panoptic.json"
    segments = [{"id": 3_226_956, "category_id": 1}, {"id": 300, "category_id": 187}, {"id": 301, "category_id": 1}]
    content = {
        "categories": [
            {"id": 1, "name": "person", "isthing": 1},
            {"id": 187, "name": "sky-other-merged", "isthing": 0},
        ],
        "annotations": [{"image_id": 7, "file_name": "a.png", "segments_info": segments}],
    }
    path.write_text(json.dumps(content))
    return path


def test_panoptic_maps_of_coco_with_their_segments(tmp_path):
    path = panoptic(tmp_path)
    save_segments(tmp_path / "maps.png", [0, 3_226_956, 300, 301])
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps.png").rename(tmp_path / "maps/a.png")
    maps = LabelFolder(tmp_path / "maps", label_names=str(path))
    assert maps.read("a.jpg").tolist() == [[0, 1, 187, 1]]
    assert maps.label_set.ids("person,sky", "--ignore-labels") == (1, 187)


def test_the_folder_says_how_its_maps_are_written(tmp_path):
    (tmp_path / "labels.json").write_text('{"names": "cityscapes-train", "labels": [{"id": 26, "name": "auto"}]}')
    labels, label_set = read(tmp_path, [0, 13, 255], "")
    assert labels == [7, 26, 0]
    assert label_set.ids("road,auto", "--ignore-labels") == (7, 26)
    assert read(tmp_path, [7, 26], "cityscapes")[0] == [7, 26]  # the option wins
    panoptic(tmp_path)
    (tmp_path / "labels.json").write_text('{"names": "panoptic.json"}')
    save_segments(tmp_path / "a.png", [300])
    assert LabelFolder(tmp_path).read("a.jpg").tolist() == [[187]]


# --- What is wrong


@pytest.mark.parametrize(
    ("label_names", "expected"),
    [
        ("cityscape", "--label-names 'cityscape' is unknown; did you mean 'cityscapes'? known: nyu40, ade20k, coco, "),
        ("kitti360:instance", "--label-names 'kitti360:instance': expected 'kitti360' or 'kitti360:instances'"),
        ("nyu40:instances", "--label-names 'nyu40:instances': expected 'nyu40'"),
        ("gone.tsv", "--label-names 'gone.tsv' cannot be read (No such file or directory); check the name"),
        ("gone.json", "--label-names 'gone.json' cannot be read (No such file or directory); check the name"),
        ("gone.tsv:nyu", "--label-names 'gone.tsv:nyu': expected 'gone.tsv', or 'gone.tsv:nyu40' to merge into NYU40"),
    ],
)
def test_choices_that_are_none(tmp_path, label_names, expected):
    with pytest.raises(SGAMError) as error:
        LabelFolder(tmp_path, label_names=label_names)
    assert str(error.value).startswith(expected)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        (
            "a.tsv",
            "id\tname\n1\twall\n",
            "(KeyError: 'raw_category'); expected ScanNet's scannetv2-labels.combined.tsv with",
        ),
        ("a.tsv", "id\traw_category\nx\twall\n", "(ValueError: "),
        ("a.json", "{", "; expected the JSON of COCO's panoptic maps, with annotations (file_name, segments_info) and"),
        ("a.json", '{"annotations": []}', "(KeyError: 'categories'); expected the JSON of COCO's panoptic maps"),
        ("a.json", "[1]", "(TypeError: "),
    ],
)
def test_files_that_are_no_tables(tmp_path, name, content, expected):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError) as error:
        find_table(str(path))
    assert str(error.value).startswith(f"--label-names '{path}' cannot be used (")
    assert expected in str(error.value)


def test_ids_that_a_table_does_not_have(tmp_path):
    with pytest.raises(InputError) as error:
        read(tmp_path, [7, 90], "cityscapes")
    assert str(error.value) == (
        f"label map '{tmp_path}/a.png' holds 90, which 'cityscapes' does not know; choose the --label-names that the "
        "maps are written in: nyu40, ade20k, coco, coco-stuff, seem, cityscapes, cityscapes-train, kitti360, or a file"
    )


def test_segments_and_maps_that_are_not_of_the_json(tmp_path):
    path = panoptic(tmp_path)
    maps = LabelFolder(tmp_path, label_names=str(path))
    save_segments(tmp_path / "a.png", [5])
    with pytest.raises(InputError, match=r"holds 5, which '.*panoptic\.json' does not know"):
        maps.read("a.jpg")
    save_segments(tmp_path / "b.png", [300])
    with pytest.raises(InputError) as error:
        maps.read("b.jpg")
    assert str(error.value) == f"'b.png' is not in '{path}'; give the JSON that belongs to these maps"
    save(tmp_path / "a.png", [1])
    with pytest.raises(
        InputError, match=r"has one channel \(mode L\); expected a panoptic PNG .* leave --label-names out"
    ):
        maps.read("a.jpg")
    save_segments(tmp_path / "a.png", [300])
    with pytest.raises(InputError, match="name the JSON of panoptic maps by --label-names"):
        LabelFolder(tmp_path).read("a.jpg")
