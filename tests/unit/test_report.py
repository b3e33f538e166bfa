"""The report of a comparison, of folders that no matcher has made: what it holds, its bounds, and what it survives."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from html.parser import HTMLParser
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from sgam_core.types import Area, AreaMatch, Box, Matches, PairResult
from sgam_sfm.colmap.database import write_database
from sgam_sfm.colmap.image_import import CameraOptions, import_cameras
from sgam_sfm.comparison.figures import FIGURES
from sgam_sfm.comparison.harder import Window
from sgam_sfm.comparison.report import Bounds, geometry, plots, table, write_report
from sgam_sfm.comparison.report.gallery import extremes, make_gallery, thumbnails
from sgam_sfm.comparison.report.runs import MethodRun, PairFacts, read_matches, read_run
from sgam_sfm.evaluation.sfm_metrics import Similarity
from sgam_sfm.runs.store import PairRecord, PairStore

NAMES = ("\"&'.jpg", "<script>.jpg", "c.jpg", "sub/d.jpg")
WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
AREA = AreaMatch(
    area0=Area(box=Box(x0=20, y0=20, x1=200, y1=160), kind="object", label=1),
    area1=Area(box=Box(x0=30, y0=30, x1=210, y1=170), kind="object", label=1),
    distance=0.1,
    scale0=1.0,
    scale1=1.0,
)
METHODS = ("sgam:xfeat-star", "none:xfeat-star", "sift", "tiles:xfeat-star")
FEW = Bounds(gallery=1, picture_width=400)
SLUGS = ("sgam_xfeat-star", "none_xfeat-star", "sift", "tiles_xfeat-star")


def poses() -> dict[str, np.ndarray]:
    """cam_from_world (3, 4): along x, the last one close to the points."""
    centres = [(-0.6, 0, 0), (0, 0, 0), (0.6, 0.1, 0), (0.2, 0, 2.5)]
    turns = Rotation.from_euler("y", [[6], [0], [-6], [0]], degrees=True).as_matrix()
    return {name: np.column_stack([R, -R @ c]) for name, R, c in zip(NAMES, turns, centres, strict=True)}


def world() -> np.ndarray:
    return np.random.default_rng(1).uniform((-0.5, -0.4, 4.2), (0.9, 0.4, 6), (80, 3))


def pixels(name: str) -> np.ndarray:
    projected = (world() @ poses()[name][:, :3].T + poses()[name][:, 3]) @ K.T
    return projected[:, :2] / projected[:, 2:]


def write_model(folder: Path, similarity: Similarity | None = None, points: bool = True) -> None:
    """The truth as a COLMAP text model, in the frame that the similarity takes it to."""
    move = similarity or Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))
    folder.mkdir(parents=True)
    lines = []
    for number, (name, pose) in enumerate(poses().items(), start=1):
        rotation = pose[:, :3] @ move.rotation.T
        centre = move((-pose[:, :3].T @ pose[:, 3])[None])[0]
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        numbers = " ".join(f"{value:.12f}" for value in (w, x, y, z, *(-rotation @ centre)))
        seen = [f"{u:.6f} {v:.6f} {index + 1}" for index, (u, v) in enumerate(pixels(name))] if points else []
        lines.append(f"{number} {numbers} 1 {name}\n{' '.join(seen)}\n")
    tracks = [
        f"{row + 1} {' '.join(map(str, point))} 9 9 9 0.1 "
        + " ".join(f"{image + 1} {row}" for image in range(len(NAMES)))
        for row, point in enumerate(move(world()))
    ]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("\n".join(tracks) + "\n" if points else "")


def write_images(folder: Path) -> None:
    rng = np.random.default_rng(0)
    for name in NAMES:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        small = rng.integers(0, 255, (12, 16, 3), np.uint8)
        PIL.Image.fromarray(small).resize((WIDTH, HEIGHT)).save(folder / name)


def write_database_of(folder: Path, images: Path, inliers: int) -> None:
    """All points matched in every pair; so many of them are inliers, fewer by one with every pair."""
    import_cameras(folder / "database.db", images, NAMES, CameraOptions(model="PINHOLE"))
    rows = np.repeat(np.arange(80, dtype=np.uint32)[:, None], 2, axis=1)
    pairs = list(combinations(NAMES, 2))
    keypoints = {name: pixels(name).astype(np.float32) for name in NAMES}
    write_database(folder / "database.db", folder / "database.db", keypoints, dict.fromkeys(pairs, rows))
    with pycolmap.Database.open(folder / "database.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for less, (a, b) in enumerate(pairs):
            geometry = pycolmap.TwoViewGeometry(config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
            geometry.inlier_matches = rows[: inliers - less * (inliers > 30)]
            database.write_two_view_geometry(ids[a], ids[b], geometry)


def write_store(folder: Path, images: Path, *, areas: bool) -> None:
    def record(pair: tuple[str, str]) -> PairRecord:
        points = [pixels(name) for name in pair]
        result = PairResult(
            matches=Matches(points0=points[0], points1=points[1], scores=np.ones(80, np.float32)),
            areas=(AREA,) if areas else (),
            two_view=None,
            coverage0=0.5 * areas,
            coverage1=0.25 * areas,
            whole_scale0=1.0,
            whole_scale1=1.0,
        )
        return PairRecord(pair=pair, result=result)

    # The other way round than the database has them.
    PairStore(folder=folder / "pairs", fingerprint="").write(0, [record((b, a)) for a, b in combinations(NAMES, 2)])
    options = {"images": str(images), "area_matcher": "sgam" if areas else "none", "matcher": "xfeat-star"}
    (folder / "options.json").write_text(json.dumps(options))


def write_comparison(output: Path, images: Path, truth: Path | None) -> dict[str, Any]:
    """SGAM and the plain matcher with models, SIFT with a database and a model only, and tiles that found nothing."""
    write_images(images)
    if truth is not None:
        write_model(truth, points=False)
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    elsewhere = Similarity(scale=3.0, rotation=turn, translation=np.array([5.0, 0, 1]))
    for slug, inliers in zip(SLUGS, (60, 30, 40), strict=False):
        (output / slug).mkdir(parents=True)
        write_database_of(output / slug, images, inliers)
        write_model(output / slug / "sparse" / "0", elsewhere if slug != "sift" else None)
    write_store(output / SLUGS[0], images, areas=True)
    write_store(output / SLUGS[1], images, areas=False)
    (output / SLUGS[3]).mkdir()
    content = {
        "version": 1,
        "collection": {
            "images": str(images),
            "hard": "",
            "names": sorted(NAMES),
            "num_pairs": 6,
            "ground_truth": None if truth is None else {"path": str(truth), "format": "colmap", "unit": "metres"},
        },
        "reference": SLUGS[1],
        "methods": [method_content(number, truth is not None) for number in range(4)],
        "versions": {"sgam-sfm": "0.1.0"},
    }
    (output / "compare.json").write_text(json.dumps(content))
    return content


def method_content(number: int, truth: bool) -> dict[str, Any]:
    failed = METHODS[number].startswith("tiles")
    values = {"registered": 4, "points": 1000 + 10 * number, "reprojection_error_px": 0.5, "megapixels_matched": 3.0}
    values |= {"auc_1": 80.0 - 5 * number} if truth else {}
    names = [figure.name for figure in FIGURES if truth or not figure.name.startswith(("auc", "center", "rotation"))]
    figures = {name: None if failed or name not in values else values[name] for name in names}
    if METHODS[number] == "sift":
        figures["megapixels_matched"] = None
    spread = {name: None if value is None else {"mean": value, "spread": None} for name, value in figures.items()}
    times = {"matching_seconds": 3.0 + number, "total_seconds": 10.0, "peak_memory_mb": None}
    verdict = "" if METHODS[number].startswith("none") else ("gain", "", "loss", "tie")[number]
    return {
        "name": METHODS[number],
        "slug": SLUGS[number],
        "figures": spread,
        "verdicts": {name: verdict if spread[name] else "" for name in names},
        "times": {name: None if value is None else {"mean": value, "spread": None} for name, value in times.items()},
        "cap": "the images' own resolution" if failed else "",
        "runs": [
            {
                "seed": 0,
                "folder": "elsewhere",
                "figures": figures,
                "times": times | {"stages": {"Matching pairs": 3.0 + number, "Mapping": 5.0}},
                "images_per_track": {} if failed else {"4": 70, "2": 10, "90": 3},
                "no_model": "no pair was verified" if failed else "",
                "fallbacks": {"no geometry": 2} if number == 0 else {},
            }
        ],
    }


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("report")
    output = folder / "out \"&' <b>"
    content = write_comparison(output, folder / "<images>", folder / "truth")
    write_report(output, content)
    return output, content


class Page(HTMLParser):
    """Every tag with its attributes, the texts of elements, and the data of the plots."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self._script = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        tag, attributes = self.tags[-1] if self.tags else ("", {})
        if tag == "script" and attributes.get("id") == "data" and not self._script:
            self._script = data
        elif tag not in ("script", "style") and data.strip():
            self.texts.append(re.sub(r"\s+", " ", data.strip()))

    def attributes(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self) -> str:
        return " ".join(self.texts)

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self._script)


