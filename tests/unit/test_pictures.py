"""Pictures: what is drawn where, in which colour, with which words."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib.colors
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sgam_core.errors import InputError
from sgam_core.types import Area, AreaMatch, AreaState, Box, Matches, PairResult, TwoViewModel
from sgam_sfm.colours import distinct_colour, pale_colour
from sgam_sfm.pictures import save_picture
from sgam_sfm.pictures.canvas import DISTANCES, WIDTH, ImageView, evenly, fitted, place_tags, text_width, wrap
from sgam_sfm.pictures.collection import CollectionPicture, ImageEntry, circle, draw_collection
from sgam_sfm.pictures.image import ImagePicture, area_uses, draw_single_image
from sgam_sfm.pictures.pair import Matching, PairPicture, draw_pair

GREY = np.full((120, 160, 3), 128, np.uint8)
BOX0, BOX1 = Box(x0=20, y0=30, x1=80, y1=90), Box(x0=40, y0=30, x1=100, y1=90)
AREA = AreaMatch(
    area0=Area(box=BOX0, kind="object", label=3), area1=Area(box=BOX1, kind="object", label=3), distance=0.1
)
# Epipolar lines are rows: the distance of a match follows from the difference of its y.
ROWS = TwoViewModel(
    F=np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]], float), calibrated=True, num_inliers=1, num_matches=1, planarity=0
)


def matches_at(points0, points1):
    return Matches(points0=np.array(points0, float), points1=np.array(points1, float), scores=np.ones(len(points0)))


def result_of(*areas, matches=None, two_view=None, **more):
    return PairResult(
        matches=matches or Matches.empty(),
        areas=areas,
        two_view=two_view,
        coverage0=0.25,
        coverage1=0.5,
        whole_scale0=0.5,
        whole_scale1=0.5,
        **more,
    )


def picture_of(result, *, names=("a.jpg", "b.jpg"), labels=None, inliers=None, **more):
    views = (ImageView.of(names[0], GREY, labels), ImageView.of(names[1], GREY))
    return PairPicture(views=views, matching=Matching(title="Matches", result=result, inliers=inliers), **more)


def panels(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.images]


def boxes(axes: Axes) -> list[Rectangle]:
    return [patch for patch in axes.patches if isinstance(patch, Rectangle) and not patch.get_fill()]


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for part in (figure, *figure.axes) for text in part.texts]


def said(figure: Figure) -> str:
    return " ".join(texts(figure))


def drawn(figure: Figure, kind: type) -> list:
    """The collections of a kind, colour bars left out."""
    parts = (axes for axes in figure.axes if axes.get_label() != "colour bar")
    return [item for axes in parts for item in axes.collections if type(item) is kind]


def rendered(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def place(figure: Figure, axes: Axes, x: float, y: float) -> tuple[int, int]:
    """Row and column in the rendered picture of a point in the axes' pixels."""
    across, up = axes.transData.transform((x, y))
    return int(figure.bbox.height - up), int(across)


