"""What the benchmark of run time makes of its figures."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest

from sgam_sfm.options import MatchOptions
from tests.room import Room, write_room

SCRIPTS = Path(__file__).parents[2] / "scripts"
OPTIONS = MatchOptions(images=Path("photos"), output=Path("out"))


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("bench_runtime")


def figures(seconds: float, megapixels: float, **more: float) -> dict[str, float]:
    rest = {"Merging keypoints": 1.0, "Verifying pairs": 2.0, "Mapping": 7.0}
    return {"matching pairs": seconds, "Mpx matched": megapixels, "Mpx extracted": 1.0} | rest | more


def test_targets_are_ratios_to_whole_images(bench):
    variants = {
        "none 1024": figures(10.0, 20.0),
        "fast": figures(14.0, 28.0, **{"area matching": 0.2}),
        "none@fast": figures(15.0, 30.0),
    }
    once = {"reading inputs": 1.0, "segmenting images": 5.0, "describing an image": 0.03}
    found = {target["name"]: target for target in bench.targets(variants, once, 10, ["fast"], OPTIONS)}
    assert {name: (pytest.approx(target["value"]), target["met"]) for name, target in found.items()} == {
        "fast, time per matched pixel over plain's at the same pixel budget": (1.0, True),
        "fast, time per matched pixel over plain's at the same input size": (1.0, True),
        "fast, time over plain's at the same input size": (1.4, True),
        "fast with segmentation, time over plain's at the same input size": (1.9, False),
        "fast, share of area description and matching in the run": (0.5 / 30, True),
        "segmentation, seconds an image": (0.5, True),
    }


def test_it_measures_every_stage_of_every_variant(bench, room: Room, tmp_path, monkeypatch, capsys):
    """One pair of small images; times are whatever they are."""
    folder = write_room(room, tmp_path / "room")
    monkeypatch.setattr(
        bench, "scene_options", lambda scene: ["--images", str(scene / "images"), "--ground-truth", "."]
    )
    monkeypatch.setattr(bench, "LARGEST", 640)
    files = ["--no-mapping", "--labels", str(folder / "labels"), "--cameras", str(folder / "cameras.txt")]
    command = ["bench_runtime", str(folder), str(tmp_path / "out"), "--pairs", "1", "--presets", "fast", "--", *files]
    monkeypatch.setattr(sys, "argv", command)
    bench.main()
    printed = capsys.readouterr().out.splitlines()
    content = json.loads(printed[-1])
    assert printed[0].startswith("| stage | none 1024 | fast | none@fast |")
    assert content["pairs"] == 1
    for name, variant in content["variants"].items():
        assert variant["Mpx matched"] > 0, name
        assert 0 < variant["extracting"] < variant["matching pairs"], name
        assert variant["Verifying pairs"] > 0, name
    assert len(content["targets"]) == 6
