"""COLMAP's text files: read back as its importers read them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from sgam_core.errors import InputError
from sgam_sfm import cli
from sgam_sfm.colmap.database import write_database
from sgam_sfm.colmap.image_import import import_cameras
from sgam_sfm.colmap.text import write_keypoints_text, write_matches_text
from sgam_sfm.exit_codes import DONE, ERROR

KEYPOINTS = {
    "a.jpg": np.array([[0.5, 0.5], [1234.5678, 2.25]], np.float32),
    "sub/b.jpg": np.array([[7.125, 8]], np.float32),
}
MATCHES = {("a.jpg", "sub/b.jpg"): np.array([[1, 0]], np.uint32)}


def features(path: Path) -> np.ndarray:
    """As feature_importer reads them: a header with two numbers, then so many lines of four and 128 numbers."""
    header, *lines = path.read_text().splitlines()
    count, dimension = map(int, header.split())
    rows = np.array([list(map(float, line.split())) for line in lines]).reshape(-1, 4 + dimension)
    assert (len(rows), dimension) == (count, 128)
    assert not rows[:, 4:].any()
    return rows[:, :4]


def raw_matches(path: Path) -> dict:
    """As matches_importer reads them: two names, a match a line, an empty line at the end of each pair."""
    assert path.read_text().endswith("\n\n")
    pairs = (block.splitlines() for block in path.read_text().split("\n\n") if block)
    return {tuple(names.split()): [list(map(int, row.split())) for row in rows] for names, *rows in pairs}


def test_what_is_written(tmp_path):
    content = KEYPOINTS | {"none.jpg": np.zeros((0, 2), np.float32)}
    assert write_keypoints_text(tmp_path / "keypoints", content.items()) == len(content)
    for name, points in KEYPOINTS.items():
        found = features(tmp_path / f"keypoints/{name}.txt")
        np.testing.assert_array_equal(found[:, :2].astype(np.float32), points)
        np.testing.assert_array_equal(found[:, 2:], [[1, 0]] * len(points))
    assert len(features(tmp_path / "keypoints/none.jpg.txt")) == 0
    both = MATCHES | {("a.jpg", "c.jpg"): np.array([[0, 5], [1, 3]])}
    assert write_matches_text(tmp_path / "matches.txt", both.items()) == len(both)
    assert raw_matches(tmp_path / "matches.txt") == {pair: rows.tolist() for pair, rows in both.items()}


@pytest.mark.parametrize("name", ["two words.jpg", "#1.jpg"])
def test_names_that_the_format_cannot_hold(tmp_path, name):
    with pytest.raises(InputError) as error:
        write_matches_text(tmp_path / "matches.txt", [(("a.jpg", name), np.array([[0, 0]]))])
    assert str(error.value).startswith(f"image name '{name}' cannot be written to COLMAP's matches file")
    assert not (tmp_path / "matches.txt").exists()


def test_the_command(tmp_path, capsys):
    for name in KEYPOINTS:
        (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (64, 48)).save(tmp_path / "images" / name)
    out = tmp_path / "out"
    out.mkdir()
    (out / "options.json").write_text(json.dumps({"images": str(tmp_path / "images")}))
    assert cli.run(["export", str(out), "--output", str(tmp_path / "text")]) == ERROR
    assert f"'{out}' has no database.db yet; start the same match again, it writes one" in capsys.readouterr().err
    import_cameras(out / "cameras.db", tmp_path / "images", tuple(KEYPOINTS))
    write_database(out / "database.db", out / "cameras.db", KEYPOINTS, MATCHES)
    assert cli.run(["export", str(out), "--output", str(tmp_path / "text")]) == DONE
    assert raw_matches(tmp_path / "text/matches.txt") == {("a.jpg", "sub/b.jpg"): [[1, 0]]}
    assert len(features(tmp_path / "text/keypoints/sub/b.jpg.txt")) == 1
    told = capsys.readouterr().err
    assert "written    2 keypoint files, 1 pair in matches.txt" in told
    assert f"--match_list_path {tmp_path}/text/matches.txt --match_type raw" in told