class TestPair:
    def test_areas_are_drawn_where_they_are_in_the_colour_of_their_match(self):
        figure = draw_pair(picture_of(result_of(AREA, replace(AREA, area0=Area(box=BOX1, kind="object")))))
        left, right = panels(figure)[:2]
        assert [box.get_bbox().bounds for box in boxes(left)] == [(20, 30, 60, 60), (40, 30, 60, 60)]
        assert [box.get_bbox().bounds for box in boxes(right)] == [(40, 30, 60, 60)] * 2
        colour = tuple(value / 255 for value in distinct_colour(0))
        assert boxes(left)[0].get_edgecolor() == (*colour, 1)
        assert [text.get_text() for text in left.texts] == ["1", "2"]

    def test_the_edge_of_a_box_is_where_its_pixels_are(self):
        figure = draw_pair(picture_of(result_of(AREA)))
        left = panels(figure)[0]
        pixels = rendered(figure)
        for x, y in ((20, 70), (80, 70), (50, 90)):
            assert tuple(pixels[place(figure, left, x, y)]) == distinct_colour(0)
        assert tuple(pixels[place(figure, left, 50, 60)]) == tuple(
            pixels[place(figure, left, 120, 60)]
        )  # inside: image

    def test_images_have_the_corner_origin(self):
        figure = draw_pair(picture_of(result_of(AREA)))
        left = panels(figure)[0]
        assert left.images[0].get_extent() == [0, 160, 120, 0]
        assert (left.get_xlim(), left.get_ylim()) == ((0, 160), (120, 0))

    def test_every_state_has_its_own_line_and_mark(self):
        areas = [replace(AREA, state=state, reason=f"because {state}") for state in AreaState]
        areas.append(replace(AREA, predicted=True))
        figure = draw_pair(picture_of(result_of(*areas)))
        left = panels(figure)[0]
        assert len({str(box.get_linestyle()) + str(box._dash_pattern) for box in boxes(left)}) == len(AreaState)
        assert {text.get_text() for text in left.texts} == {"1", "2\N{MULTIPLICATION SIGN}", "3?", "4-", "5?"}
        for state in AreaState:
            assert f"because {state}" in texts(figure)
        assert "2 kept, 1 rejected, 1 unresolved, 1 skipped; 1 of those kept were doubtful" in said(figure)

    def test_labels_are_pale_and_explained_and_areas_are_not(self):
        labels = np.full((60, 80), 5, np.int32)
        labels[:, 40:] = 0
        figure = draw_pair(picture_of(result_of(AREA), labels=labels, label_names={5: "sofa"}))
        left, right = panels(figure)[:2]
        pixels = rendered(figure)
        light = pixels[place(figure, left, 10, 60)] / np.array(pale_colour(5))
        np.testing.assert_allclose(light, light.mean(), atol=0.02)
        assert np.ptp(pixels[place(figure, left, 120, 60)]) <= 2  # no label: grey
        assert min(min(pale_colour(number)) for number in range(40)) > max(min(distinct_colour(n)) for n in range(40))
        assert {"Outlines are areas:", "Fills are labels:", "sofa: 50%", "50% of the image has no label."} <= set(
            texts(figure)
        )
        assert len(boxes(right)) == 1

    def test_kinds_are_counted_and_guided_areas_explained(self):
        guided = replace(AREA, area0=Area(box=BOX0, kind="guided"), area1=Area(box=BOX1, kind="guided"))
        assert "2 kept; by kind: 1 object, 1 guided." in texts(draw_pair(picture_of(result_of(AREA, guided))))
        explained = "Guided areas are windows on the ground that a first round found in both images"
        assert explained in said(draw_pair(picture_of(result_of(guided))))
        assert explained not in said(draw_pair(picture_of(result_of(AREA))))

    def test_the_table_holds_scales_counts_and_names_of_labels(self):
        area = replace(AREA, scale0=1.0, scale1=0.75, num_matches=41, num_inliers=37)
        figure = draw_pair(picture_of(result_of(area), label_names={3: "window"}))
        for cell in ("object", "window", "kept", "1.00 / 0.75", "1.8x", "41", "37"):
            assert cell in texts(figure)

    def test_a_long_table_counts_what_it_leaves_out(self):
        areas = [replace(AREA, reason=f"reason {number}") for number in range(70)]
        figure = draw_pair(picture_of(result_of(*areas)))
        assert "reason 19" in texts(figure)
        assert "reason 20" not in texts(figure)
        assert "50 more: 50 kept." in said(figure)
        assert len(boxes(panels(figure)[0])) == 60
        assert "10 of 70 are not drawn." in said(figure)

    def test_points_are_coloured_by_their_distance_in_pixels(self):
        matches = matches_at([[50, 60], [70, 60]], [[60, 60], [70, 63]])
        figure = draw_pair(picture_of(result_of(AREA, matches=matches, two_view=ROWS)))
        dots = drawn(figure, PathCollection)
        away = 3 / np.sqrt(2) / 4  # Sampson distance of 3 rows, of 4 pixels where the colours end
        for side in dots:
            np.testing.assert_allclose(side.get_facecolors(), DISTANCES([0.0, away]), atol=1e-6)
        assert "50% of them within 1 pixel of the pair's essential matrix" in said(figure)
        assert "Sampson distance in pixels" in texts(figure)

    def test_points_lie_on_their_images(self):
        matches = matches_at([[50, 60]], [[60, 30]])
        figure = draw_pair(picture_of(result_of(AREA, matches=matches, two_view=ROWS)))
        images = panels(figure)[2:]
        row = drawn(figure, LineCollection)[0].axes
        for image, dots, point in zip(images, row.collections[1:], [[50, 60], [60, 30]], strict=True):
            at = row.transData.transform(dots.get_offsets()[0])
            np.testing.assert_allclose(at, image.transData.transform(point), atol=0.05)

    def test_without_a_geometry_the_colour_is_neutral(self):
        matches = matches_at([[50, 60]], [[60, 30]])
        figure = draw_pair(picture_of(result_of(AREA, matches=matches)))
        grey = matplotlib.colors.to_rgba("#cfd6dd")
        assert tuple(drawn(figure, PathCollection)[0].get_facecolors()[0]) == grey
        assert "no two-view geometry was found, so that their colour tells no distance" in said(figure)
        assert "Sampson distance in pixels" not in texts(figure)

    def test_lines_are_the_verified_inliers(self):
        points = np.stack([np.arange(300.0) / 2, np.full(300, 50.0)], axis=1)
        matches = matches_at(points, points)
        figure = draw_pair(picture_of(result_of(matches=matches, two_view=ROWS), inliers=(points[:4], points[:4])))
        assert [len(lines.get_segments()) for lines in drawn(figure, LineCollection)] == [4]
        assert "4 inliers after COLMAP's verification." in said(figure)
        assert "Dots: 300 of 300 point matches. Lines: 4 of 4 inliers." in said(figure)

    def test_many_points_are_sampled_and_counted(self):
        points = np.stack([np.arange(900.0) / 6, np.full(900, 50.0)], axis=1)
        figure = draw_pair(picture_of(result_of(matches=matches_at(points, points))))
        assert [len(dots.get_offsets()) for dots in drawn(figure, PathCollection)] == [500, 500]
        assert [len(lines.get_segments()) for lines in drawn(figure, LineCollection)] == [90]
        assert "Dots: 500 of 900 point matches. Lines: 90 matches." in said(figure)
        assert "not verified by COLMAP." in said(figure)

    def test_a_pair_that_verification_refused_says_so(self):
        none = np.zeros((0, 2))
        figure = draw_pair(picture_of(result_of(matches=matches_at([[5, 5]], [[5, 5]])), inliers=(none, none)))
        assert "no inlier was left by COLMAP's verification" in said(figure)
        assert [len(lines.get_segments()) for lines in drawn(figure, LineCollection)] == [1]

    def test_the_plain_matcher_stands_beneath(self):
        plain = Matching(
            title="The plain matcher", result=result_of(matches=matches_at([[5, 5]], [[5, 5]])), inliers=None
        )
        alone, both = (draw_pair(picture_of(result_of(AREA), plain=other)) for other in (None, plain))
        assert len(panels(both)) == len(panels(alone)) + 2
        assert "The plain matcher" in texts(both)
        assert both.bbox.height > alone.bbox.height

    def test_labels_tint_all_but_void(self):
        labels = np.zeros((60, 80), np.int32)  # half as large as the image
        labels[:, 40:] = 7
        figure = draw_pair(picture_of(result_of(), labels=labels))
        panel = np.asarray(panels(figure)[0].images[0].get_array())
        coloured, middle = np.ptp(panel, axis=2) > 2, panel.shape[1] // 2
        assert not coloured[:, : middle - 4].any()
        assert coloured[:, middle + 4 :].all()

    def test_what_is_missing_is_said(self):
        result = result_of(fallback="no area match", notes=("2 areas beyond the budget",))
        figure = draw_pair(picture_of(result, missing=("labels (no label maps)", "tracks")))
        assert len(panels(figure)) == 2  # no row of areas
        for words in (
            "Matched as whole images: no area match.",
            "Limits reached: 2 areas beyond the budget.",
            "Not in this picture: labels (no label maps); tracks.",
        ):
            assert words in texts(figure)

    def test_images_of_other_shapes_are_as_high_as_each_other(self):
        tall = ImageView.of("tall.jpg", np.zeros((300, 100, 3), np.uint8))
        views = (ImageView.of("a.jpg", GREY), tall)
        figure = draw_pair(PairPicture(views=views, matching=Matching(title="", result=result_of(AREA), inliers=None)))
        left, right = (axes.get_window_extent() for axes in panels(figure)[:2])
        assert left.height == pytest.approx(right.height, abs=0.01)
        assert left.width / left.height == pytest.approx(160 / 120, rel=0.01)
        assert right.width / right.height == pytest.approx(1 / 3, rel=0.01)