@pytest.fixture(scope="module")
def page(compared) -> Page:
    return Page(compared[0] / "report.html")


def decoded(uri: str | None) -> PIL.Image.Image:
    return PIL.Image.open(io.BytesIO(base64.b64decode((uri or "").partition(",")[2])))


class TestPage:
    def test_is_one_file_that_needs_no_other(self, compared, page):
        assert not [a for a in page.attributes("script") if "src" in a]
        assert not [a for a in page.attributes("link") if not (a["href"] or "").startswith("data:")]
        assert all(a["src"].startswith("data:image/webp") for a in page.attributes("img") if "src" in a)
        text = (compared[0] / "report.html").read_text()
        assert text.count("plotly.js v") == 1
        assert len(text) < 8e6

    def test_names_are_texts_and_no_tags(self, compared, page):
        text = (compared[0] / "report.html").read_text()
        assert "<script>.jpg" not in text
        assert "<b>" not in [a for a in page.texts if a.startswith("out")]
        assert page.texts[0] == "out \"&' <b> - comparison of 4 methods"
        assert "<images>" in page.text
        assert "<script>.jpg - c.jpg" in page.text
        assert page.data["names"] == list(NAMES)
        assert len(page.attributes("script")) == 3

    def test_verdicts_are_told_by_words_and_marks(self, page):
        assert "▲ gain" in page.text
        assert "▼ loss" in page.text
        assert {a.get("scope") for a in page.attributes("th")} == {"col", "row", "rowgroup"}
        assert "-5.0" in page.text
        assert {a.get("class") for a in page.attributes("td")} >= {"gain", "loss"}

    def test_pictures_have_texts(self, page):
        pictures = [a for a in page.attributes("img") if "src" in a]
        assert len(pictures) == 6
        assert all(a["alt"] and a["loading"] == "lazy" and a["decoding"] == "async" for a in pictures)
        picture = np.asarray(decoded(pictures[0]["src"]))
        assert picture.shape[1] == 1200
        assert (picture[:, :8] > 235).all()  # the margin of a picture that is whole
        assert (picture.reshape(-1, 3).min(axis=1) < 200).any()

    def test_says_what_is_missing_and_bounded(self, page):
        assert "no model: no pair was verified" in page.text
        assert "its budget could not be met" in page.text
        assert "2 pairs matched as whole images: no geometry" in page.text
        for sentence in Bounds().sentences():
            assert sentence in page.text

    def test_has_the_data_of_every_plot(self, page):
        data = page.data
        assert data["methods"] == list(METHODS)
        assert data["reference"] == 1
        assert [trace["method"] for trace in data["curves"]] == [0, 1, 2, 3]
        assert data["curves"][0]["y"][-1] == 100
        assert max(data["curves"][0]["x"]) < 0.1  # the models are the truth but for a similarity
        assert set(data["curves"][3]["x"][1:]) == {180}  # no model
        assert [trace["method"] for trace in data["scene"]] == [None, 0, 1, 2]
        assert [trace["method"] for trace in data["coverage"]] == [0]
        assert data["coverage"][0]["y"] == [37.5] * 6
        assert data["stages"] == {"Matching pairs": [3, 4, 5, 6], "Mapping": [5] * 4, "Looked-up matches": [2, 1, 0, 0]}
        assert data["tracks"][0] == {"method": 0, "x": [2, 4, 50], "y": [10, 70, 3]}
        assert sorted(map(int, data["thumbnails"])) == [0, 1, 2, 3]

    def test_two_view_errors_come_from_the_raw_matches(self, page):
        by_scale = page.data["by_scale"]
        for trace in by_scale[:3]:
            assert len(trace["x"]) == 6
            assert max(trace["y"]) < 0.5
        assert set(by_scale[3]["y"]) == {180}
        close = [x for x, pair in zip(by_scale[0]["x"], by_scale[0]["pairs"], strict=True) if 3 in pair]
        assert min(close) > 1.5
        assert max(x for x in by_scale[0]["x"] if x not in close) < 1.2
        assert 2 < min(page.data["by_angle"][0]["x"]) < max(page.data["by_angle"][0]["x"]) < 25

    def test_matrices_hold_every_pair(self, page):
        matrices = page.data["matrices"]
        assert matrices["cells"] == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]
        assert matrices["matches"] == [[80] * 6] * 3 + [[0] * 6]
        assert matrices["inliers"] == [[60, 59, 58, 57, 56, 55], [30] * 6, [40, 39, 38, 37, 36, 35], [0] * 6]

    def test_is_the_same_every_time(self, compared):
        output, content = compared
        before = (output / "report.html").read_bytes()
        assert write_report(output, content) == output / "report.html"
        assert (output / "report.html").read_bytes() == before


