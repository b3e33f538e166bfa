"""Our HDF5 files as hloc reads them."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from sgam_core.errors import InputError, ShapeError
from sgam_sfm.hloc_files import (
    read_global_descriptors,
    read_match_counts_h5,
    write_keypoints_h5,
    write_matches_h5,
)


def hloc_keypoints(path, name):
    """What hloc.utils.io.get_keypoints does."""
    with h5py.File(path, "r", libver="latest") as file:
        return file[name]["keypoints"].__array__()


def hloc_matches(path, name0, name1):
    """What hloc.utils.io.get_matches does."""
    with h5py.File(path, "r", libver="latest") as file:
        names = [name.replace("/", "-") for name in (name0, name1)]
        reverse = "/".join(names) not in file
        group = file["/".join(reversed(names) if reverse else names)]
        matches, scores = group["matches0"].__array__(), group["matching_scores0"].__array__()
    index = np.where(matches != -1)[0]
    pairs = np.stack([index, matches[index]], -1)
    return (np.flip(pairs, -1) if reverse else pairs), scores[index]


def test_keypoints_have_their_origin_at_the_first_pixel_centre(tmp_path):
    path = tmp_path / "keypoints.h5"
    write_keypoints_h5(path, {"sub/a.jpg": np.array([[0.5, 0.5], [10.25, 3.0]]), "b.jpg": np.zeros((0, 2))})
    read = hloc_keypoints(path, "sub/a.jpg")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, [[0, 0], [9.75, 2.5]])
    assert hloc_keypoints(path, "b.jpg").shape == (0, 2)


def test_matches_read_back_in_both_directions(tmp_path):
    path = tmp_path / "matches.h5"
    pairs = {
        ("sub/a.jpg", "b.jpg"): np.array([[4, 0], [1, 2]], np.uint32),
        ("b.jpg", "c.jpg"): np.zeros((0, 2), np.uint32),
    }
    scores = {("sub/a.jpg", "b.jpg"): np.array([0.5, 1.0], np.float32), ("b.jpg", "c.jpg"): np.zeros(0, np.float32)}
    write_matches_h5(path, pairs, scores, {"sub/a.jpg": 5, "b.jpg": 3, "c.jpg": 0})
    matches, values = hloc_matches(path, "sub/a.jpg", "b.jpg")
    np.testing.assert_array_equal(matches, [[1, 2], [4, 0]])
    np.testing.assert_array_equal(values, [1.0, 0.5])
    np.testing.assert_array_equal(hloc_matches(path, "b.jpg", "sub/a.jpg")[0], [[2, 1], [0, 4]])
    assert len(hloc_matches(path, "b.jpg", "c.jpg")[0]) == 0
    with h5py.File(path) as file:
        assert file["sub-a.jpg/b.jpg/matches0"].dtype == np.int32
        assert file["sub-a.jpg/b.jpg/matches0"].shape == (5,)
        assert file["sub-a.jpg/b.jpg/matching_scores0"].dtype == np.float16


def test_names_that_hloc_cannot_tell_apart_leave_the_file_out(tmp_path, caplog):
    path = tmp_path / "matches.h5"
    path.write_bytes(b"of an earlier run")
    one = np.zeros((0, 2), np.uint32)
    matches = {("a/b.jpg", "c.jpg"): one, ("a-b.jpg", "c.jpg"): one}
    write_matches_h5(path, matches, dict.fromkeys(matches, np.zeros(0)), {})
    assert caplog.messages == [
        "matches.h5 is left out: images 'a-b.jpg' and 'a/b.jpg' are both 'a-b.jpg' in hloc's matches file, which "
        "writes '/' as '-'; rename one of them if you need it (the database is whole)"
    ]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("indices", "message"),
    [
        ([[0, 3]], "point beyond its 2 and 3 keypoints"),
        ([[2, 0]], "point beyond its 2 and 3 keypoints"),
        ([[0, 1], [0, 2]], "use a keypoint of 'a' twice"),
    ],
)
def test_a_failed_write_leaves_the_old_file(tmp_path, indices, message):
    path = tmp_path / "m.h5"
    path.write_bytes(b"old")
    matches = {("a", "b"): np.array(indices)}
    with pytest.raises(ShapeError, match=message):
        write_matches_h5(path, matches, {("a", "b"): np.ones(len(indices))}, {"a": 2, "b": 3})
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_keypoints_of_another_shape(tmp_path):
    with pytest.raises(ShapeError, match=r"keypoints of 'a' have shape \(4, 3\); expected \(N, 2\)"):
        write_keypoints_h5(tmp_path / "k.h5", {"a": np.zeros((4, 3))})


def descriptors_file(path, vectors):
    """As hloc.extract_features writes it: a group an image, nested where its name has a folder."""
    with h5py.File(path, "w", libver="latest") as file:
        for name, vector in vectors.items():
            file.create_group(name).create_dataset("global_descriptor", data=np.asarray(vector, np.float16))
    return path


def test_global_descriptors_are_found_in_folders_too(tmp_path):
    path = descriptors_file(tmp_path / "feats.h5", {"sub/deep/a.jpg": [1, 2], "b.jpg": [3, 4], "other.jpg": [5, 6]})
    found = read_global_descriptors(path, ["b.jpg", "none.jpg", "sub", "sub/deep/a.jpg"])
    assert {name: vector.tolist() for name, vector in found.items()} == {"b.jpg": [3, 4], "sub/deep/a.jpg": [1, 2]}


@pytest.mark.parametrize(
    ("vectors", "message"),
    [
        ({"a.jpg": [1, 2], "b.jpg": [1]}, "descriptor of 'b.jpg' in '{}' has 1 numbers; expected 2, as the others"),
        (
            {"a.jpg": [1, np.nan]},
            "descriptor of 'a.jpg' in '{}' has 2 numbers; expected 2, as the others, none of them",
        ),
        (
            {"images/a.jpg": [1]},
            "'{}' has a data set '<image name>/global_descriptor' for none of the 2 images (it holds 'images', the "
            "images are like 'a.jpg'); names are relative to the image folder",
        ),
    ],
)
def test_wrong_descriptors_are_named(tmp_path, vectors, message):
    path = descriptors_file(tmp_path / "feats.h5", vectors)
    with pytest.raises(InputError) as error:
        read_global_descriptors(path, ["a.jpg", "b.jpg"])
    assert str(error.value).startswith(message.format(path))


@pytest.mark.parametrize("read", [read_global_descriptors, read_match_counts_h5])
def test_a_file_that_is_no_h5_is_named(tmp_path, read):
    path = tmp_path / "x.h5"
    with pytest.raises(InputError, match=r"there is no file '.*x\.h5'; give an h5 file of hloc"):
        read(path, ["a.jpg"])
    path.write_bytes(b"\x89HDF\r\n\x1a\n and then nothing")
    with pytest.raises(InputError, match=r"'.*x\.h5' cannot be read as an h5 file of hloc"):
        read(path, ["a.jpg"])


def test_pairs_of_a_matches_file_come_back_with_their_counts(tmp_path):
    path, names = tmp_path / "matches.h5", ("a.jpg", "sub/b.jpg", "c.jpg")
    matches = {(names[0], names[1]): np.array([[0, 0], [1, 2]]), (names[2], names[1]): np.zeros((0, 2), int)}
    write_matches_h5(
        path, matches, {pair: np.ones(len(rows)) for pair, rows in matches.items()}, dict.fromkeys(names, 3)
    )
    assert read_match_counts_h5(path, names) == {("a.jpg", "sub/b.jpg"): 2, ("c.jpg", "sub/b.jpg"): 0}
    assert read_match_counts_h5(path, names[:2]) == {("a.jpg", "sub/b.jpg"): 2}
    with pytest.raises(InputError, match=r"of no pair of the 1 images \(it holds 'c\.jpg/sub-b\.jpg'\)"):
        read_match_counts_h5(path, ["sub/c.jpg"])
    with pytest.raises(InputError, match=r"'sub-b\.jpg' and 'sub/b\.jpg' are both 'sub-b\.jpg' in"):
        read_match_counts_h5(path, ["sub/b.jpg", "sub-b.jpg"])
