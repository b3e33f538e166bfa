"""COLMAP databases: cameras come in as they are, keypoints and matches come out as they went in."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from sgam_core.errors import InputError, OptionError, ShapeError
from sgam_sfm.colmap.camera_files import read_cameras
from sgam_sfm.colmap.cameras import CameraInfo, camera_matrix
from sgam_sfm.colmap.database import write_database
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.colmap.reading import database_content, read_database


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Images of 64x48: one with a focal length of 28 mm (35 mm film) in EXIF, one upright by EXIF, one in a folder."""
    images = tmp_path / "images"
    (images / "sub").mkdir(parents=True)
    exif = PIL.Image.Exif()
    exif[0x010F] = "Maker"
    exif[0x0110] = "Model"
    exif.get_ifd(0x8769)[0xA405] = 28
    turned = PIL.Image.Exif()
    turned[0x0112] = 6
    for name, details in {"a.jpg": exif, "b.jpg": turned, "sub/c.jpg": None, "z.jpg": None}.items():
        PIL.Image.new("RGB", (64, 48)).save(images / name, **({"exif": details} if details else {}))
    return images


NAMES = ("z.jpg", "sub/c.jpg", "b.jpg", "a.jpg")


def test_images_as_colmap_sees_them(tmp_path, folder):
    imported = import_cameras(tmp_path / "database.db", folder, NAMES)
    assert imported.failures == {}
    assert [imported.cameras[name].image_id for name in sorted(NAMES)] == [1, 2, 3, 4]
    a, b = imported.cameras["a.jpg"], imported.cameras["b.jpg"]
    # COLMAP: focal length in pixels = 28 mm / diagonal of 35 mm film (43.27 mm) * diagonal of the image (80 px).
    assert a.params == pytest.approx((51.77, 32, 24, 0), abs=0.01)
    assert (a.has_prior_focal, a.known) == (True, False)
    assert b.params == pytest.approx((1.2 * 64, 32, 24, 0))
    assert (b.width, b.height, b.has_prior_focal) == (64, 48, False)  # EXIF orientation is not applied
    assert imported.known_camera_ids == ()


def test_import_replaces_an_older_database_and_does_not_depend_on_the_order_of_names(tmp_path, folder):
    path, again = tmp_path / "database.db", tmp_path / "again.db"
    import_cameras(path, folder, NAMES, CameraOptions(mode="single", params="50,32,24,0"))
    import_cameras(path, folder, NAMES)
    import_cameras(again, folder, NAMES[::-1])
    assert database_content(path) == database_content(again)


def test_images_that_colmap_cannot_use_are_failures_with_a_reason(tmp_path, folder):
    PIL.Image.new("RGB", (64, 48)).save(folder / "w.webp")
    PIL.Image.new("RGB", (80, 60)).save(folder / "big.jpg")
    (folder / "empty.jpg").write_bytes(b"")
    names = (*NAMES, "w.webp", "empty.jpg", "missing.jpg")
    cannot = "COLMAP cannot read this file; save the image as JPEG or PNG"
    imported = import_cameras(tmp_path / "database.db", folder, names)
    assert imported.failures == {"empty.jpg": cannot, "missing.jpg": cannot, "w.webp": cannot}
    assert set(imported.cameras) == set(NAMES)
    imported = import_cameras(tmp_path / "database.db", folder, (*NAMES, "big.jpg"), CameraOptions(mode="single"))
    assert imported.failures == {
        "big.jpg": "it is 80x60 (width x height), another size than the images it would share a camera with; use "
        "--camera-mode auto or per-image"
    }


def test_nothing_is_printed_about_failures(tmp_path, folder, capfd):
    import_cameras(tmp_path / "database.db", folder, (*NAMES, "missing.jpg"))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("mode", "shared"),
    [
        ("single", [{"a.jpg", "b.jpg", "sub/c.jpg", "z.jpg"}]),
        ("per-folder", [{"a.jpg", "b.jpg", "z.jpg"}, {"sub/c.jpg"}]),
    ],
)
def test_camera_modes(tmp_path, folder, mode, shared):
    cameras = import_cameras(tmp_path / "database.db", folder, NAMES, CameraOptions(mode=mode)).cameras
    groups: dict[int, set[str]] = {}
    for name, info in cameras.items():
        groups.setdefault(info.camera_id, set()).add(name)
    assert list(groups.values()) == shared