class TestWithoutSomething:
    @pytest.fixture
    def written(self, tmp_path):
        output = tmp_path / "out"
        return output, write_comparison(output, tmp_path / "images", None)

    def test_no_ground_truth(self, written):
        page = Page(write_report(*written, FEW))
        assert "there is no ground truth" in page.text
        assert "need the truth: no ground truth was given" in page.text
        assert "AUC@1" not in page.text
        assert page.data["curves"] == page.data["by_angle"] == []
        # Aligned to the reference, which stays where it is: all three are the same cameras.
        scene = page.data["scene"]
        assert [trace["method"] for trace in scene] == [0, 1, 2]
        np.testing.assert_allclose(scene[0]["cameras"], scene[1]["cameras"], atol=2e-3)
        np.testing.assert_allclose(scene[2]["cameras"], scene[1]["cameras"], atol=2e-3)

    def test_ground_truth_that_has_gone(self, written):
        output, content = written
        gone = {"path": str(output / "gone"), "format": "colmap", "unit": "metres"}
        content["collection"]["ground_truth"] = gone
        assert (
            "need the truth: the ground truth is no longer where it was"
            in Page(write_report(output, content, FEW)).text
        )

    def test_images_that_have_gone(self, written):
        output, content = written
        shutil.rmtree(content["collection"]["images"])
        page = Page(write_report(output, content, FEW))
        assert page.data["thumbnails"] == {}
        assert page.text.count("No picture:") == 2

    def test_no_model_at_all(self, written):
        output, content = written
        for slug in SLUGS[:3]:
            shutil.rmtree(output / slug / "sparse")
        page = Page(write_report(output, content, FEW))
        assert page.data["scene"] == []
        assert "No method has a model." in page.text

    def test_a_model_that_cannot_be_aligned(self, written):
        output, content = written
        images = output / SLUGS[2] / "sparse" / "0" / "images.txt"
        images.write_text(re.sub(r"(?m) 1 (\S+jpg)$", r" 1 other-\1", images.read_text()))
        page = Page(write_report(output, content, FEW))
        assert "its model shares too few images to be aligned" in page.text
        assert [trace["method"] for trace in page.data["scene"]] == [0, 1]

    def test_one_method_alone(self, written):
        output, content = written
        alone = content | {"methods": content["methods"][2:3], "reference": "sift"}
        page = Page(write_report(output, alone, FEW))
        assert "too few pairs or methods for a gallery" in page.text
        assert "No method has areas" in page.text

    def test_sift_as_the_reference_has_matches_in_the_gallery(self, written):
        output, content = written
        methods = content["methods"]
        page = Page(write_report(output, content | {"methods": methods[:1] + methods[2:3], "reference": "sift"}, FEW))
        assert sum("and beneath sift" in (a["alt"] or "") for a in page.attributes("img")) == 2

    def test_a_reference_with_areas_has_pictures_of_its_own(self, written):
        output, content = written
        both = content | {"methods": content["methods"][:2], "reference": SLUGS[0]}
        page = Page(write_report(output, both, FEW))
        assert len([a for a in page.attributes("img") if "src" in a]) == 4