class TestImage:
    VIEW = ImageView.of("a.jpg", GREY)

    def test_areas_of_all_pairs_are_counted(self):
        other = replace(AREA, area0=Area(box=BOX1, kind="intersection"), state=AreaState.REJECTED)
        uses = area_uses(
            {"b.jpg": result_of(other, AREA), "c.jpg": result_of(AREA, replace(AREA, state=AreaState.SKIPPED))}
        )
        assert [use.area.box for use in uses] == [BOX0, BOX1]
        assert uses[0].states == Counter({AreaState.KEPT: 2, AreaState.SKIPPED: 1})
        assert uses[0].partners == ("b.jpg", "c.jpg")
        assert uses[1].state is AreaState.REJECTED

    def test_keypoints_without_a_point_are_rings(self):
        points = np.array([[10, 10], [20, 20], [30, 30.0]])
        figure = draw_single_image(
            ImagePicture(
                view=self.VIEW,
                results={"b.jpg": result_of(AREA)},
                num_listed=2,
                keypoints=points,
                track_lengths=np.array([0, 2, 5]),
                model="0",
            )
        )
        rings, dots = drawn(figure, PathCollection)
        np.testing.assert_array_equal(rings.get_offsets(), points[:1])
        np.testing.assert_array_equal(dots.get_offsets(), points[1:])
        assert len(rings.get_facecolors()) == 0
        assert "3 keypoints, 2 of them with a point in model 0, seen by 3.5 images on average." in said(figure)
        assert "1 of 2 pairs matched" in said(figure)
        assert len(boxes(panels(figure)[0])) == 1

    def test_labels_have_a_legend_with_names_and_shares(self):
        labels = np.zeros((60, 80), np.int32)
        labels[:, :40], labels[:, 40:60] = 7, 2
        figure = draw_single_image(
            ImagePicture(view=replace(self.VIEW, labels=labels), results={}, num_listed=0, label_names={7: "sky_$"})
        )
        assert {"sky_$: 50%", "label 2: 25%", "25% of the image has no label."} <= set(texts(figure))

    def test_without_anything_it_is_the_image_and_a_caption(self):
        figure = draw_single_image(
            ImagePicture(view=self.VIEW, results={}, num_listed=1, missing=("keypoints (no database.db)",))
        )
        assert len(panels(figure)) == 1
        assert "Not in this picture: keypoints (no database.db)." in texts(figure)
        rendered(figure)


