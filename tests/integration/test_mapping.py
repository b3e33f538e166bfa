"""From keypoints and matches to a model, on scenes whose truth is known."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest

from sgam_core.errors import InputError, OptionError, StageError
from sgam_sfm.colmap.database import write_database
from sgam_sfm.colmap.image_import import CameraOptions, ImportedImages, import_cameras
from sgam_sfm.colmap.mapping import MappingOptions, map_images
from sgam_sfm.colmap.reading import database_content, read_database
from sgam_sfm.colmap.verification import VerificationOptions, verify

NAMES = tuple(f"{i}.jpg" for i in range(6))
WIDTH, HEIGHT, FOCAL, CX, CY = 640, 480, 520.0, 331.0, 229.5  # corner origin
CAMERA = CameraOptions(model="PINHOLE", params=(FOCAL, FOCAL, CX, CY), mode="single")


@dataclass(frozen=True)
class Scene:
    """300 points seen from six places on an arc, each image numbering them in its own order."""

    folder: Path
    database: Path
    imported: ImportedImages
    rotations: dict[str, np.ndarray]
    centers: dict[str, np.ndarray]


def make_scene(
    tmp_path: Path, noise_px: float = 0.0, camera: CameraOptions | None = CAMERA, arc_deg: float = 25.0
) -> Scene:
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -1.5, 5), (2, 1.5, 8), (300, 3))
    folder = tmp_path / "images"
    folder.mkdir()
    rotations, centers, keypoints, order = {}, {}, {}, {}
    for name, angle in zip(NAMES, np.radians(np.linspace(-arc_deg, arc_deg, len(NAMES))), strict=True):
        PIL.Image.new("RGB", (WIDTH, HEIGHT)).save(folder / name)
        c, s = np.cos(angle), np.sin(angle)
        rotations[name] = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])  # camera from world, about the point (0, 0, 6.5)
        centers[name] = np.array([0, 0, 6.5]) - rotations[name].T @ (0, 0.3 * angle, 6.5)
        x, y, z = rotations[name] @ (points - centers[name]).T
        order[name] = rng.permutation(len(points))
        pixels = np.stack([FOCAL * x / z + CX, FOCAL * y / z + CY], axis=1)
        keypoints[name] = (pixels + noise_px * rng.standard_normal(pixels.shape))[order[name]]
    rows = {name: np.argsort(order[name]) for name in NAMES}
    matches = {pair: np.stack([rows[pair[0]], rows[pair[1]]], axis=1) for pair in combinations(NAMES, 2)}
    database = tmp_path / "database.db"
    imported = import_cameras(database, folder, NAMES, camera)
    write_database(database, database, keypoints, matches)
    return Scene(folder, database, imported, rotations, centers)


def map_scene(scene: Scene, output: Path, **options):
    return map_images(
        scene.database,
        scene.folder,
        output,
        MappingOptions(**options),
        known_camera_ids=scene.imported.known_camera_ids,
    )


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Scene:
    """Keypoints with 0.5 px of noise an axis, verified."""
    scene = make_scene(tmp_path_factory.mktemp("noisy"), noise_px=0.5)
    verify(scene.database)
    return scene


def worst_pose_error_deg(model_folder: Path, scene: Scene) -> float:
    """The largest error of a relative rotation or direction over all pairs."""
    model = pycolmap.Reconstruction(model_folder)
    poses = {model.image(i).name: model.image(i).cam_from_world() for i in model.reg_image_ids()}
    rotations = {name: pose.rotation.matrix() for name, pose in poses.items()}
    centers = {name: -rotations[name].T @ pose.translation for name, pose in poses.items()}
    errors = []
    for a, b in combinations(NAMES, 2):
        rotation = (rotations[b] @ rotations[a].T) @ (scene.rotations[b] @ scene.rotations[a].T).T
        found, true = (
            rotations[a] @ (centers[b] - centers[a]),
            scene.rotations[a] @ (scene.centers[b] - scene.centers[a]),
        )
        errors.append(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
        errors.append(np.arccos(np.clip(found @ true / np.linalg.norm(found) / np.linalg.norm(true), -1, 1)))
    return float(np.degrees(max(errors)))


def test_verification_reports_progress_inliers_and_costs(tmp_path):
    scene = make_scene(tmp_path, noise_px=1.0)
    progress = []
    verified = verify(scene.database, on_progress=lambda *event: progress.append(event))
    assert progress[-1] == ("verify", 15, 15)
    assert verified.num_pairs == 15
    assert set(verified.inliers) == set(combinations(NAMES, 2))
    assert min(verified.inliers.values()) > 285
    assert verified.seconds > 0
    assert verified.peak_memory_mb is None or 20 < verified.peak_memory_mb < 2000
    content = read_database(scene.database)["two_view_geometries"]
    assert {geometry["config"] for geometry in content.values()} == {"CALIBRATED"}

    # Pairs that are verified already are verified anew; threads make no difference.
    stricter = verify(scene.database, VerificationOptions(max_error_px=1.0))
    assert sum(stricter.inliers.values()) < 0.9 * sum(verified.inliers.values())
    assert verify(scene.database, VerificationOptions(threads=1)).inliers == verified.inliers
    for pair, geometry in read_database(scene.database)["two_view_geometries"].items():
        np.testing.assert_array_equal(geometry["inlier_matches"], content[pair]["inlier_matches"])
        np.testing.assert_array_equal(geometry["F"], content[pair]["F"])


def test_noisy_scene_is_mapped_as_it_is(tmp_path, noisy):
    progress = []
    summary = map_images(
        noisy.database,
        noisy.folder,
        tmp_path / "sparse",
        on_progress=lambda *event: progress.append(event),
        known_camera_ids=noisy.imported.known_camera_ids,
        log_path=tmp_path / "logs/mapping.log",
    )
    assert progress == [("map", count, 6) for count in range(2, 7)]
    assert summary.reason == ""
    (model,) = summary.models
    assert (model.folder, model.registered, model.total, model.images) == ("0", 6, 6, NAMES)
    assert model.points == pytest.approx(300, abs=3)
    assert model.observations == pytest.approx(1800, abs=20)
    assert model.mean_images_per_track == pytest.approx(6, abs=0.05)
    # Noise of 0.5 px an axis: errors follow a Rayleigh distribution with mean 0.63 px, less what the fit absorbs.
    assert 0.45 < model.mean_reprojection_error_px < 0.65
    assert worst_pose_error_deg(tmp_path / "sparse/0", noisy) < 0.5
    assert {file.name for file in (tmp_path / "sparse/0").iterdir()} == {
        f"{part}.bin" for part in ("cameras", "images", "points3D", "rigs", "frames")
    }
    assert {file.name for file in tmp_path.iterdir()} == {"sparse", "logs"}


@pytest.mark.parametrize(("shift", "exact"), [(0.0, True), (0.5, False)])
def test_exact_keypoints_fit_the_given_camera_to_a_thousandth_of_a_pixel(tmp_path, shift, exact):
    scene = make_scene(
        tmp_path, camera=CameraOptions(model="PINHOLE", params=(FOCAL, FOCAL, CX + shift, CY), mode="single")
    )
    verify(scene.database)
    (model,) = map_scene(scene, tmp_path / "sparse").models
    assert (model.mean_reprojection_error_px < 1e-3) == exact
    assert (worst_pose_error_deg(tmp_path / "sparse/0", scene) < 1e-3) == exact
    (camera,) = pycolmap.Reconstruction(tmp_path / "sparse/0").cameras.values()
    assert tuple(camera.params) == (FOCAL, FOCAL, CX + shift, CY)  # held fixed


def test_known_intrinsics_are_refined_when_asked(tmp_path):
    scene = make_scene(
        tmp_path, camera=CameraOptions(model="SIMPLE_PINHOLE", params=(FOCAL * 1.01, CX, CY), mode="single")
    )
    verify(scene.database)
    map_scene(scene, tmp_path / "sparse", refine_intrinsics=True)
    (camera,) = pycolmap.Reconstruction(tmp_path / "sparse/0").cameras.values()
    assert camera.params[0] == pytest.approx(FOCAL, rel=1e-3)


def test_global_mapper_holds_known_cameras_and_replaces_old_models(tmp_path, noisy):
    for stale in ("0", "1", "notes"):
        (tmp_path / "sparse" / stale).mkdir(parents=True)
        (tmp_path / "sparse" / stale / "old.txt").touch()
    (model,) = map_scene(noisy, tmp_path / "sparse", mapper="global").models
    assert model.registered == 6
    assert worst_pose_error_deg(tmp_path / "sparse/0", noisy) < 0.5
    (camera,) = pycolmap.Reconstruction(tmp_path / "sparse/0").cameras.values()
    assert tuple(camera.params) == (FOCAL, FOCAL, CX, CY)
    assert {folder.name for folder in (tmp_path / "sparse").iterdir()} == {"0", "notes"}
    assert not (tmp_path / "sparse/0/old.txt").exists()


def test_global_mapper_calibrates_without_touching_the_database(tmp_path):
    scene = make_scene(tmp_path, noise_px=0.2, camera=CameraOptions(model="SIMPLE_PINHOLE", mode="single"))
    verify(scene.database)
    before = database_content(scene.database)
    (model,) = map_scene(scene, tmp_path / "sparse", mapper="global").models
    assert database_content(scene.database) == before
    assert model.registered == 6


def test_global_mapper_refuses_to_hold_some_cameras(tmp_path):
    scene = make_scene(tmp_path, camera=None)
    with pytest.raises(OptionError) as error:
        map_images(
            scene.database, scene.folder, tmp_path / "sparse", MappingOptions(mapper="global"), known_camera_ids=[1]
        )
    assert str(error.value) == (
        "1 of 6 cameras are known, but the global mapper holds all of them fixed or none; give every camera, pass "
        "--refine-intrinsics, or use the incremental mapper"
    )


def test_no_model_is_a_result_with_a_reason(tmp_path):
    scene = make_scene(tmp_path)
    write_database(scene.database, scene.database, {}, {})
    (tmp_path / "sparse/0").mkdir(parents=True)
    summary = map_scene(scene, tmp_path / "sparse")
    assert summary.models == ()
    assert summary.reason == (
        "COLMAP found no model of at least 3 images from 0 verified pairs, the best with 0 inliers; try "
        "pairs that overlap more (`sgam-sfm show OUT` draws them), a larger --image-size, or another --matcher"
    )
    assert list((tmp_path / "sparse").iterdir()) == []
    summary = map_scene(scene, tmp_path / "sparse", min_model_size=7)
    assert summary.reason == "COLMAP's models start at 7 images, and there are 6; give more photos"


def test_photos_from_one_place_are_told_from_photos_that_do_not_overlap(tmp_path):
    scene = make_scene(tmp_path, noise_px=0.5, arc_deg=0.1)
    verify(scene.database)
    summary = map_scene(scene, tmp_path / "sparse")
    assert summary.models == ()
    assert "no model of at least 3 images, though 15 of 15 verified pairs have 100 inliers or more: " in summary.reason


def test_abort_of_native_code_becomes_an_error_and_keeps_the_matches(tmp_path):
    scene = make_scene(tmp_path)
    with pycolmap.Database.open(scene.database) as database:
        database.update_keypoints(1, np.zeros((300, 3), np.float32))
    with pytest.raises(StageError) as error:
        verify(scene.database)
    assert str(error.value) == (
        "COLMAP's verification ended with SIGABRT: what():  [database_sqlite.cc:125] Keypoint format not supported "
        f"(log: {tmp_path / 'colmap.log'}); everything before this stage has been kept"
    )
    with pycolmap.Database.open(scene.database) as database:
        assert database.num_matched_image_pairs() == 15


def test_corrupt_database_becomes_an_error_and_keeps_the_old_model(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "database.db").write_bytes(b"no database" * 1000)
    with pytest.raises(StageError, match="COLMAP's incremental mapping ended with exit code 1: RuntimeError: "):
        map_images(tmp_path / "database.db", tmp_path / "images", tmp_path / "sparse")
    assert {path.name for path in tmp_path.iterdir()} == {"images", "sparse", "database.db", "colmap.log"}
    assert (tmp_path / "sparse/0").is_dir()


def test_missing_inputs_are_not_created(tmp_path):
    with pytest.raises(InputError, match=r"there is no database at .*database\.db"):
        verify(tmp_path / "database.db")
    (tmp_path / "database.db").touch()
    with pytest.raises(InputError, match=r"there is no image folder at .*images"):
        map_images(tmp_path / "database.db", tmp_path / "images", tmp_path / "sparse")
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]


@pytest.mark.parametrize("bad", [{"mapper": "spherical"}, {"min_model_size": 1}])
def test_mapping_options_are_checked(bad):
    with pytest.raises(OptionError):
        MappingOptions(**bad)


def test_an_unguarded_script_can_verify(tmp_path):
    """No multiprocessing: the child must not run the user's script again; nor may a file beside it shadow a module."""
    make_scene(tmp_path)
    (tmp_path / "pycolmap.py").write_text("raise RuntimeError('shadowed')")
    (tmp_path / "script").mkdir()
    script = tmp_path / "script/run.py"
    script.write_text(
        "import sys, pathlib\nfrom sgam_sfm.colmap.verification import verify\n"
        "print(len(verify(pathlib.Path(sys.argv[1])).inliers))\n"
    )
    done = subprocess.run(
        [sys.executable, script, tmp_path / "database.db"], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert (done.stdout, done.stderr) == ("15\n", "")


def test_png_can_be_written_after_the_import():
    """pycolmap's wheel carries a zlib that breaks the system's when pycolmap is loaded first."""
    code = "from sgam_sfm.colmap import database, mappers\nimport zlib\nprint(len(zlib.compress(b'abc' * 1000)) < 100)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
