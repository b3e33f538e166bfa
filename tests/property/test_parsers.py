"""Whatever a file holds, its reader returns a value or refuses it in one line: valid files, spoilt at random."""

from __future__ import annotations

import io
import json
import os
import re
from pathlib import Path

import h5py
import numpy as np
import PIL.Image
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sgam_core.errors import SGAMError
from sgam_sfm.colmap.camera_files import read_cameras
from sgam_sfm.colmap.rigs import read_rigs
from sgam_sfm.evaluation.ground_truth import FORMATS, read_ground_truth
from sgam_sfm.hloc_files import read_global_descriptors, read_match_counts_h5
from sgam_sfm.images import inspect_image, read_label_map
from sgam_sfm.label_set import read_label_set
from sgam_sfm.options import MatchOptions, as_json, starting_options
from sgam_sfm.pairs import read_pairs
from sgam_sfm.runs.run_record import read_run_record
from sgam_sfm.runs.store import read_outcomes

# A larger number finds more: python -m pytest tests/property/test_parsers.py with FUZZ=5000
FUZZ = settings(
    max_examples=int(os.environ.get("FUZZ", "25")),
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
NAMES = ("a.jpg", "sub/b.jpg")
ODD = (b"nan", b"inf", b"-1", b"0", b"1e309", b"1e-320", b"9" * 25, b"0.5", b"", b"\xff", b"\0", b"../x", b"{}", b'"')
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
_TOKEN = re.compile(rb"[^\s,:\[\]{}=\"]+")


@st.composite
def spoilings(draw):
    """A function that spoils bytes: exchanges words or bytes, cuts, or repeats a part."""
    places = st.floats(0, 1)
    edits = draw(
        st.lists(
            st.tuples(st.just("word"), places, st.sampled_from(ODD) | st.binary(max_size=5))
            | st.tuples(st.just("bytes"), places, st.binary(min_size=1, max_size=5))
            | st.tuples(st.just("cut"), places, st.just(b""))
            | st.tuples(st.just("repeat"), places, st.just(b"")),
            min_size=1,
            max_size=3,
        )
    )

    def spoil(data: bytes) -> bytes:
        for kind, place, content in edits:
            at = int(place * len(data))
            if kind == "word" and (words := list(_TOKEN.finditer(data))):
                start, end = words[int(place * (len(words) - 1))].span()
                data = data[:start] + content + data[end:]
            elif kind == "bytes":
                data = data[:at] + content + data[at + len(content) :]
            elif kind == "cut":
                data = data[:at]
            elif kind == "repeat":
                data = data[:at] + data[at // 2 :]
        return data

    return spoil


def refuses_or_reads(read) -> None:
    """Raises: what is no error of ours, and ours when it has several lines."""
    message = ""
    try:
        read()
    except SGAMError as error:
        message = str(error)
    assert "\n" not in message


@FUZZ
@given(spoil=spoilings())
def test_pair_lists(tmp_path, spoil):
    path = tmp_path / "pairs.txt"
    path.write_bytes(spoil(b"# pairs\na.jpg sub/b.jpg\n0 1\n\nsub/b.jpg\ta.jpg\r\na.jpg a.jpg\n"))
    refuses_or_reads(lambda: read_pairs(path, NAMES))


@FUZZ
@given(spoil=spoilings(), suffix=st.sampled_from([".json", ".toml"]))
def test_options_as_text(tmp_path, spoil, suffix):
    given_options = as_json(MatchOptions(images=Path("a"), output=Path("b")))
    toml = b'images = "a"\nmapper = "global"\narea-size = 800\n[semantic]\nsoa_min_share = 0.1\n[rejection]\nphi = 1\n'
    path = tmp_path / f"options{suffix}"
    path.write_bytes(spoil(json.dumps(given_options).encode() if suffix == ".json" else toml))
    refuses_or_reads(lambda: starting_options(path, None))


@FUZZ
@given(place=st.floats(0, 1), value=JSON_VALUES)
def test_options_of_other_types(tmp_path, place, value):
    content = as_json(MatchOptions(images=Path("a"), output=Path("b")))
    flat = [(content, key) for key in content]
    flat += [(group, key) for group in content.values() if isinstance(group, dict) for key in group]
    group, key = flat[int(place * (len(flat) - 1))]
    group[key] = value
    path = tmp_path / "options.json"
    path.write_text(json.dumps(content))
    refuses_or_reads(lambda: starting_options(path, None))


def encoded(kind: str, mode: str = "RGB") -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
    picture = PIL.Image.fromarray(pixels[:, :, 0].astype(np.uint16) if mode == "I;16" else pixels)
    content = io.BytesIO()
    (picture if mode == "I;16" else picture.convert(mode)).save(content, format=kind)
    return content.getvalue()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "BMP", "TIFF", "PPM", "TGA", "WEBP", "GIF", "JPEG2000"])
