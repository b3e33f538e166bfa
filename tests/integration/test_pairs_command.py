"""`sgam-sfm pairs` from end to end: every method on the room or a synthetic model, what is printed, wrong input."""

from __future__ import annotations

import re
import shlex
import shutil
import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own)
from collections.abc import Iterable
from itertools import combinations, pairwise
from pathlib import Path

import h5py
import numpy as np
import PIL.Image
import pycolmap
import pytest

from sgam_sfm import cli
from sgam_sfm.exit_codes import DONE, ERROR, SOME_FAILED, USAGE
from sgam_sfm.pairs import read_pairs
from sgam_sfm.scene import write_ground_truth
from tests.room import Room, write_room


@pytest.fixture(scope="module")
def folder(room: Room, tmp_path_factory) -> Path:
    return write_room(room, tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory) -> Path:
    """images/, model/ and database.db of eight cameras, of which three see each point."""
    folder = tmp_path_factory.mktemp("synthetic")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_points3D, options.track_length = 4, 60, 3
    with pycolmap.Database.open(folder / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
    (folder / "model").mkdir()
    model.write(folder / "model")
    write_images(folder / "images", [image.name for image in model.images.values()])
    return folder


def write_images(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        PIL.Image.new("RGB", (8, 6)).save(folder / name)


def run(folder: Path, output: Path, method: str, *flags: object) -> tuple[int, list[tuple[str, str]]]:
    """The exit code, and the pairs that were written."""
    common = ["--images", folder / "images", "--output", output]
    code = cli.run(["pairs", method, *map(str, [*common, *flags])])
    if not output.is_file():
        return code, []
    names = [path.relative_to(folder / "images").as_posix() for path in (folder / "images").rglob("*.*")]
    found = read_pairs(output, names)
    assert found.num_repeated + found.num_reversed + found.num_self == 0
    assert list(found.pairs) == sorted(found.pairs)
    return code, list(found.pairs)


def told(capsys) -> str:
    """What was printed, without line breaks and progress bars."""
    return capsys.readouterr().err


def test_exhaustive_says_what_comes_next(folder, room, tmp_path, capsys):
    output = tmp_path / "my lists" / "pairs.txt"
    assert run(folder, output, "exhaustive") == (DONE, list(combinations(sorted(room.images), 2)))
    text = told(capsys)
    assert f"pairs      15 of 15 that 6 images can make, in {output}" in text
    assert "graph      one part: pairs join all 6 images" in text
    command = shlex.split(re.search(r"next +(.*)", text)[1])
    assert command[:2] == ["sgam-sfm", "match"]
    options = cli._parse(command[1:])
    assert (options.images, options.pairs, options.output) == (folder / "images", output, output.parent / "out")


def test_exhaustive_refuses_too_many_images(folder, tmp_path, capsys):
    assert run(folder, tmp_path / "pairs.txt", "exhaustive", "--max-images", 5) == (ERROR, [])
    assert "6 images make 15 pairs; matching all of them is meant for at most 5 images: choose those" in told(capsys)


def test_sequential_joins_neighbours_and_warns_of_gaps(tmp_path, capsys):
    write_images(tmp_path / "images", ("a/f9.png", "a/f10.png", "a/f11.png", "b/f1.png", "b/f2.png", "alone.png"))
    code, pairs = run(tmp_path, tmp_path / "pairs.txt", "sequential", "--overlap", 1)
    assert code == DONE
    assert pairs == [("a/f10.png", "a/f11.png"), ("a/f10.png", "a/f9.png"), ("b/f1.png", "b/f2.png")]
    text = told(capsys)
    assert "warning    1 image in no pair, and so without a pose: alone.png" in text
    assert "no pair joins these 2 groups: 3 images (a/f10.png, ...), 2 images (b/f1.png, ...); each becomes" in text


def test_loops_join_what_neighbours_do_not(folder, tmp_path):
    output, features = tmp_path / "pairs.txt", tmp_path / "features.h5"
    names = sorted(path.name for path in (folder / "images").iterdir())
    with h5py.File(features, "w") as file:
        for name, angle in zip(names, (0.0, 0.8, 1.6, 2.4, 3.1, 0.1), strict=True):
            file[f"{name}/global_descriptor"] = np.array([np.cos(angle), np.sin(angle)])
    flags = ("--overlap", 1, "--loop-closure", "--descriptors", features, "--num", 1, "--loop-period", 5)
    expected = sorted([*pairwise(names), (names[0], names[5])])
    assert run(folder, output, "sequential", *flags) == (DONE, expected)
    assert run(folder, output, "sequential", *flags, "--min-score", 0.999)[1] == sorted(pairwise(names))


def test_retrieval_by_coseg_prefers_what_looks_alike_and_keeps_its_features(folder, tmp_path):
    """Provenance: of the rendered room, view10 is a close-up of the relief, the others are neighbours along an arc."""
    (tmp_path / "images").mkdir()
    for name in ("view02.jpg", "view03.jpg", "view10.jpg"):
        shutil.copy(folder / "images" / name, tmp_path / "images")
    flags = ("--num", 1, "--min-score", 0)
    expected = (DONE, [("view02.jpg", "view03.jpg")])
    assert run(tmp_path, tmp_path / "pairs.txt", "retrieval", *flags) == expected
    kept = sorted((tmp_path / "out" / "cache").iterdir())
    assert len(kept) == 3
    times = [path.stat().st_mtime_ns for path in kept]
    assert run(tmp_path, tmp_path / "pairs.txt", "retrieval", *flags) == expected
    assert [path.stat().st_mtime_ns for path in kept] == times


def test_retrieval_by_labels_names_images_without_a_map(folder, tmp_path, capsys):
    labels = tmp_path / "labels"
    shutil.copytree(folder / "labels", labels)
    (labels / "view03.jpg.png").unlink()
    code, pairs = run(folder, tmp_path / "pairs.txt", "retrieval", "--labels", labels, "--num", 0, "--min-score", 0)
    assert code == SOME_FAILED
    assert len(pairs) == 10
    assert not any("view03.jpg" in pair for pair in pairs)
    text = told(capsys)
    assert "no labels for 'view03.jpg'; expected 'view03.jpg.png' or 'view03.png' in" in " ".join(text.split())
    assert "failed     1 image that cannot be compared: view03.jpg" in text
    assert "graph      one part: pairs join the other 5 images" in text


def test_retrieval_by_descriptors_of_hloc(tmp_path, capsys):
    names = [f"{sub}/{number}.png" for sub in ("a/day", "b") for number in range(4)]
    write_images(tmp_path / "images", names)
    features = tmp_path / "global-feats-netvlad.h5"
    vectors = np.eye(4)[[0, 0, 1, 1, 2, 2, 3, 3]] + 0.01
    with h5py.File(features, "w") as file:
        for name, vector in zip(names, vectors, strict=True):
            file[f"{name}/global_descriptor"] = vector
    flags = ("--descriptors", features, "--num", 1)
    expected = [(names[i], names[i + 1]) for i in range(0, 8, 2)]
    assert run(tmp_path, tmp_path / "pairs.txt", "retrieval", *flags) == (DONE, expected)
    assert "no pair joins these 4 groups: 2 images" in told(capsys)


def shared(model: pycolmap.Reconstruction) -> dict[tuple[str, str], int]:
    images = sorted(model.images.values(), key=lambda image: image.name)
    points = {im.name: {p.point3D_id for p in im.points2D if p.has_point3D()} for im in images}
    return {(a, b): len(points[a] & points[b]) for a, b in combinations(points, 2)}


def test_from_model_takes_pairs_that_share_points(synthetic, tmp_path):
    counts = shared(pycolmap.Reconstruction(synthetic / "model"))
    least = int(np.median(list(counts.values())))
    flags = ("--model", synthetic / "model", "--num", 0)
    code, pairs = run(synthetic, tmp_path / "pairs.txt", "from-model", *flags, "--min-score", least)
    assert code == DONE
    assert pairs == [pair for pair, count in counts.items() if count >= least]
    assert 0 < len(pairs) < len(counts)
    best = run(synthetic, tmp_path / "pairs.txt", "from-model", "--model", synthetic / "model", "--num", 1)[1]
    for name in {name for pair in counts for name in pair}:
        top = max(count for pair, count in counts.items() if name in pair)
        assert max(counts[pair] for pair in best if name in pair) == top


def test_from_poses_of_the_room(folder, room, tmp_path):
    write_ground_truth(tmp_path, list(room.views.values()))
    code, pairs = run(folder, tmp_path / "pairs.txt", "from-poses", "--poses", tmp_path, "--num", 2)
    assert code == DONE
    assert set(pairwise([f"view0{number}.jpg" for number in range(2, 7)])) < set(pairs)  # neighbours along the arc
    assert len(pairs) < 12
    few = run(folder, tmp_path / "pairs.txt", "from-poses", "--poses", tmp_path, "--max-rotation-deg", 1)
    assert few == (ERROR, pairs)  # the list that was there is kept


def test_from_file_reads_a_database_a_matches_file_and_a_list(synthetic, tmp_path):
    database = synthetic / "database.db"
    code, pairs = run(synthetic, tmp_path / "pairs.txt", "from-file", "--file", database)
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        rows = zip(*opened.read_num_matches(), strict=True)
        counts = {tuple(sorted(names[i] for i in pycolmap.pair_id_to_image_pair(pair))): n for pair, n in rows}
    assert code == DONE
    assert pairs == sorted(pair for pair, count in counts.items() if count)
    matches = tmp_path / "matches.h5"
    with h5py.File(matches, "w") as file:
        for (a, b), count in counts.items():
            file[f"{b.replace('/', '-')}/{a.replace('/', '-')}/matches0"] = np.arange(count)
    assert run(synthetic, tmp_path / "pairs.txt", "from-file", "--file", matches) == (DONE, pairs)
    text = tmp_path / "raw.txt"
    text.write_text("".join(f"{b} {a}\n0 1\n2 3\n\n{a} {b}\n0 1\n\n" for a, b in pairs))
    assert run(synthetic, tmp_path / "pairs.txt", "from-file", "--file", text) == (DONE, pairs)
    least = max(counts.values())
    few = run(synthetic, tmp_path / "few.txt", "from-file", "--file", database, "--min-score", least)[1]
    assert few == sorted(pair for pair, count in counts.items() if count == least)


@pytest.mark.parametrize(
    ("method", "flags", "code", "message"),
    [
        ("retrieval", ["--num", "-1"], USAGE, "--num is -1; expected at least 0"),
        ("retrieval", ["--min-score", "2"], USAGE, "--min-score is 2; a cosine similarity is between -1 and 1"),
        (
            "retrieval",
            ["--labels", "x", "--descriptors", "y"],
            USAGE,
            "--descriptors and --labels are two ways to compare images; give one of them",
        ),
        ("retrieval", ["--labels", "nowhere"], ERROR, "--labels 'nowhere' does not exist; give the folder"),
        ("retrieval", ["--descriptors", "no.h5"], ERROR, "there is no file 'no.h5'; give an h5 file of hloc"),
        ("retrieval", ["--cache", "{images}/c"], USAGE, "--cache '{images}/c' lies in the image folder; choose one"),
        ("sequential", ["--overlap", "0"], USAGE, "--overlap is 0; expected at least 1"),
        ("sequential", ["--labels", "x"], USAGE, "--descriptors and --labels are for loops; add --loop-closure"),
        ("from-model", ["--model", "nowhere"], ERROR, "nowhere cannot be read as a COLMAP model"),
        ("from-poses", ["--poses", "nowhere"], ERROR, "there is no ground truth at 'nowhere'; give a file or folder"),
        ("from-poses", ["--poses", "x", "--max-rotation-deg", "0"], USAGE, "--max-rotation-deg is 0; expected more"),
        ("from-poses", ["--poses", "x", "--depth", "-2"], USAGE, "--depth is -2; expected a positive number, or 0"),
        ("from-file", ["--file", "no.txt"], ERROR, "cannot read the pair list no.txt: No such file"),
        ("from-file", ["--file", "{images}"], ERROR, "'{images}' is a folder; give a file, or a COLMAP model to"),
        (
            "exhaustive",
            ["--output", "{images}"],
            USAGE,
            "--output '{images}' is a folder; give a file, '{images}/pairs",
        ),
    ],
)
def test_wrong_input_is_named(folder, tmp_path, monkeypatch, capsys, method, flags, code, message):
    monkeypatch.chdir(tmp_path)
    images = str(folder / "images")
    given = [flag.format(images=images) for flag in flags]
    assert cli.run(["pairs", method, "--images", images, "--output", "pairs.txt", *given]) == code
    assert f"error: {message.format(images=images)}" in told(capsys)
    assert not (tmp_path / "pairs.txt").exists()


def test_other_collections_are_told_by_an_example_of_their_names(folder, synthetic, tmp_path, capsys):
    output = tmp_path / "pairs.txt"
    assert run(folder, output, "from-model", "--model", synthetic / "model") == (ERROR, [])
    text = told(capsys)
    assert f"the model in '{synthetic / 'model'}' has 0 of the 6 images with a pose; expected two or more" in text
    assert "those of the folder like 'view02.jpg'" in text
    assert run(folder, output, "from-file", "--file", synthetic / "database.db") == (ERROR, [])
    assert "has matches of no pair of the 6 images (it has '" in told(capsys)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["photos/view02.jpg/global_descriptor"] = np.ones(4)
    assert run(folder, output, "retrieval", "--descriptors", tmp_path / "x.h5") == (ERROR, [])
    assert "for none of the 6 images (it holds 'photos', the images are like 'view02.jpg')" in told(capsys)


def test_a_model_without_points_gives_no_pair(folder, room, tmp_path, capsys):
    write_ground_truth(tmp_path, list(room.views.values()))
    assert run(folder, tmp_path / "pairs.txt", "from-model", "--model", tmp_path) == (ERROR, [])
    assert "no two images of the model share 1 points; lower --min-score" in told(capsys)


def test_one_image_makes_no_pair(tmp_path, capsys):
    write_images(tmp_path / "images", ["a.png"])
    assert run(tmp_path, tmp_path / "pairs.txt", "exhaustive") == (ERROR, [])
    assert "has 1 image that can be used; a pair needs two" in told(capsys)