def test_given_parameters_hold_for_all_images(tmp_path, folder):
    options = CameraOptions(model="PINHOLE", params="50.1,51,31.5,24.25", mode="single")
    imported = import_cameras(tmp_path / "database.db", folder, NAMES, options)
    assert imported.known_camera_ids == (1,)
    info = imported.cameras["a.jpg"]
    assert (info.model, info.params, info.has_prior_focal) == ("PINHOLE", (50.1, 51.0, 31.5, 24.25), True)
    np.testing.assert_array_equal(camera_matrix(info), [[50.1, 0, 31.5], [0, 51, 24.25], [0, 0, 1]])


def test_camera_matrix_needs_a_known_focal_length_and_something_like_a_pinhole():
    def info(model, params, has_prior_focal=True):
        return CameraInfo(
            image_id=1,
            camera_id=1,
            model=model,
            params=params,
            width=64,
            height=48,
            has_prior_focal=has_prior_focal,
            known=False,
        )

    np.testing.assert_array_equal(
        camera_matrix(info("SIMPLE_RADIAL", (50.0, 32.0, 24.0, 0.1))), [[50, 0, 32], [0, 50, 24], [0, 0, 1]]
    )
    assert camera_matrix(info("SIMPLE_RADIAL", (50.0, 32.0, 24.0, 0.1), has_prior_focal=False)) is None
    assert camera_matrix(info("SIMPLE_RADIAL_FISHEYE", (50.0, 32.0, 24.0, 0.1))) is None
    assert camera_matrix(info("EQUIRECTANGULAR", (64.0, 48.0))) is None


def test_listed_cameras(tmp_path, folder):
    (folder / "my photo.jpg").write_bytes((folder / "z.jpg").read_bytes())
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(
        "# name model width height params\r\n\r\n* PINHOLE 64 48 50 50 32 24\r\n"
        "a.jpg SIMPLE_RADIAL 64 48 55.5 32 24 0.01\nmy photo.jpg\tPINHOLE 64 48 60 60 32 24\n"
    )
    options = CameraOptions(cameras=cameras)
    imported = import_cameras(tmp_path / "database.db", folder, (*NAMES, "my photo.jpg"), options)
    assert imported.cameras["a.jpg"].params == (55.5, 32.0, 24.0, 0.01)  # not what EXIF says
    assert imported.cameras["my photo.jpg"].params == (60.0, 60.0, 32.0, 24.0)
    others = [imported.cameras[name] for name in ("b.jpg", "sub/c.jpg", "z.jpg")]
    assert len({info.camera_id for info in others}) == 1
    assert all(info.has_prior_focal and info.known for info in imported.cameras.values())
    assert len(imported.known_camera_ids) == 3


def test_images_without_a_listed_camera_follow_the_other_options(tmp_path, folder):
    cameras = tmp_path / "cameras.txt"
    cameras.write_text("b.jpg PINHOLE 64 48 50 50 32 24\n")
    imported = import_cameras(tmp_path / "database.db", folder, NAMES, CameraOptions(cameras=cameras))
    assert imported.known_camera_ids == (imported.cameras["b.jpg"].camera_id,)
    assert imported.cameras["a.jpg"].model == "SIMPLE_RADIAL"


