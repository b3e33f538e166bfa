"""`sgam-sfm match --database`: what an existing database holds stays as it is, ours comes after it."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest

from sgam_core.errors import InputError, OptionError, ShapeError
from sgam_sfm import MatchOptions, match_collection
from sgam_sfm.colmap.appending import append_to_database, replace_database, require_no_descriptors, stamp_of
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.colmap.reading import database_content, read_database
from sgam_sfm.comparison.options import CompareOptions
from tests.arc import ARC, CAMERA, CX, CY, FOCAL, ArcMatcher, write_arc

NAMES = tuple(ARC)[:4]  # a.png .. d.png
THERE = np.array([[1, 2, 3, 0.5], [4, 5, 6, 0.25], [7, 8, 9, 0]], np.float32)  # x, y, scale, orientation
OURS = {name: np.array([[10.5, 20], [30, 40.25]], np.float32) for name in NAMES[:3]}
MATCHES = {(NAMES[1], NAMES[0]): np.array([[0, 1], [1, 0]]), (NAMES[1], NAMES[2]): np.array([[1, 1]])}


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> Path:
    return write_arc(tmp_path_factory.mktemp("arc"))


@pytest.fixture
def existing(images: Path, tmp_path: Path) -> Path:
    """A database of a, b and c: three keypoints in each, matches and geometry of a - b and a - c."""
    path = tmp_path / "existing.db"
    options = CameraOptions(model="PINHOLE", params=(FOCAL, FOCAL, CX, CY), mode="single")
    import_cameras(path, images / "images", NAMES[:3], options)
    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            database.write_keypoints(image.image_id, THERE)
        for other in (2, 3):
            rows = np.array([[0, 0], [2, 1]], np.uint32)
            database.write_matches(1, other, rows)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config, geometry.F, geometry.inlier_matches = 3, np.eye(3), rows
            database.write_two_view_geometry(1, other, geometry)
    return path


def with_descriptors(path: Path, name: str) -> None:
    with pycolmap.Database.open(path) as database:
        descriptors = pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.SIFT, data=np.zeros((len(THERE), 128), np.uint8)
        )
        database.write_descriptors(database.read_image_with_name(name).image_id, descriptors)


def test_ours_follow_what_is_there(existing, tmp_path):
    path = tmp_path / "made.db"
    before = read_database(existing)
    append_to_database(path, existing, OURS, MATCHES)
    made = read_database(path)
    a, b, c = NAMES[:3]
    for name in (a, b, c):
        np.testing.assert_array_equal(made["keypoints"][name][:3], THERE)
        np.testing.assert_array_equal(made["keypoints"][name][3:, :2], OURS[name])
        np.testing.assert_array_equal(made["keypoints"][name][3:, 2:], [[1, 0]] * 2)  # scale 1, upright
    np.testing.assert_array_equal(made["matches"][a, b], [[0, 0], [2, 1], [4, 3], [3, 4]])
    np.testing.assert_array_equal(made["matches"][b, c], [[4, 4]])
    assert set(made["two_view_geometries"]) == {(a, c)}  # a - b is to be verified again
    for table in ("matches", "two_view_geometries"):
        assert str(made[table][a, c]) == str(before[table][a, c])
    assert database_content(existing) == database_content(existing)


def test_doing_it_twice_adds_nothing(existing, tmp_path):
    path, again = tmp_path / "made.db", tmp_path / "again.db"
    append_to_database(path, existing, OURS, MATCHES)
    append_to_database(again, path, OURS, MATCHES)
    assert database_content(again) == database_content(path)


def test_a_keypoint_of_six_numbers_has_the_identity_as_its_shape(existing, tmp_path):
    with pycolmap.Database.open(existing) as database:
        database.update_keypoints(1, np.ones((3, 6), np.float32))
        database.update_keypoints(2, np.ones((3, 3), np.float32))
    append_to_database(tmp_path / "made.db", existing, {NAMES[0]: OURS[NAMES[0]]}, {})
    made = read_database(tmp_path / "made.db")["keypoints"][NAMES[0]]
    np.testing.assert_array_equal(made[3:], [[10.5, 20, 1, 0, 0, 1], [30, 40.25, 1, 0, 0, 1]])
    with pytest.raises(InputError) as error:
        append_to_database(tmp_path / "odd.db", existing, OURS, {})
    assert str(error.value) == (
        "keypoints of 'b.png' have 3 columns in the database; COLMAP knows 2, 4 and 6: make it anew"
    )
    assert not (tmp_path / "odd.db").exists()


def test_wrong_arrays_change_nothing(existing):
    before = database_content(existing)
    with pytest.raises(ShapeError, match=r"name keypoint 7 of 'a\.png', which has 2"):
        append_to_database(existing, existing, OURS, MATCHES | {(NAMES[0], NAMES[2]): np.array([[7, 0]])})
    assert database_content(existing) == before


def test_descriptors_are_refused(existing):
    with_descriptors(existing, NAMES[1])
    with pytest.raises(InputError) as error:
        require_no_descriptors(existing, existing, NAMES)
    assert str(error.value).startswith(f"1 images, such as 'b.png', have descriptors in --database '{existing}'; ours")
    assert "pass --append" in str(error.value)
    require_no_descriptors(existing, existing, (NAMES[0], NAMES[3]))


def test_a_database_of_a_newer_colmap_is_refused(existing, tmp_path):
    with closing(sqlite3.connect(existing)) as database:
        database.execute("PRAGMA user_version = 99000000")
    with pytest.raises(InputError) as error:
        stamp_of(existing)
    message = str(error.value)
    assert message.startswith(f"--database '{existing}' was made by a newer COLMAP (its version number is 99000000, ")
    assert message.endswith("; upgrade pycolmap")
    (tmp_path / "text.db").write_text("no database" * 1000)
    with pytest.raises(InputError, match=r"text.db' is not a COLMAP database \(file is not a database\)"):
        stamp_of(tmp_path / "text.db")
    with pytest.raises(InputError, match=r"none.db' does not exist; give a COLMAP database, or leave --database out"):
        stamp_of(tmp_path / "none.db")


def test_what_another_program_wrote_meanwhile_is_kept(existing, tmp_path):
    before = stamp_of(existing)
    append_to_database(tmp_path / "made.db", existing, OURS, MATCHES)
    with closing(sqlite3.connect(existing)) as database:
        database.execute("UPDATE images SET name = 'renamed.png' WHERE name = 'c.png'")
        database.commit()
    with pytest.raises(InputError, match="another program has written to --database"):
        replace_database(existing, tmp_path / "made.db", before)
    assert "renamed.png" in read_database(existing)["images"]


def test_cameras_of_the_database_stay(images, existing, tmp_path):
    cameras = tmp_path / "cameras.db"
    known = import_cameras(cameras, images / "images", NAMES, CameraOptions(database=existing)).cameras
    assert [known[name].model for name in NAMES] == ["PINHOLE"] * 3 + ["SIMPLE_RADIAL"]
    assert known[NAMES[0]].camera_id == known[NAMES[2]].camera_id != known[NAMES[3]].camera_id
    another = tmp_path / "cameras.txt"
    another.write_text("a.png PINHOLE 640 480 500 500 320 240\n")
    with pytest.raises(InputError) as error:
        import_cameras(cameras, images / "images", NAMES, CameraOptions(database=existing, cameras=another))
    assert str(error.value) == (
        f"the camera of 'a.png' is PINHOLE 520.0,520.0,331.0,229.5 in {existing}, but PINHOLE 500.0,500.0,320.0,240.0 "
        "was given; leave out --cameras or --camera-params for images that the database has"
    )


@pytest.fixture
def options(images: Path, existing: Path, tmp_path: Path) -> MatchOptions:
    (tmp_path / "cameras.txt").write_text(f"* {CAMERA}\n")
    (tmp_path / "pairs.txt").write_text("a.png b.png\nb.png c.png\nc.png d.png\n")
    return MatchOptions(
        images=images / "images",
        pairs=tmp_path / "pairs.txt",
        cameras=tmp_path / "cameras.txt",
        output=tmp_path / "out",
        database=existing,
        area_matcher="none",
        threads=1,
    )


def test_a_run_writes_into_a_database(options):
    before = read_database(options.database)
    summary = match_collection(options, point_matcher=ArcMatcher(ARC))
    assert summary["models"][0]["registered"] == 4
    assert summary["pairs"]["verified"] == 3  # of ours
    made = read_database(options.database)
    assert database_content(options.database) == database_content(options.output / "database.db")
    a, b, c, d = NAMES
    assert made["images"].keys() == set(ARC)  # all of the folder, as in OUT/database.db
    assert {name: made["images"][name] for name in (a, b, c)} == before["images"]
    np.testing.assert_array_equal(made["keypoints"][b][:3], THERE)
    assert len(made["keypoints"][b]) > 200
    np.testing.assert_array_equal(made["matches"][a, b][:2], before["matches"][a, b])
    assert made["matches"][a, b][2:].min() >= 3
    assert str(made["two_view_geometries"][a, c]) == str(before["two_view_geometries"][a, c])
    assert set(made["two_view_geometries"]) == {(a, b), (a, c), (b, c), (c, d)}
    content = database_content(options.database)
    match_collection(replace(options, mapping=False), point_matcher=ArcMatcher(ARC))
    assert database_content(options.database) == content


def test_what_cannot_be_written_into_is_refused_before_matching(images, options, existing, tmp_path):
    with_descriptors(existing, NAMES[1])
    before = existing.read_bytes()
    with pytest.raises(InputError, match="pass --append"):
        match_collection(options, point_matcher=ArcMatcher(ARC))
    other = Path(shutil.copytree(images / "images", tmp_path / "images"))
    PIL.Image.new("RGB", (320, 240)).save(other / NAMES[0])
    with pytest.raises(InputError, match=r"'a\.png' is 640x480 in --database '.*' but 320x240"):
        match_collection(replace(options, images=other, cameras=None))
    own = replace(options, output=tmp_path, database=Path(shutil.copy(existing, tmp_path / "database.db")))
    with pytest.raises(OptionError, match="is what the run writes itself; leave it out"):
        match_collection(own)
    assert existing.read_bytes() == before
    with pytest.raises(OptionError, match="--database and --append are for `sgam-sfm match`; compare makes its own"):
        CompareOptions(images=images, output=tmp_path, methods=("sift",), database=existing)