def run_of(number: int, inliers: dict[tuple[str, str], int]) -> MethodRun:
    pairs = {pair: PairFacts(matches=2 * count, inliers=count) for pair, count in inliers.items()}
    return MethodRun(number=number, name=f"m{number}", folder=Path("no"), content={}, pairs=pairs)


class TestBounds:
    def test_gallery_shows_as_many_losses_as_gains(self):
        pairs = [("a", f"p{n:02d}") for n in range(20)]
        method = run_of(0, {pair: 100 + 10 * n for n, pair in enumerate(pairs)})
        reference = run_of(1, dict.fromkeys(pairs, 110))
        best, worst = extremes(method, reference, 6)
        assert best == pairs[:13:-1]
        assert worst == pairs[:6]
        assert extremes(method, run_of(1, {}), 2) == (pairs[:-3:-1], pairs[:2])
        few = run_of(0, dict.fromkeys(pairs[:3], 5))
        best, worst = extremes(few, run_of(1, {}), 6)
        assert len(best) == len(worst) == 1
        assert not {*best} & {*worst}
        assert make_gallery([few], few, Path("no"), Bounds()) is None

    def test_matrices_are_averaged_above_their_bound(self):
        names = [f"i{n:03d}" for n in range(10)]
        run = run_of(0, {(a, b): int(a[1:]) for a, b in combinations(names, 2)})
        found = plots.pair_matrices([run], names, Bounds(matrix_side=4))
        assert found["bins"] == [[0, 2], [3, 4], [5, 7], [8, 9]]
        assert max(map(max, found["cells"])) == 3
        assert sum(found["counts"]) == 45
        first = found["cells"].index([0, 1])
        assert (found["inliers"][0][first], found["counts"][first]) == (1, 6)
        assert found["matches"][0][first] == 2

    def test_curves_coverages_and_tracks(self):
        bounds = Bounds(curve_points=10, track_length=3)
        curve = plots.pose_curves({0: [n / 10 for n in range(1000)]}, bounds)[0]
        assert len(curve["x"]) == 11
        assert (curve["x"][-1], curve["y"][-1]) == (99.9, 100)
        pairs = {("a", f"p{n:03d}"): PairFacts(coverage=n / 500) for n in range(500)}
        run = MethodRun(number=0, name="m", folder=Path("no"), content={}, pairs=pairs)
        assert len(plots.coverages([run], ["a", *(b for _, b in pairs)], bounds)[0]["x"]) == 10
        method = {"runs": [{"images_per_track": {"2": 5, "3": 4, "7": 2}}]}
        assert plots.track_histograms([method], bounds) == [{"method": 0, "x": [2, 3], "y": [5, 6]}]

    def test_small_stages_are_put_together(self):
        stages = {"Matching": 90.0, "Reading": 0.5, "Cameras": 0.25}
        method = {"runs": [{"times": {"stages": stages, "total_seconds": 90.75}}]}
        assert plots.stage_seconds([method]) == {"Matching": [90], "Other": [0.75]}

    def test_thumbnails_points_and_pictures(self, compared):
        output, content = compared
        images = Path(content["collection"]["images"])
        assert list(thumbnails(NAMES, images, Bounds(thumbnails=2))) == [NAMES[0], NAMES[3]]
        model = geometry.read_model(output / "sift" / "sparse" / "0", Bounds(points=10))
        assert (len(model.points), model.num_points) == (10, 80)
        small = Bounds(points=10, cameras=2, gallery=1, thumbnails=1, pose_pairs=2, curve_images=3)
        page = Page(write_report(linked(output), content, small))
        assert len([a for a in page.attributes("img") if "src" in a]) == 2
        assert [len(trace["cameras"]) for trace in page.data["scene"]] == [2] * 4
        assert all(len(trace["points"][0]) <= 10 for trace in page.data["scene"])
        assert len(page.data["by_angle"][0]["x"]) == 2
        assert len(page.data["curves"][0]["x"]) == 4