class TestCollection:
    @staticmethod
    def entry(number, **more):
        return ImageEntry(**({"name": f"{number:03d}.jpg", "keypoints": 10, "verified": 1, "model": "0"} | more))

    @staticmethod
    def thumbnail(name):
        return ImageView.of(name, GREY)

    def picture(self, entries, inliers, **more):
        return CollectionPicture(title="out", entries=entries, inliers=inliers, num_listed=5, num_matched=4, **more)

    def test_every_image_has_a_thumbnail_and_every_verified_pair_an_edge(self):
        entries = [self.entry(n) for n in range(4)]
        inliers = {("000.jpg", "001.jpg"): 100, ("001.jpg", "003.jpg"): 800}
        figure = draw_collection(self.picture(entries, inliers), self.thumbnail)
        assert len(panels(figure)) == 4
        (edges,) = drawn(figure, LineCollection)
        places = circle(4)
        ends = [segment[[0, -1]] for segment in edges.get_segments()]
        np.testing.assert_allclose(ends, [places[[0, 1]], places[[1, 3]]], atol=1e-12)  # the strongest on top
        assert edges.get_linewidths()[1] > edges.get_linewidths()[0]
        assert {"1  000.jpg", "10 keypoints", "1 pair, model 0", "800  001.jpg - 003.jpg"} <= set(texts(figure))

    def test_troubles_are_marked_and_named(self):
        entries = [
            self.entry(0),
            self.entry(1, model=""),
            self.entry(2, keypoints=0, verified=0, model="", error="'002.jpg' cannot be decoded"),
            self.entry(3, model="1"),
        ]
        figure = draw_collection(
            self.picture(entries, {}), lambda name: None if name == "003.jpg" else self.thumbnail(name)
        )
        assert len(panels(figure)) == 2
        assert {"1 pair, no pose", "failed", "no image", "1 pair, model 1"} <= set(texts(figure))
        assert {"002.jpg: cannot be decoded", "Failed or without a pose: 2", "No verified pair."} <= set(texts(figure))
        assert "Model 0 has 1 image, model 1 has 1 image; images without a pose: 1." in texts(figure)
        red = matplotlib.colors.to_rgba("#c62828")
        (nodes,) = drawn(figure, PathCollection)
        assert [tuple(colour) == red for colour in nodes.get_facecolors()] == [True] * 4  # none has a verified pair

    def test_large_collections_are_sampled_and_say_so(self):
        entries = [self.entry(n) for n in range(200)]
        names = [entry.name for entry in entries]
        inliers = {(names[a], names[b]): 15 + a + b for a in range(200) for b in range(a)}
        read = []
        figure = draw_collection(self.picture(entries, inliers), lambda name: read.append(name) or self.thumbnail(name))
        assert len(read) == len(panels(figure)) == 60
        assert (read[0], read[-1]) == ("000.jpg", "199.jpg")
        assert "60 thumbnails, evenly through the names; 140 are not drawn." in texts(figure)
        assert len(drawn(figure, PathCollection)[0].get_offsets()) == 200
        assert len(drawn(figure, LineCollection)[0].get_segments()) == 600
        assert "600 of 19900 verified pairs drawn; the 19300 weakest are left out." in texts(figure)

    def test_very_large_collections_are_sampled_in_the_graph_too(self):
        entries = [self.entry(n) for n in range(1201)]
        inliers = {(f"{n:03d}.jpg", f"{n + 2:03d}.jpg"): 100 for n in range(0, 1199)}
        figure = draw_collection(self.picture(entries, inliers), lambda name: None)
        assert len(drawn(figure, PathCollection)[0].get_offsets()) == 600
        drawn_pairs = len(drawn(figure, LineCollection)[0].get_segments())
        assert 0 < drawn_pairs < 600
        words = f"{drawn_pairs} of 1199 verified pairs drawn; {1199 - drawn_pairs} are of images that are not drawn."
        assert words in texts(figure)

    def test_a_run_without_a_database_says_so(self):
        entries = [self.entry(n, keypoints=None, verified=None, model=None) for n in range(2)]
        figure = draw_collection(self.picture(entries, {}, missing=("keypoints (no database.db)",)), self.thumbnail)
        assert {"No pair has been verified.", "Not in this picture: keypoints (no database.db)."} <= set(texts(figure))
        rendered(figure)