def test_cameras_of_a_colmap_model(tmp_path, folder, caplog):
    model = tmp_path / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("7 PINHOLE 64 48 50 51 32 24\n")
    (model / "images.txt").write_text(
        "1 1 0 0 0 0 0 0 7 a.jpg\n\n2 1 0 0 0 0 0 0 7 sub/c.jpg\n\n3 1 0 0 0 0 0 0 7 other.jpg\n\n"
    )
    with pytest.raises(InputError, match=r"cannot be read as a COLMAP model .*; it needs cameras, images and points3D"):
        read_cameras(model, NAMES)
    (model / "points3D.txt").write_text("")
    cameras = read_cameras(model, NAMES)
    assert set(cameras) == {"a.jpg", "sub/c.jpg"}
    assert cameras["a.jpg"].params == (50.0, 51.0, 32.0, 24.0)
    assert "names 1 images that are not in the collection, such as 'other.jpg'" in caplog.text
    imported = import_cameras(tmp_path / "database.db", folder, NAMES, CameraOptions(cameras=model))
    assert imported.cameras["a.jpg"].camera_id == imported.cameras["sub/c.jpg"].camera_id


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("a.jpg PINHOLE 64 48 50 50 32", "has 4 parameters (fx, fy, cx, cy) but 3 were given: '50,50,32'"),
        ("a.jpg PINHOL 64 48 50 50 32 24", "camera model 'PINHOL' is unknown; did you mean 'PINHOLE'? known: "),
        ("a.jpg PINHOLE 64 48 50 x 32 24", "are not all numbers"),
        ("a.jpg PINHOLE 64", "line 2: expected 'name MODEL width height params...'"),
        ("* PINHOLE 64 48 50 50 32 24", "line 2: '*' has a camera already"),
    ],
)
def test_bad_lines_of_a_camera_file(tmp_path, line, message):
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(f"* PINHOLE 64 48 50 50 32 24\n{line}\n")
    with pytest.raises(InputError) as error:
        read_cameras(cameras, NAMES)
    assert message in str(error.value)


def test_camera_files_without_use(tmp_path):
    cameras = tmp_path / "cameras.txt"
    with pytest.raises(InputError, match=r"cannot read the cameras in .*cameras\.txt: No such file"):
        read_cameras(cameras, NAMES)
    cameras.write_text("other.jpg PINHOLE 64 48 50 50 32 24\n")
    with pytest.raises(InputError, match="has no camera for any of the 4 images"):
        read_cameras(cameras, NAMES)


@pytest.mark.parametrize("name", ["*", "a.jpg"])
def test_known_camera_of_another_size(tmp_path, folder, name):
    PIL.Image.new("RGB", (80, 60)).save(folder / "a.jpg")
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(f"{name} PINHOLE 64 48 50 50 32 24\n")
    with pytest.raises(InputError) as error:
        import_cameras(tmp_path / "database.db", folder, NAMES, CameraOptions(cameras=cameras))
    assert str(error.value) == (
        f"the camera of 'a.jpg' in {cameras} is 64x48 but the image is 80x60 (width x height); give the camera of the "
        "image as it is"
    )
    assert not (tmp_path / "database.db").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "folder"}, "camera mode 'folder' is unknown; did you mean 'per-folder'? known: auto, single,"),
        ({"model": "pinhole"}, "camera model 'pinhole' is unknown; did you mean 'PINHOLE'? known: SIMPLE_PINHOLE,"),
        (
            {"params": "50,32,24"},
            "camera model SIMPLE_RADIAL has 4 parameters (f, cx, cy, k) but 3 were given: '50,32,24'",
        ),
        (
            {"params": (50, 32, 24, float("nan"))},
            "camera parameters '50,32,24,nan' of SIMPLE_RADIAL (f, cx, cy, k) are",
        ),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(OptionError) as error:
        CameraOptions(**options)
    assert str(error.value).startswith(message)


KEYPOINTS = {
    "a.jpg": np.array([[0.5, 0.5], [1.25, 2], [3, 4]], np.float32),
    "b.jpg": np.array([[5, 6], [7.5, 8]], np.float32),
    "z.jpg": np.array([[9, 9]], np.float64),
}
MATCHES = {
    ("b.jpg", "a.jpg"): np.array([[0, 2], [1, 0]], np.uint32),
    ("a.jpg", "z.jpg"): np.array([[1, 0]], np.int64),
}


def test_what_is_written_is_read_back(tmp_path, folder):
    path = tmp_path / "database.db"
    imported = import_cameras(tmp_path / "cameras.db", folder, NAMES)
    write_database(path, tmp_path / "cameras.db", KEYPOINTS, MATCHES)
    content = read_database(path)
    assert {name: image["image_id"] for name, image in content["images"].items()} == {
        name: info.image_id for name, info in imported.cameras.items()
    }
    for name in NAMES:
        read = content["keypoints"][name]
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read, KEYPOINTS.get(name, np.zeros((0, 2))))
    assert set(content["matches"]) == {("a.jpg", "b.jpg"), ("a.jpg", "z.jpg")}
    np.testing.assert_array_equal(content["matches"]["a.jpg", "b.jpg"], [[2, 0], [0, 1]])
    assert content["two_view_geometries"] == {}