def linked(output: Path) -> Path:
    """The same comparison under another name, so that its report is another file."""
    other = output.parent / "small"
    other.mkdir()
    for slug in SLUGS:
        (other / slug).symlink_to(output / slug)
    return other


class TestParts:
    def test_store_and_database_give_the_same_matches(self, compared):
        output, content = compared
        pair = (NAMES[0], NAMES[2])
        stored, native = (next(read_matches(output / slug, {pair})) for slug in (SLUGS[0], "sift"))
        assert stored.pair == native.pair == pair
        np.testing.assert_allclose(stored.points0, native.points0, atol=1e-3)
        np.testing.assert_allclose(stored.points1, pixels(NAMES[2]), atol=1e-3)
        run = read_run(output, 0, content["methods"][0])
        assert run.pairs[pair] == PairFacts(matches=80, inliers=59, coverage=0.375)
        assert list(read_matches(output / "nothing", {pair})) == []

    def test_images_without_a_pose_count_as_failed_in_the_curves(self, compared):
        output, content = compared
        true = geometry.true_views(content["collection"]["ground_truth"], NAMES)
        model = geometry.read_model(output / "sift" / "sparse" / "0", Bounds())
        three = geometry.Model(poses={n: model.poses[n] for n in NAMES[:3]}, points=model.points, num_points=80)
        errors = geometry.curve_errors(three, true.views, Bounds())
        assert max(errors[:3]) < 0.1
        assert errors[3:] == [180] * 3

    def test_true_cameras_follow_images_that_were_cut(self, compared):
        known = compared[1]["collection"]["ground_truth"]
        whole = geometry.true_views(known, NAMES[:1]).views[NAMES[0]]
        part = (whole.width // 2, whole.height // 2)
        window = Window(whole=(whole.width, whole.height), x0=10, y0=20, width=part[0], height=part[1], size=part)
        cut = geometry.true_views(known, NAMES[:1], {NAMES[0]: window}).views[NAMES[0]]
        assert (cut.width, cut.height) == part
        np.testing.assert_allclose(whole.camera_matrix[:2, 2] - cut.camera_matrix[:2, 2], [10, 20])

    def test_points_far_outside_are_not_drawn(self):
        points = np.concatenate([np.random.default_rng(0).normal(size=(100, 3)), [[1e4, 0, 0]]])
        model = geometry.Model(poses={}, points=points, num_points=101)
        assert len(geometry.without_far_points([model])[0].points) == 100

    def test_cameras_stand_upright(self):
        level = np.column_stack([Rotation.from_euler("x", 70, degrees=True).as_matrix(), [1.0, 2, 3]])
        model = geometry.Model(poses={"a": level}, points=np.zeros((0, 3)), num_points=0)
        turned = geometry.moved(model, geometry.upright([model])).poses["a"]
        np.testing.assert_allclose(turned[:, :3] @ [0, -1, 0], [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(turned[:, :3] @ [0, 0, 1], [0, 1, 0], atol=1e-9)
        np.testing.assert_allclose(turned[:, 3], 0, atol=1e-9)

    def test_prices_are_multiples_and_have_no_winner(self, compared):
        content = compared[1]
        rows = {row.title: row for group in table.table_groups(content) for row in group.rows}
        assert rows["matching, s"].cells[0] == table.Cell("3", "0.75x")
        assert rows["AUC@1°, %"].cells[0] == table.Cell("80.0", "+5.0", "gain", "▲")
        assert rows["AUC@1°, %"].cells[3] == table.Cell("")
        assert "inlier ratio" not in rows
        assert [card.is_reference for card in table.cards(content)] == [False, True, False, False]
        assert table.cards(content)[1].prices == (("pixels", "3 Mpx"), ("matching", "4 s"))