class TestCanvas:
    @pytest.mark.parametrize("name", ["a b.jpg", "$x^2$_\\alpha.jpg", "ä_é.jpg", "Ελλάδα.jpg", "im age_01.jpg"])
    def test_names_are_drawn_literally(self, name):
        figure = draw_pair(picture_of(result_of(AREA), names=(name, "b.jpg")))
        assert f"{name} - b.jpg" in texts(figure)
        assert not any(text.get_parse_math() for part in (figure, *figure.axes) for text in part.texts)
        rendered(figure)

    @pytest.mark.parametrize(("name", "expected"), [("a\udc80.jpg", "a\\udc80.jpg"), ("a\tb.jpg", "a\\tb.jpg")])
    def test_what_cannot_be_drawn_is_written_as_its_code(self, name, expected):
        figure = draw_pair(picture_of(result_of(AREA), names=(name, "b.jpg")))
        assert f"{expected} - b.jpg" in texts(figure)
        rendered(figure)

    def test_no_glyph_is_missing(self):
        figure = draw_pair(picture_of(result_of(AREA), names=("日本.jpg", "\N{GRINNING FACE}\U0001fae8.jpg")))
        rendered(figure)  # a warning would be an error

    def test_text_is_large_enough_for_half_the_width(self):
        for figure in (
            draw_pair(picture_of(result_of(AREA, matches=matches_at([[5, 5]], [[5, 5]]), two_view=ROWS))),
            draw_single_image(ImagePicture(view=TestImage.VIEW, results={"b.jpg": result_of(AREA)}, num_listed=1)),
            draw_collection(TestCollection().picture([TestCollection.entry(0)], {}), TestCollection.thumbnail),
        ):
            assert figure.bbox.width == WIDTH
            sizes = [text.get_fontsize() * 100 / 72 for part in (figure, *figure.axes) for text in part.texts]
            assert min(sizes) >= 15.9

    def test_no_text_leaves_the_picture(self):
        names = ("a" * 150 + ".jpg", "b" * 150 + ".jpg")
        area = replace(AREA, state=AreaState.REJECTED, reason="word " * 60)
        figure = draw_pair(picture_of(result_of(area, notes=("n" * 300, "words " * 60)), names=names))
        renderer = FigureCanvasAgg(figure).get_renderer()
        for text in figure.texts:
            extent = text.get_window_extent(renderer)
            assert extent.x0 >= 0
            assert extent.x1 <= WIDTH
            assert extent.y0 >= 0

    def test_tags_do_not_hide_each_other(self):
        boxes = [Box(x0=10, y0=10, x1=200, y1=150)] * 6
        corners = place_tags(boxes, ["12"] * 6, (300, 200))
        assert corners[0] == (10, 10)
        for index, (x, y) in enumerate(corners):
            assert all(abs(x - a) >= 25 or abs(y - b) >= 23 for a, b in corners[:index])

    def test_tags_stay_in_the_image(self):
        corners = place_tags([Box(x0=290, y0=190, x1=300, y1=200)], ["12"], (300, 200))
        assert corners[0][0] + 25 < 300
        assert corners[0][1] + 23 <= 200

    def test_text_is_shortened_in_its_middle(self):
        assert fitted("short.jpg", 16, 500) == "short.jpg"
        shorter = fitted("a_very_long_folder/with_a_very_long_name_0001.jpg", 16, 200)
        assert text_width(shorter, 16) <= 200
        assert shorter.startswith("a_very")
        assert shorter.endswith("0001.jpg")

    def test_text_is_wrapped_between_words(self):
        lines = wrap("one two three four five", 16, 90)
        assert " ".join(lines) == "one two three four five"
        assert all(text_width(line, 16) <= 90 for line in lines)
        assert wrap("", 16, 90) == []

    def test_samples_are_even_and_bounded(self):
        assert evenly(3, 10).tolist() == [0, 1, 2]
        assert evenly(101, 3).tolist() == [0, 50, 100]
        assert evenly(0, 3).tolist() == []

    def test_large_images_are_shrunk(self):
        view = ImageView.of("a.jpg", np.zeros((2000, 4000, 3), np.uint8))
        assert view.size == (4000, 2000)
        assert view.pixels.shape == (800, 1600, 3)

    def test_a_missing_folder_is_made(self, tmp_path: Path):
        figure = draw_pair(picture_of(result_of(AREA)))
        save_picture(figure, tmp_path / "new" / "folder" / "pair.png")
        read = cv2.imread(str(tmp_path / "new" / "folder" / "pair.png"))[..., ::-1]
        np.testing.assert_array_equal(read, rendered(figure))

    @pytest.mark.parametrize("suffix", ["jpg", "webp", "tif", "pdf", "svg", "PNG"])
    def test_other_formats(self, tmp_path: Path, suffix):
        save_picture(draw_pair(picture_of(result_of(AREA))), tmp_path / f"pair.{suffix}")
        assert (tmp_path / f"pair.{suffix}").stat().st_size > 1000

    @pytest.mark.parametrize("name", ["pair.xyz", "pair"])
    def test_another_suffix_is_refused(self, tmp_path: Path, name):
        with pytest.raises(InputError) as error:
            save_picture(draw_pair(picture_of(result_of())), tmp_path / name)
        expected = "its name ends in none of .png, .jpg, .jpeg, .webp, .tif, .tiff, .pdf, .svg"
        assert str(error.value) == f"cannot write picture '{tmp_path / name}': {expected}"

    def test_a_file_that_cannot_be_written_is_named(self, tmp_path: Path):
        (tmp_path / "file").write_text("no folder")
        path = tmp_path / "file" / "pair.png"
        with pytest.raises(InputError) as error:
            save_picture(draw_pair(picture_of(result_of())), path)
        assert str(error.value) in (
            f"cannot write picture '{path}' (File exists); choose another file",
            f"cannot write picture '{path}' (Not a directory); choose another file",
        )