def test_content_does_not_depend_on_the_order_given_nor_on_what_was_there(tmp_path, folder):
    path, again = tmp_path / "database.db", tmp_path / "again.db"
    import_cameras(path, folder, NAMES)
    import_cameras(again, folder, NAMES)
    write_database(path, path, KEYPOINTS, MATCHES)
    write_database(again, again, {"a.jpg": np.ones((1, 2), np.float32)}, {})
    write_database(again, again, dict(reversed(KEYPOINTS.items())), dict(reversed(MATCHES.items())))
    assert database_content(path) == database_content(again)
    write_database(again, again, KEYPOINTS, {})
    assert database_content(path) != database_content(again)


@pytest.mark.parametrize(
    ("keypoints", "matches", "message"),
    [
        ({"a.jpg": np.zeros((2, 3), np.float32)}, {}, r"keypoints of 'a\.jpg' are float32 \(2, 3\); expected float32"),
        ({"a.jpg": np.full((2, 2), np.nan)}, {}, r"keypoints of 'a\.jpg' contain values that are not finite"),
        ({}, {("a.jpg", "b.jpg"): [[3, 0]]}, r"name keypoint 3 of 'a\.jpg', which has 3"),
        ({}, {("a.jpg", "b.jpg"): [[0, -1]]}, r"name keypoint -1 of 'b\.jpg', which has 2"),
        ({}, {("a.jpg", "sub/c.jpg"): [[0, 0]]}, r"name keypoint 0 of 'sub/c\.jpg', which has 0"),
        ({}, {("a.jpg", "b.jpg"): [[0, 0], [1, 0]]}, r"use a keypoint of 'b\.jpg' more than once; expected one-to-one"),
        ({}, {("a.jpg", "b.jpg"): [[0.0, 0.0]]}, r"are float64 \(1, 2\); expected uint32 \(M, 2\)"),
    ],
)
def test_arrays_that_colmap_would_choke_on(tmp_path, folder, keypoints, matches, message):
    path = tmp_path / "database.db"
    import_cameras(path, folder, NAMES)
    before = database_content(path)
    with pytest.raises(ShapeError, match=message):
        write_database(path, path, KEYPOINTS | keypoints, {pair: np.array(rows) for pair, rows in matches.items()})
    assert database_content(path) == before
    assert {file.name for file in tmp_path.iterdir()} == {"database.db", "images"}


def test_unknown_images_and_pairs_given_twice(tmp_path, folder):
    path = tmp_path / "database.db"
    import_cameras(path, folder, NAMES)
    with pytest.raises(InputError, match=r"image 'q\.jpg' is not in .*database\.db; import its camera first"):
        write_database(path, path, {"q.jpg": np.zeros((0, 2), np.float32)}, {})
    both = MATCHES | {("a.jpg", "b.jpg"): np.array([[2, 0]])}
    with pytest.raises(InputError, match="has matches in both directions; give them in one"):
        write_database(path, path, KEYPOINTS, both)


def test_an_unfinished_journal_is_copied_and_an_old_one_removed(tmp_path, folder):
    source, path = tmp_path / "cameras.db", tmp_path / "database.db"
    import_cameras(source, folder, NAMES)
    path.with_name("database.db-wal").write_bytes(b"of an older database")
    connection = sqlite3.connect(source)
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("UPDATE images SET name = 'renamed.jpg' WHERE name = 'z.jpg'")
    connection.commit()
    write_database(path, source, {}, {})
    connection.close()
    assert "renamed.jpg" in read_database(path)["images"]


def test_files_that_are_no_database(tmp_path):
    with pytest.raises(InputError, match=r"there is no database at .*missing\.db"):
        read_database(tmp_path / "missing.db")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "text.db").write_bytes(b"no database" * 1000)
    with pytest.raises(InputError, match=r"text\.db is not a COLMAP database"):
        read_database(tmp_path / "text.db")
