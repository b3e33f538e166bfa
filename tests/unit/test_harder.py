"""Harder cuts of a collection: images, cameras, masks, label maps and truth stay in agreement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sgam_core.errors import InputError, OptionError
from sgam_sfm.colmap.cameras import CameraInfo, camera_of_part
from sgam_sfm.comparison.harder import Cut, Window, cut_collection, cut_folder, parse_cut, read_windows
from sgam_sfm.evaluation.ground_truth import TrueView
from sgam_sfm.inputs import read_inputs
from sgam_sfm.options import MatchOptions
from sgam_sfm.progress import Stages

QUIET = Stages(quiet=True)


@pytest.mark.parametrize(
    ("texts", "scene_scale", "cut"),
    [
        ((), 1.0, Cut()),
        (("every=2", "zoom=2.5"), 1.0, Cut(every=2, zoom=2.5)),
        (("scale=0.5",), 0.5, Cut(scale=0.25)),
        (("turn=3",), 1.0, Cut(turn=3)),
    ],
)
def test_cuts_are_read(texts, scene_scale, cut):
    assert parse_cut(texts, scene_scale) == cut


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("zom=2", "--hard 'zom=2': 'zom' is unknown; did you mean 'zoom'? expected every=K, scale=S, zoom=Z or turn=Q"),
        ("zoom=two", "--hard 'zoom=two': 'two' is not a number"),
        ("zoom", "--hard 'zoom': '' is not a number"),
        ("every=1.5", "--hard every=1.5: expected a whole number of at least 1"),
        ("every=nan", "--hard every=nan: expected a whole number of at least 1"),
        ("scale=2", "images are to be scaled by 2; expected more than 0 and at most 1"),
        ("zoom=0.5", "--hard zoom=0.5: expected at least 1"),
        ("turn=90", "--hard turn=90: expected quarter turns, 1, 2 or 3"),
    ],
)
def test_wrong_cuts_are_named(text, message):
    with pytest.raises(OptionError) as error:
        parse_cut((text,))
    assert str(error.value) == message


def test_a_cut_is_written_as_it_is_asked_for():
    assert str(Cut()) == ""
    assert str(Cut(every=2, zoom=2.5)) == "every=2 zoom=2.5"
    assert str(Cut(turn=1)) == "turn=1"
    assert cut_folder(Path("out"), Cut(every=2, zoom=2.5)).name == "hard_every-2_zoom-2.5"


@given(
    x0=st.integers(0, 200),
    y0=st.integers(0, 100),
    size=st.tuples(st.integers(50, 400), st.integers(50, 300)),
    point=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
def test_a_point_falls_on_the_same_thing_before_and_after(x0, y0, size, point):
    """COLMAP's camera, the true one, and the pixels themselves move alike."""
    window = Window(whole=(800, 600), x0=x0, y0=y0, width=400, height=300, size=size)
    info = CameraInfo(
        image_id=1,
        camera_id=1,
        model="OPENCV",
        params=(700.0, 710.0, 395.0, 310.0, 0.01, -0.02, 0.001, 0.0),
        width=800,
        height=600,
        has_prior_focal=True,
        known=True,
    )
    part = camera_of_part(info, (x0, y0), (400, 300), size)
    cameras = [
        pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params)
        for camera in (info, part)
    ]
    before, after = (camera.img_from_cam(np.array([*point, 1.0])) for camera in cameras)
    moved = (before - [x0, y0]) * [size[0] / 400, size[1] / 300]
    np.testing.assert_allclose(after, moved, atol=1e-6)
    whole = TrueView(  # of the same image, at half its size
        name="a",
        width=400,
        height=300,
        camera_matrix=np.array([[350.0, 0, 197.5], [0, 355, 155], [0, 0, 1]]),
        cam_from_world=None,
    )
    expected = np.array([[700.0, 0, 395], [0, 710, 310], [0, 0, 1]])
    scale = np.diag([size[0] / 400, size[1] / 300, 1])
    shift = np.array([[1, 0, -x0], [0, 1, -y0], [0, 0, 1]])
    np.testing.assert_allclose(window.view(whole).camera_matrix, scale @ shift @ expected)


