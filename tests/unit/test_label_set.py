"""labels.json: names and ids of labels, and what is wrong with it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sgam_core.errors import InputError, OptionError
from sgam_sfm.images import ImageFile
from sgam_sfm.label_set import Label, LabelSet, at_size_of, read_label_set

NAMED = LabelSet(labels=(Label(id=3, name="Sky"), Label(id=12, name="traffic light"), Label(id=7)))


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [("", ()), ("sky", (3,)), ("SKY, traffic light", (3, 12)), ("7,sky,", (7, 3))],
)
def test_names_and_ids_become_ids(wanted, expected):
    assert NAMED.ids(wanted, "--ignore-labels") == expected


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(OptionError) as error:
        NAMED.ids("skye", "--ignore-labels")
    assert str(error.value) == "--ignore-labels 'skye' is no label; did you mean 'sky'? known: sky, traffic light"


def test_names_for_labels_that_have_none():
    nameless = replace(NAMED, segmenter="coseg", labels=(Label(id=1), Label(id=14)))
    with pytest.raises(OptionError) as error:
        nameless.ids("sky", "--mask-matches")
    assert str(error.value) == (
        "--mask-matches 'sky': labels of 'coseg' have no names; give ids from 1 to 14, "
        "or take a --segmenter that names them, like ade20k"
    )
    with pytest.raises(OptionError, match=r"have no names; give ids, or --label-names what they are$"):
        LabelSet().ids("sky", "--mask-matches")


def test_numbers_that_no_label_has_and_lists_without_commas():
    with pytest.raises(OptionError) as error:
        NAMED.ids("99", "--mask-matches")
    assert str(error.value) == "--mask-matches '99' is no label; ids are from 3 to 12, see labels.json"
    with pytest.raises(OptionError) as error:
        NAMED.ids("3 7", "--ignore-labels")
    assert str(error.value) == "--ignore-labels '3 7': separate labels by commas, '3,7'"
    assert LabelSet().ids("99", "--mask-matches") == (99,)  # nothing is known of these labels


def test_a_folder_without_a_record_says_nothing(tmp_path):
    assert read_label_set(tmp_path) == LabelSet()


def test_a_record_written_by_hand_needs_only_its_labels(tmp_path):
    (tmp_path / "labels.json").write_text('{"labels": [{"id": 3, "name": "sky"}]}')
    assert read_label_set(tmp_path).ids("sky", "--ignore-labels") == (3,)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("[1, 2]", "cannot be used (Input should be an object); expected {"),
        ('{"labels": [{"name": "sky"}]}', "cannot be used (labels.0.id: Field required); expected {"),
        ("{", "expected {"),
        ('{"version": 2}', "has version 2; this sgam-sfm reads version 1"),
        ('{"void": 255}', "has void 255; expected 0: export the maps with 0 where it is unknown"),
    ],
)
def test_a_record_that_cannot_be_used(tmp_path, content, expected):
    path = tmp_path / "labels.json"
    path.write_text(content)
    with pytest.raises(InputError) as error:
        read_label_set(tmp_path)
    assert str(error.value).startswith(f"'{path}' ")
    assert expected in str(error.value)
    assert json.dumps(str(error.value)).count("\\n") == 0


def test_a_map_at_the_size_of_its_image_has_its_ids_only(tmp_path):
    labels = np.arange(12, dtype=np.int32).reshape(3, 4) * 5000
    image = ImageFile(name="a.jpg", path=tmp_path, width=8, height=6, digest="")
    np.testing.assert_array_equal(at_size_of(image, labels), np.kron(labels, np.ones((2, 2), np.int32)))
    assert at_size_of(replace(image, width=4, height=3), labels) is labels