@FUZZ
@given(spoil=spoilings())
def test_images(tmp_path, kind, spoil):
    (tmp_path / "a.jpg").write_bytes(spoil(encoded(kind)))
    refuses_or_reads(lambda: inspect_image(tmp_path, "a.jpg", 4096))


@FUZZ
@given(spoil=spoilings(), mode=st.sampled_from(["L", "P", "1", "I;16"]))
def test_label_maps(tmp_path, spoil, mode):
    path = tmp_path / "a.png"
    path.write_bytes(spoil(encoded("PNG", mode)))
    refuses_or_reads(lambda: read_label_map(path, 4096))


@FUZZ
@given(spoil=spoilings())
def test_label_sets(tmp_path, spoil):
    content = {"version": 1, "labels": [{"id": 1, "name": "wall", "colour": "#112233", "share": 0.5}], "ignored": [1]}
    (tmp_path / "labels.json").write_bytes(spoil(json.dumps(content).encode()))
    refuses_or_reads(lambda: read_label_set(tmp_path))


@FUZZ
@given(spoil=spoilings(), numbered=st.booleans())
def test_cameras(tmp_path, spoil, numbered):
    path = tmp_path / "cameras.txt"
    listed = b"a.jpg PINHOLE 64 48 60 61 33 23\nsub/* SIMPLE_RADIAL 64 48 60 32 24 0.1\n* OPENCV 8 6 7 7 4 3 0 0 0 0\n"
    path.write_bytes(
        spoil(b"1 PINHOLE 64 48 60 61 33 23\n2 SIMPLE_RADIAL 64 48 60 32 24 0.1\n" if numbered else listed)
    )
    refuses_or_reads(lambda: read_cameras(path, NAMES))


