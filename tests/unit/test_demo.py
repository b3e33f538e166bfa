"""The demo: which pairs it draws, and what it says at its end."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from sgam_core.types import Area, AreaMatch, Box, Matches, PairResult
from sgam_sfm import demo
from sgam_sfm.evaluation.pose_errors import PoseErrors
from sgam_sfm.options import MatchOptions
from sgam_sfm.runs.store import PairRecord

BOX = Box(x0=0, y0=0, x1=10, y1=10)


def record(pair, *kinds):
    areas = tuple(
        AreaMatch(area0=Area(box=BOX, kind=kind), area1=Area(box=BOX, kind=kind), distance=0.0) for kind in kinds
    )
    result = PairResult(
        matches=Matches.empty(),
        areas=areas,
        two_view=None,
        coverage0=0.0,
        coverage1=0.0,
        whole_scale0=1.0,
        whole_scale1=1.0,
    )
    return PairRecord(pair=pair, result=result)


def test_pairs_with_semantic_areas_are_drawn_first(monkeypatch, tmp_path):
    records = [
        record(("a.jpg", "b.jpg"), "guided", "guided", "guided"),
        record(("a.jpg", "c.jpg"), "object"),
        record(("d.jpg", "e.jpg"), "object", "intersection"),
        record(("b.jpg", "f.jpg"), "guided"),
        PairRecord(pair=("g.jpg", "h.jpg"), result=None, error="failed"),
    ]
    monkeypatch.setattr(demo, "read_pairs_of", lambda folder: records)
    monkeypatch.setattr(demo, "open_results", lambda folder: None)
    monkeypatch.setattr(demo, "collection_picture", lambda results: None)
    monkeypatch.setattr(demo, "pair_picture", lambda results, pair: None)
    monkeypatch.setattr(demo, "save_picture", lambda figure, path: None)
    drawn = demo.draw_pictures(MatchOptions(images=tmp_path, output=tmp_path), tmp_path)
    assert [path.name for path in drawn] == ["collection.png", "d-e.png", "a-c.png", "b-f.png", "a-b.png"]


@pytest.mark.parametrize("models", [[{}], []])
def test_it_ends_with_what_was_made_and_how_to_look_at_it(monkeypatch, tmp_path, models):
    output = tmp_path / "my demo"
    for folder in ("scene/images", "sgam"):
        (output / folder).mkdir(parents=True)
    for name in ("scene/pairs.txt", "scene/images/view00.jpg"):
        (output / name).touch()
    errors = PoseErrors(
        num_images=14,
        median_center=0.005,
        max_center=0.01,
        median_rotation_deg=0.06,
        max_rotation_deg=0.1,
        worst="view03.jpg",
    )
    monkeypatch.setattr(demo, "match_collection", lambda options, stages: {"models": models})
    monkeypatch.setattr(demo, "print_summary", lambda summary, console: None)
    monkeypatch.setattr(demo, "draw_pictures", lambda options, folder: [Path("pictures/a.png")])
    monkeypatch.setattr(demo, "compare_poses", lambda model, truth: errors)
    monkeypatch.setattr(demo, "write_json", lambda path, content: content)
    file = io.StringIO()
    demo.run_demo(output, "cpu", 0, Console(file=file))
    lines = file.getvalue().splitlines()
    assert {"picture    pictures/a.png", f"database   {output}/sgam/database.db"} <= set(lines)
    told = [line for line in lines if line.startswith("truth      camera centres off by 5.0 mm, ")]
    assert [line.endswith("; furthest off is view03.jpg, by 10.0 mm") for line in told] == [True] * len(models)
    assert (f"model      {output}/sgam/sparse/0" in lines) is bool(models)
    look = f"colmap gui --database_path '{output}/sgam/database.db' --image_path '{output}/scene/images'"
    look += f" --import_path '{output}/sgam/sparse/0'" if models else ""
    assert f"next       where COLMAP is installed, in three dimensions: {look}" in lines
    assert lines[-1].endswith(f"sgam-sfm show '{output}/sgam' view00.jpg")
