"""Cameras that are mounted together, and lists of cameras as COLMAP writes them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sgam_core.errors import InputError, OptionError
from sgam_sfm import MatchOptions, match_collection
from sgam_sfm.colmap.camera_files import read_cameras
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.colmap.reading import read_model
from sgam_sfm.reconstruction import reconstruct
from sgam_sfm.room.rendering import View
from sgam_sfm.stage_options import ReconstructOptions
from tests.arc import CAMERA, CX, CY, FOCAL, ArcMatcher, view, write_arc

BASELINE = 0.4


def right_of(left: View) -> View:
    pose = left.cam_from_world.copy()
    pose[0, 3] -= BASELINE
    return replace(left, name=left.name.replace("left", "right"), cam_from_world=pose)


LEFT = {f"left/{index}.png": view(f"left/{index}.png", angle) for index, angle in enumerate((-20.0, -7.0, 6.0, 20.0))}
VIEWS = LEFT | {other.name: other for other in map(right_of, LEFT.values())}
PLACE = {"cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [-BASELINE, 0, 0]}
RIG = [{"cameras": [{"image_prefix": "left/", "ref_sensor": True}, {"image_prefix": "right/", **PLACE}]}]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = write_arc(tmp_path_factory.mktemp("rig"), VIEWS)
    (folder / "rigs.json").write_text(json.dumps(RIG))
    return folder


def test_a_rig_moves_as_one(folder, tmp_path):
    options = MatchOptions(
        images=folder / "images",
        cameras=folder / "cameras.txt",
        rigs=folder / "rigs.json",
        output=tmp_path / "out",
        area_matcher="none",
        threads=1,
    )
    summary = match_collection(options, point_matcher=ArcMatcher(VIEWS))
    assert summary["models"][0]["registered"] == 8
    again = ReconstructOptions(
        results=options.output, output=tmp_path / "known", mapper="triangulate", input_model=folder / "truth"
    )
    for made in (options.output, Path(reconstruct(again)["options"]["output"])):
        model = read_model(made / "sparse/0")
        assert (model.num_reg_frames(), model.num_rigs(), model.num_cameras()) == (4, 1, 2)
        moves = []
        for name in LEFT:
            left, right = (model.find_image_with_name(n).cam_from_world() for n in (name, right_of(LEFT[name]).name))
            moves.append((right * left.inverse()).matrix())
        np.testing.assert_allclose(moves, [moves[0]] * 4, atol=1e-9)
        assert np.linalg.norm(moves[0][:, 3]) == pytest.approx(BASELINE, rel=0.02)


def test_equal_cameras_of_a_rig_stay_two(folder, tmp_path):
    equal = CameraOptions(rigs=folder / "rigs.json", model="PINHOLE", params=(FOCAL, FOCAL, CX, CY))
    for options in (equal, CameraOptions(rigs=folder / "rigs.json", cameras=folder / "cameras.txt")):
        cameras = import_cameras(tmp_path / "cameras.db", folder / "images", tuple(VIEWS), options).cameras
        assert len({cameras[name].camera_id for name in LEFT}) == 1
        assert len({info.camera_id for info in cameras.values()}) == 2
        assert all(info.known for info in cameras.values())


def test_cameras_of_the_configuration_are_known(folder, tmp_path):
    given = {"camera_model_name": "PINHOLE", "camera_params": [500, 501, 320, 240]}
    left, right = RIG[0]["cameras"]
    (tmp_path / "rigs.json").write_text(json.dumps([{"cameras": [left | given, right]}]))
    options = CameraOptions(rigs=tmp_path / "rigs.json")
    cameras = import_cameras(tmp_path / "cameras.db", folder / "images", tuple(VIEWS), options).cameras
    assert cameras["left/2.png"].params == (500, 501, 320, 240)
    assert (cameras["left/2.png"].known, cameras["right/2.png"].known) == (True, False)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("{bad", "' is no rig configuration of COLMAP ("),
        ('{"cameras": 1}', '; expected JSON like [{"cameras": [{"image_prefix": "left/", "ref_sensor": true}, '),
        ([{"cameras": [{"image_prefix": "left/"}]}], "Rig must have one reference sensor"),
        ([{"cameras": [{"image_prefix": "top/", "ref_sensor": True}]}], "': no image begins with 'top/'; names are"),
        (
            [{"cameras": [{"image_prefix": "left/", "ref_sensor": True}, {"image_prefix": "right/"}]}],
            "': 'right/' has no cam_from_rig_rotation (w, x, y, z) and cam_from_rig_translation; COLMAP's mappers need",
        ),
    ],
)
def test_wrong_configurations(folder, tmp_path, content, expected):
    path = tmp_path / "rigs.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(InputError) as error:
        import_cameras(tmp_path / "cameras.db", folder / "images", tuple(VIEWS), CameraOptions(rigs=path))
    assert str(error.value).startswith(f"--rigs '{path}'")
    assert expected in str(error.value)
    assert not (tmp_path / "cameras.db").exists()


def test_rigs_are_not_written_into_another_database(tmp_path):
    with pytest.raises(OptionError, match="--rigs would change the rigs of --database; apply them there with COLMAP"):
        CameraOptions(rigs=tmp_path, database=tmp_path)


def test_one_camera_of_colmaps_list_is_that_of_all_images(tmp_path):
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n7 {CAMERA}\n")
    assert {known.params for known in read_cameras(cameras, tuple(VIEWS)).values()} == {(FOCAL, FOCAL, CX, CY)}
    cameras.write_text(f"7 {CAMERA}\n8 PINHOLE 640 480 500 500 320 240\n")
    with pytest.raises(InputError) as error:
        read_cameras(cameras, tuple(VIEWS))
    assert str(error.value) == (
        f"{cameras} has 2 cameras, and no images.txt beside it says which image has which; put it there, or write "
        "lines `name MODEL width height params...` with names, `folder/*` or `*`"
    )
    lines = ["# IMAGE_ID ...", "", "1 1 0 0 0 0 0 0 7 left/0.png", "", "2 1 0 0 0 0 0 0 8 right/0.png", "", ""]
    (tmp_path / "images.txt").write_text("\n".join(lines))
    known = read_cameras(cameras, tuple(VIEWS))
    assert {name: camera.params[0] for name, camera in known.items()} == {"left/0.png": FOCAL, "right/0.png": 500}
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 9 left/0.png\n\n")
    with pytest.raises(InputError, match=r"'1 1 0 0 0 0 0 0 9 left/0\.png' names no camera of .*cameras\.txt"):
        read_cameras(cameras, tuple(VIEWS))


def test_cameras_of_folders(folder, tmp_path):
    cameras = tmp_path / "cameras.txt"
    cameras.write_text(
        f"left/* {CAMERA}\nright/* {CAMERA}\n* PINHOLE 640 480 9 9 9 9\nleft/3.png PINHOLE 640 480 500 500 320 240\n"
    )
    options = CameraOptions(cameras=cameras)
    made = import_cameras(tmp_path / "cameras.db", folder / "images", tuple(VIEWS), options).cameras
    assert made["left/0.png"].camera_id == made["left/2.png"].camera_id != made["right/0.png"].camera_id
    assert made["left/0.png"].params == made["right/0.png"].params == (FOCAL, FOCAL, CX, CY)
    assert made["left/3.png"].params == (500, 500, 320, 240)