@given(
    model=st.sampled_from(["SIMPLE_RADIAL", "PINHOLE", "FULL_OPENCV", "THIN_PRISM_FISHEYE"]),
    turns=st.integers(0, 3),
    point=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)),
)
def test_a_turned_camera_sees_the_same_thing_turned(model, turns, point):
    """COLMAP's camera, the true one with its pose, and the pixels themselves turn alike."""
    camera = pycolmap.Camera(model=model, width=800, height=600)
    named = {"f": 700.0, "fx": 700.0, "fy": 710.0, "cx": 395.0, "cy": 310.0, "p1": 0.003, "p2": -0.002, "sx1": 0.004}
    camera.params = [named.get(name, 0.001) for name in camera.params_info.split(", ")]
    info = CameraInfo(
        image_id=1,
        camera_id=1,
        model=model,
        params=tuple(camera.params),
        width=800,
        height=600,
        has_prior_focal=True,
        known=True,
    )
    after = camera_of_part(info, (0, 0), (800, 600), (800, 600), turns)
    turned = pycolmap.Camera(model=model, width=after.width, height=after.height, params=after.params)
    x, y = camera.img_from_cam(np.array([*point, 1.0]))
    expected, seen = np.array([x, y]), np.array([*point, 1.0])
    view = TrueView(
        name="a",
        width=800,
        height=600,
        camera_matrix=camera.calibration_matrix(),
        cam_from_world=np.eye(3, 4),
        distortion=(0.01, 0.02, 0.003, -0.004),
    )
    straight = view.undistorted(expected[None])
    sides = (800, 600)
    for _ in range(turns):
        expected, seen = np.array([expected[1], sides[0] - expected[0]]), np.array([seen[1], -seen[0], seen[2]])
        straight = np.stack([straight[:, 1], sides[0] - straight[:, 0]], axis=1)
        sides = sides[::-1]
    np.testing.assert_allclose(turned.img_from_cam(seen), expected, atol=1e-6)
    window = Window(whole=(800, 600), x0=0, y0=0, width=800, height=600, size=(800, 600), turns=turns)
    there = window.view(view)
    assert (there.width, there.height) == (turned.width, turned.height) == sides
    np.testing.assert_allclose(there.camera_matrix, turned.calibration_matrix(), atol=1e-9)
    np.testing.assert_allclose(there.cam_from_world @ [*point, 1.0, 1.0], seen, atol=1e-9)
    np.testing.assert_allclose(there.undistorted(expected[None]), straight, atol=1e-3)