@FUZZ
@given(spoil=spoilings())
def test_rigs(tmp_path, spoil):
    camera = {"image_prefix": "a", "ref_sensor": True}
    other = {"image_prefix": "sub/", "cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [0, 0, 1]}
    path = tmp_path / "rigs.json"
    path.write_bytes(spoil(json.dumps([{"cameras": [camera, other]}]).encode()))
    refuses_or_reads(lambda: read_rigs(path, NAMES))


@FUZZ
@given(spoil=spoilings())
def test_run_records(tmp_path, spoil):
    content = {"state": "running", "pid": 1, "host": "a", "started": "2026-01-01T00:00:00+00:00", "updated": ""}
    (tmp_path / "progress.json").write_bytes(spoil(json.dumps(content).encode()))
    refuses_or_reads(lambda: read_run_record(tmp_path))


MATRIX = "1 0 0 0\n0 1 0 0\n0 0 1 2\n0 0 0 1\n"
K = "60 0 33 0\n0 61 23 0\n0 0 1 0\n0 0 0 1\n"
NINE = "60 0 33 0 61 23 0 0 1"
TEXTS = {
    "strecha": {"0.jpg.camera": f"{NINE}\n0 0 0\n1 0 0 0 1 0 0 0 1\n0 0 2\n64 48\n"},
    "scannet": {"pose/0.txt": MATRIX, "intrinsic/intrinsic_color.txt": K},
    "colmap": {"cameras.txt": "1 PINHOLE 64 48 60 61 33 23\n", "images.txt": "1 1 0 0 0 0 0 2 1 a.jpg\n1.5 2.5 -1\n"},
    "csv": {"poses.csv": "name,width,height,fx,fy,cx,cy,qw,qx,qy,qz,tx,ty,tz\na.jpg,64,48,60,61,33,23,1,0,0,0,0,0,2\n"},
    "pair-list": {"pairs.txt": f"a.jpg b.jpg 0 0 {NINE} {NINE} {MATRIX.replace(chr(10), ' ')}\n"},
    "kitti360": {
        "calibration/perspective.txt": "P_rect_00: 60 0 33 0 0 61 23 0 0 0 1 0\nS_rect_00: 64 48\n",
        "cam0_to_world.txt": f"0 {MATRIX.replace(chr(10), ' ')}\n",
    },
    "matterport3d": {
        "undistorted_camera_parameters/house.conf": f"intrinsics_matrix {NINE}\n"
        f"scan d.png a.jpg {MATRIX.replace(chr(10), ' ')}\n"
    },
}


@pytest.mark.parametrize("format", TEXTS)
@FUZZ
@given(spoil=spoilings(), which=st.integers(0, 1))
def test_ground_truth(tmp_path, format, spoil, which):
    folder, texts = tmp_path / "scene", TEXTS[format]
    for name in ("a.jpg", "b.jpg", "color/0.jpg"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if not (folder / name).exists():
            PIL.Image.new("RGB", (64, 48)).save(folder / name)
    for index, (name, text) in enumerate(texts.items()):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(spoil(text.encode()) if index == which % len(texts) else text.encode())
    path = folder / next(iter(texts)) if format in ("csv", "pair-list") else folder
    refuses_or_reads(lambda: read_ground_truth(path, format, folder))


def test_texts_are_valid_before_they_are_spoilt():
    assert TEXTS.keys() <= FORMATS.keys()


@pytest.fixture(scope="module")
def h5_file() -> bytes:
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for name in NAMES:
            file[f"{name}/global_descriptor"] = np.ones(4, np.float32)
        file["a.jpg/sub-b.jpg/matches0"] = np.arange(4)
    return content.getvalue()


VALUES = st.sampled_from(
    [
        np.ones(4),
        np.ones((4, 4)),
        np.array([]),
        np.array(np.nan),
        np.full(4, np.inf),
        np.array([b"text"]),
        np.void(b"\x80"),
    ]
)


@FUZZ
@given(value=VALUES, key=st.sampled_from(["a.jpg/global_descriptor", "a.jpg/sub-b.jpg/matches0", "a.jpg", "odd"]))
def test_files_of_hloc(tmp_path, h5_file, value, key):
    content = io.BytesIO(h5_file)
    with h5py.File(content, "r+") as file:
        if key in file:
            del file[key]
        file[key] = value
    path = tmp_path / "features.h5"
    path.write_bytes(content.getvalue())
    refuses_or_reads(lambda: read_global_descriptors(path, NAMES))
    refuses_or_reads(lambda: read_match_counts_h5(path, NAMES))


@FUZZ
@given(value=VALUES, key=st.sampled_from(["name0", "name1", "error", "fallback"]), cut=st.floats(0, 1))
def test_outcomes_of_a_store(tmp_path, value, key, cut):
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        group = file.create_group("0")
        group.attrs.update({"name0": "a.jpg", "name1": "sub/b.jpg", "error": "", "fallback": ""})
        group.attrs[key] = value
    path = tmp_path / "00000.h5"
    path.write_bytes(content.getvalue()[: int(cut * len(content.getvalue())) + 1])
    refuses_or_reads(lambda: read_outcomes(path))
