"""The tutorials work: their commands run in order on the rendered room, and leave what the pages say."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import h5py
import numpy as np
import PIL.Image
import pycolmap
import pytest

from sgam_core.errors import InputError
from sgam_sfm.colmap.reading import database_content
from sgam_sfm.images import inspect_image
from sgam_sfm.pairs import read_pairs
from tests.textures import similarity, transfer, view, whole
from tests.tutorials import DOCS, ROOT, Block, blocks, follow

PHOTOS = [f"view{number:02}.jpg" for number in (2, 3, 4)]
MATCHES_OF_HLOC = "feats-superpoint-n4096-r1024_matches-superpoint-lightglue_pairs-netvlad.h5"


def summary_of(output: Path) -> dict:
    return json.loads((output / "summary.json").read_text())


def test_a_model_of_all_photos(tutorial):
    (model,) = summary_of(tutorial / "out")["models"]
    assert (model["registered"], model["total"]) == (3, 3)
    assert model["points"] > 300
    assert pycolmap.Reconstruction(tutorial / "out/sparse/0").num_cameras() == 1
    assert pycolmap.Reconstruction(tutorial / "out_global/sparse/0").num_reg_images() == 3
    assert {path.name for path in (tutorial / "out/pictures").iterdir()} == {
        "collection.png",
        "view03.jpg--view04.jpg.png",
    }


@pytest.fixture(scope="module")
def hloc(tutorial: Path) -> Path:
    """What hloc would have left in its export folder, in its layout."""
    folder = tutorial / "hloc"
    (folder / "sfm").mkdir(parents=True)
    (folder / "pairs-netvlad.txt").write_text("view02.jpg view03.jpg\nview03.jpg view02.jpg\nview04.jpg view03.jpg")
    with h5py.File(folder / "global-feats-netvlad.h5", "w") as file:
        for number, name in enumerate(PHOTOS):
            angle = 0.3 * number
            file[f"{name}/global_descriptor"] = np.array([np.cos(angle), np.sin(angle)], np.float16)
            file[f"{name}/image_size"] = np.array([640, 480])
    shutil.copy(tutorial / "out/matches.h5", folder / MATCHES_OF_HLOC)
    shutil.copy(tutorial / "out/database.db", folder / "sfm/database.db")
    return folder


def test_hlocs_files_are_taken_and_given_back(tutorial, hloc):
    before = database_content(hloc / "sfm/database.db")
    follow(DOCS / "tutorials/hloc.md", tutorial)
    pairs = summary_of(tutorial / "out_hloc")["pairs"]
    assert (pairs["listed"], pairs["matched"]) == (2, 2)
    assert summary_of(tutorial / "out_hloc")["models"][0]["registered"] == 3
    for name, pairs in (("retrieved.txt", 3), ("matched.txt", 3)):
        assert len(read_pairs(tutorial / name, PHOTOS).pairs) == pairs
    assert pycolmap.Reconstruction(tutorial / "remapped/sparse/0").num_reg_images() == 3
    after = database_content(hloc / "sfm/database.db")
    for name in PHOTOS:
        kept = len(before["keypoints"][name])
        assert len(after["keypoints"][name]) > kept
        np.testing.assert_array_equal(after["keypoints"][name][:kept], before["keypoints"][name])


def test_the_folder_for_splatting_has_what_trainers_ask_for(splat):
    for folder, width in (("images", 400), ("images_2", 200), ("images_4", 100)):
        assert sorted(path.name for path in (splat / folder).iterdir()) == PHOTOS
        with PIL.Image.open(splat / folder / PHOTOS[0]) as image:
            assert width < image.width < 2 * width
    assert {path.name for path in (splat / "sparse/0").iterdir()} >= {"cameras.bin", "images.bin", "points3D.bin"}


def test_the_script_can_be_run_again(tutorial, splat):
    subprocess.run([sys.executable, "undistort.py", "out/sparse/0", "photos", splat.name], cwd=tutorial, check=True)
    assert (splat / "sparse/0/points3D.bin").is_file()
    assert not (splat / "sparse/points3D.bin").exists()


def test_a_package_of_its_own_brings_a_matcher_and_a_segmenter(tutorial, tmp_path):
    commands = follow(DOCS / "tutorials/plugins.md", tutorial, packages=tmp_path / "packages")
    assert commands[0].startswith("pip install")
    assert (tmp_path / "packages/orb_matcher.py").exists()
    summary = summary_of(tutorial / "out_orb")
    assert summary["models"][0]["registered"] >= 3
    options = json.loads((tutorial / "out_orb/options.json").read_text())
    assert (options["matcher"], options["segmenter"]) == ("orb", "hues")
    labels = json.loads((tutorial / "out_orb/labels/labels.json").read_text())
    assert labels["segmenter"] == "hues"


def example(name: str) -> ModuleType:
    """A module of the package, without installing it."""
    spec = spec_from_file_location(name, DOCS / f"plugin_example/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_matcher_of_the_page_keeps_to_the_protocol():
    warp = similarity(1.1, 6, (7.3, -4.6), (160, 120))
    first, second = (view(each, (320, 240)) for each in (np.eye(3), warp))
    left = np.arange(320) < 160
    crops = (whole(first, "first"), whole(second, "second"))
    masked = (whole(first, "half", np.tile(left, (240, 1))), crops[1])
    blank = whole(np.full((100, 200, 3), 90, np.uint8), "gray")
    matches, halved, none = example("orb_matcher").Orb().match([crops, masked, (blank, blank)])
    distances = np.linalg.norm(transfer(warp, matches.points0) - matches.points1, axis=1)
    assert (distances < 2).sum() > 100
    assert np.median(distances[distances < 2]) < 0.8
    assert len(halved) > 20
    assert left[halved.points0[:, 0].astype(int)].all()
    assert len(none) == 0


def test_the_segmenter_of_the_page_gives_equal_hues_equal_labels(tmp_path):
    for name, colours in {"a.png": [(200, 30, 30), (128, 128, 128)], "b.png": [(30, 30, 200), (210, 40, 40)]}.items():
        PIL.Image.fromarray(np.repeat(np.array([colours], np.uint8), 40, axis=1).repeat(60, axis=0)).save(
            tmp_path / name
        )
    (tmp_path / "c.png").write_bytes((tmp_path / "a.png").read_bytes())
    files = [inspect_image(tmp_path, name) for name in ("a.png", "b.png", "c.png")]
    (tmp_path / "c.png").write_bytes(b"broken since")
    shares = []
    (_, a), (_, b), (_, c) = example("hue_segmenter").Hues().segment(files, shares.append)
    assert shares == [1.0, 1.0, 1.0]
    assert a[30, 10] == b[30, 70] > 0
    assert a[30, 70] == 0
    assert b[30, 10] not in (0, a[30, 10])
    assert isinstance(c, InputError)


def test_the_page_shows_the_package_as_it_is():
    shown = {block.title: block.text for block in blocks(DOCS / "tutorials/plugins.md") if block.title}
    package = {
        f"plugin_example/{path.name}": path.read_text()
        for path in (DOCS / "plugin_example").iterdir()
        if path.is_file()
    }
    assert shown == package


def test_the_readme_shows_the_same_matcher():
    assert (DOCS / "plugin_example/orb_matcher.py").read_text() in [block.text for block in blocks(ROOT / "README.md")]


def test_commands_of_the_home_page_run(tmp_path, capsys):
    assert follow(DOCS / "index.md", tmp_path) == ["sgam-sfm --help"]
    assert "Semantic area-to-point matching" in capsys.readouterr().out


def test_a_command_that_fails_fails_the_page(tmp_path):
    page = tmp_path / "page.md"
    for command, code in (("sgam-sfm status nowhere", 1), ("sgam-sfm match --imagez photos", 2), ("false", 1)):
        page.write_text(f"```sh\n{command}\n```\n")
        with pytest.raises(AssertionError, match=f"page.md: `{command}` ended with exit code {code}"):
            follow(page, tmp_path)


def test_lines_that_go_on_are_one_command():
    assert Block("sh", "", "a \\\n  b\n\nc\n").commands == ["a    b", "c"]


def test_no_tutorial_is_left_out():
    assert {path.name for path in (DOCS / "tutorials").iterdir()} == {
        "photos.md",
        "hloc.md",
        "splatting.md",
        "plugins.md",
    }
    assert (ROOT / "mkdocs.yml").is_file()
