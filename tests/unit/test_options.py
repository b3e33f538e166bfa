"""Options from files: misspelt, of another type, of another version; what options.json holds."""

import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import get_args

import pytest

from sgam_core import PRESETS
from sgam_core.errors import OptionError
from sgam_core.options import CropOptions, changed
from sgam_sfm import cli
from sgam_sfm.exit_codes import DONE
from sgam_sfm.options import (
    VERSION,
    MatchOptions,
    Preset,
    as_json,
    fingerprint,
    fingerprint_of_points,
    starting_options,
)


def written(tmp_path: Path, content: object, name: str = "c.json") -> Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"matchr": "loftr"}, "option 'matchr' is unknown; did you mean 'matcher'?"),
        ({"crop": {"area_sise": 3}}, "option 'crop.area_sise' is unknown; did you mean 'crop.area_size'?"),
        ({"zzz": 1}, "option 'zzz' is unknown"),
        ({"seed": "many"}, "option 'seed' is 'many': Input should be a valid integer, unable to parse string as an"),
        ({"mapping": [1]}, "option 'mapping' is [1]: Input should be a valid boolean"),
        (
            {"mapper": "colmap"},
            "option 'mapper' is 'colmap': Input should be 'incremental', 'global' or 'hierarchical'",
        ),
        ({"preset": "papr"}, "preset 'papr' is unknown; did you mean 'paper'? known: default, fast, paper"),
        ([1, 2], "holds a list; expected options by name"),
        ("{", "cannot be used ("),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_what_is_wrong(tmp_path, content, expected):
    path = written(tmp_path, content)
    with pytest.raises(OptionError) as error:
        starting_options(path, None)
    assert str(error.value).startswith(f"--config '{path}'")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_of_another_version_says_so_when_it_does_not_fit(tmp_path):
    path = written(tmp_path, {VERSION: "9.0", "hologram": True})
    with pytest.raises(OptionError) as error:
        starting_options(path, None)
    assert str(error.value) == (
        f"--config '{path}': option 'hologram' is unknown; it was written by sgam-sfm 9.0, not this version"
    )
    assert starting_options(written(tmp_path, {VERSION: "9.0", "seed": 3}), None).seed == 3


def test_toml_with_dashes_and_a_preset_below_it(tmp_path):
    path = written(tmp_path, 'preset = "scannet"\nblock-images = 4\n[crop]\narea-size = 320\n', "c.toml")
    options = starting_options(path, None)
    assert (options.preset, options.block_images, options.crop.area_size) == ("scannet", 4, 320)
    assert options.collection.min_coverage == 0.6
    assert starting_options(path, "paper").collection.min_coverage == 0.3


def test_crop_options_stand_at_the_top_as_their_flags_do(tmp_path):
    assert starting_options(written(tmp_path, "image-size = 1600\n", "c.toml"), None).crop.image_size == 1600
    with pytest.raises(OptionError, match=r"option 'image-sizee' is unknown; did you mean 'image_size'\?$"):
        starting_options(written(tmp_path, "image-sizee = 1600\n", "c.toml"), None)
    with pytest.raises(OptionError, match=r"no.toml' does not exist; give a TOML or JSON file$"):
        starting_options(tmp_path / "no.toml", None)


def test_written_options_read_back_and_have_absolute_paths(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = MatchOptions(images=Path("photos"), output=Path("out"), weights=Path("outdoor"), seed=5)
    content = as_json(options)
    assert content["images"] == str(tmp_path / "photos")
    assert content["weights"] == "outdoor"  # a name, since there is no such file
    read = starting_options(written(tmp_path, content | {"fingerprint": "x"}), None)
    assert as_json(read) == content


def test_presets_are_those_that_can_be_named():
    assert set(get_args(Preset)) == set(PRESETS)
    fast, default = PRESETS["fast"], PRESETS["default"]
    assert fast.crop.image_size == default.crop.image_size  # what its time is compared at
    assert fast.crop.max_crop_pixels < default.crop.max_crop_pixels / 2
    assert fast.geometry == default.geometry


def test_results_follow_from_the_content_of_masks_and_maps(tmp_path):
    masks = tmp_path / "masks"
    (masks / "left").mkdir(parents=True)
    (masks / "left" / "a.jpg.png").write_bytes(b"1")
    options = MatchOptions(images=Path("a"), output=Path("out"), mask_path=masks)
    before = fingerprint(options), fingerprint_of_points(options)
    assert (fingerprint(options), fingerprint_of_points(options)) == before
    (masks / "notes.txt").write_text("no mask")
    assert (fingerprint(options), fingerprint_of_points(options)) == before
    (masks / "left" / "a.jpg.png").write_bytes(b"other")
    assert fingerprint(options) != before[0]
    assert fingerprint_of_points(options) != before[1]


def test_masks_by_labels_decide_points_and_areas_alone_do_not():
    plain, masked = (MatchOptions(images=Path("a"), output=Path("out"), mask_matches=mask) for mask in ("", "1"))
    assert fingerprint_of_points(plain) == fingerprint_of_points(replace(plain, num_labels=9))
    assert fingerprint_of_points(masked) != fingerprint_of_points(replace(masked, num_labels=9))
    assert fingerprint_of_points(plain) == fingerprint_of_points(changed(plain, crop__area_size=9))


@pytest.mark.parametrize(("size", "pixels"), [((3072, 2048), 4000), ((2000, 3000), 4000), ((500, 500), 6000)])
def test_areas_have_pixels_in_proportion_to_whole_images(size, pixels):
    assert CropOptions(max_crop_pixels=4000).of_shapes(size, size).max_crop_pixels == pixels
    assert CropOptions(max_crop_pixels=4000).of_shapes(size, (200, 300)).max_crop_pixels == (pixels + 4000) / 2


@pytest.mark.parametrize("name", ["area_size", "image_size"])
def test_crops_have_a_size(name):
    with pytest.raises(OptionError, match=f"{name} is 0; expected at least 1 pixel"):
        CropOptions(**{name: 0})


def test_no_shape_turns_a_limit_of_pixels_into_none():
    assert CropOptions(max_crop_pixels=0).of_shapes((1, 1), (9, 4)).max_crop_pixels == 0
    assert CropOptions(max_crop_pixels=1).of_shapes((1, 9999), (1, 9999)).max_crop_pixels == 1


def test_results_follow_from_images_not_from_where_they_are(tmp_path):
    here = MatchOptions(images=Path("a"), output=Path("out"), verbose=True)
    there = MatchOptions(images=Path("b"), output=Path("other"), threads=3)
    assert fingerprint(here, images={"x": "1"}) == fingerprint(there, images={"x": "1"})
    assert fingerprint(here, images={"x": "1"}) != fingerprint(here, images={"x": "2"})
    assert fingerprint(here) != fingerprint(MatchOptions(images=Path("a"), output=Path("out"), seed=1))
    assert fingerprint(here) != fingerprint(MatchOptions(images=Path("a"), output=Path("out"), precision="full"))


def test_the_version_is_told(capsys):
    assert cli.run(["--version"]) == DONE
    assert capsys.readouterr().out == f"{version('sgam-sfm')}\n"