@pytest.fixture
def options(tmp_path) -> MatchOptions:
    """Four images 80 x 60 with cameras, masks and label maps; a ramp tells every pixel's place."""
    ramp = np.stack(np.broadcast_arrays(np.arange(80), np.arange(60)[:, None], 7), axis=2).astype(np.uint8)
    for part in ("images", "masks", "labels"):
        (tmp_path / part / "sub").mkdir(parents=True)
    for name in ("a.png", "b.jpg", "sub/c 1.png", "sub/d.tif"):
        PIL.Image.fromarray(ramp).save(tmp_path / "images" / name)
        PIL.Image.fromarray(np.where(ramp[..., 0] < 40, 0, 255).astype(np.uint8)).save(tmp_path / f"masks/{name}.png")
        PIL.Image.fromarray(1 + ramp[..., 0] // 40).save(tmp_path / f"labels/{name}.png")
    return MatchOptions(
        images=tmp_path / "images",
        output=tmp_path / "out",
        mask_path=tmp_path / "masks",
        labels=tmp_path / "labels",
        camera_model="PINHOLE",
        camera_params="100,100,41,29",
        camera_mode="single",
    )


def cut_of(options: MatchOptions, cut: Cut) -> MatchOptions:
    return cut_collection(cut, options, read_inputs(options, QUIET), cut_folder(options.output, cut), QUIET)


def test_everything_of_an_image_is_cut_alike(options):
    cut = Cut(zoom=2, scale=0.5)
    harder = cut_of(options, cut)
    inputs = read_inputs(replace(harder, output=options.output / "again"), QUIET)
    sizes = {name: (file.width, file.height) for name, file in inputs.images.items()}
    assert sizes == {"a.png": (40, 30), "b.jpg": (20, 15), "sub/c 1.png": (40, 30), "sub/d.tif": (20, 15)}
    assert all(camera.known for camera in inputs.cameras.values())
    assert not harder.refine_intrinsics
    np.testing.assert_allclose(inputs.cameras["a.png"].params, (50, 50, 20.5, 14.5))
    np.testing.assert_allclose(inputs.cameras["sub/d.tif"].params, (50, 50, (41 - 20) / 2, (29 - 15) / 2))
    folder = cut_folder(options.output, cut)
    pixels = np.asarray(PIL.Image.open(folder / "images" / "sub" / "d.tif"))
    np.testing.assert_allclose(pixels[0, :3, 0], [20.5, 22.5, 24.5], atol=0.6)
    np.testing.assert_allclose(pixels[:3, 0, 1], [15.5, 17.5, 19.5], atol=0.6)
    mask = np.asarray(PIL.Image.open(folder / "masks" / "sub" / "d.tif.png"))
    labels = np.asarray(PIL.Image.open(folder / "labels" / "sub" / "d.tif.png"))
    assert mask.shape == labels.shape == (15, 20)
    np.testing.assert_array_equal(mask[0] > 0, np.arange(20) >= 10)
    np.testing.assert_array_equal(labels[0], 1 + (np.arange(20) >= 10))
    assert read_windows(folder)["sub/d.tif"] == Window(whole=(80, 60), x0=20, y0=15, width=40, height=30, size=(20, 15))


def test_every_other_image_is_turned_with_all_that_belongs_to_it(options):
    cut = Cut(turn=1)
    harder = cut_of(options, cut)
    inputs = read_inputs(replace(harder, output=options.output / "again"), QUIET)
    sizes = {name: (file.width, file.height) for name, file in inputs.images.items()}
    assert sizes == {"a.png": (80, 60), "b.jpg": (60, 80), "sub/c 1.png": (80, 60), "sub/d.tif": (60, 80)}
    np.testing.assert_allclose(inputs.cameras["sub/d.tif"].params, (100, 100, 29, 80 - 41))
    folder = cut_folder(options.output, cut)
    pixels = np.asarray(PIL.Image.open(folder / "images" / "sub" / "d.tif"))
    np.testing.assert_array_equal(pixels[0, :3], [[79, 0, 7], [79, 1, 7], [79, 2, 7]])
    mask = np.asarray(PIL.Image.open(folder / "masks" / "sub" / "d.tif.png"))
    np.testing.assert_array_equal(mask[:, 0] > 0, np.arange(80) < 40)


def test_a_cut_that_is_there_is_not_made_again(options):
    cut = Cut(zoom=2)
    folder = cut_folder(options.output, cut)
    cut_of(options, cut)
    image = folder / "images" / "b.jpg"
    before = image.stat().st_mtime_ns
    cut_of(options, cut)
    assert image.stat().st_mtime_ns == before
    PIL.Image.new("RGB", (80, 60)).save(options.images / "a.png")
    cut_of(options, cut)
    assert image.stat().st_mtime_ns != before


def test_every_other_image_with_the_pairs_among_them(options):
    harder = cut_of(options, Cut(every=2))
    assert harder.images == options.images
    assert list(read_inputs(harder, QUIET).images) == ["a.png", "sub/c 1.png"]
    with pytest.raises(InputError) as error:
        cut_of(options, Cut(every=4))
    assert str(error.value) == "--hard every=4 leaves none of the 6 pairs; cut less"


def test_the_focal_length_of_exif_stays_known_and_is_refined(options):
    exif = PIL.Image.Exif()
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = 35
    PIL.Image.new("RGB", (80, 60)).save(options.images / "b.jpg", exif=exif)
    unknown = replace(options, camera_model="SIMPLE_RADIAL", camera_params="", camera_mode="auto", labels=None)
    harder = cut_of(unknown, Cut(zoom=2))
    assert harder.refine_intrinsics
    cameras = read_inputs(replace(harder, output=options.output / "again"), QUIET).cameras
    assert cameras["b.jpg"].params[0] == pytest.approx(80, rel=0.2)  # of the image, though it is 40 wide now
    assert not cameras["sub/d.tif"].has_prior_focal
