"""The rendered room: is its truth true, and does it hold what the tests and the demo need?"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from sgam_core.errors import OptionError
from sgam_core.types import Box
from sgam_sfm.room import LABELS
from sgam_sfm.room.shapes import Cuboid, Ellipsoid, Frustum, Rectangle, Relief, Texture
from sgam_sfm.scene import View, correspond, demo_views, depth_at, overlap, render, write_scene

WIDTH, HEIGHT = 160, 120
FRAME = Box(x0=0, y0=0, x1=WIDTH, y1=HEIGHT)
LEFT, MIDDLE, RIGHT, RELIEF = 1, 3, 4, 10  # day, day, day, day: views of the arc and a close-up


@pytest.fixture(scope="module")
def views():
    return demo_views(width=WIDTH)


@pytest.fixture(scope="module")
def renderings(views):
    return {index: render(views[index]) for index in (LEFT, MIDDLE, RIGHT, RELIEF)}


def pixel_centres(step=1):
    x, y = np.meshgrid(np.arange(0, WIDTH, step), np.arange(0, HEIGHT, step))
    return np.stack([x.ravel(), y.ravel()], axis=1) + 0.5


def at(array, points):
    x, y = points.astype(int).T
    return array[y, x]


# --- shapes ----------------------------------------------------------------------------------------------------------

GREY = Texture.of(np.full((16, 16, 3), 128, np.uint8), 10.0)


def hit(shape, origin, direction):
    return float(shape.hit(np.array(origin, float), np.array([direction], float))[0])


def test_rectangle_is_hit_inside_its_sides_only():
    x, _, z = np.eye(3)
    wall = Rectangle(label=1, texture=GREY, corner=np.array([0.0, 3, 2]), right=x, down=-z, size=(4.0, 2.0))
    assert hit(wall, (1, 0, 1), (0, 1, 0)) == pytest.approx(3)
    assert hit(wall, (1, 0, 1), (0, 2, 0)) == pytest.approx(1.5)  # t counts in lengths of the direction
    assert hit(wall, (5, 0, 1), (0, 1, 0)) == np.inf
    assert hit(wall, (1, 0, 1), (0, -1, 0)) == np.inf


def test_ellipsoid_cuboid_and_frustum_are_hit_where_they_begin():
    ball = Ellipsoid(label=1, texture=GREY, centre=np.array([0.0, 5, 0]), radii=(1.0, 2.0, 1.0), rotation=np.eye(3))
    assert hit(ball, (0, 0, 0), (0, 1, 0)) == pytest.approx(3)
    crate = Cuboid(label=1, texture=GREY, corner=np.array([-1.0, 4, -1]), axes=np.eye(3), size=(2.0, 2.0, 2.0))
    assert hit(crate, (0, 0, 0), (0, 1, 0)) == pytest.approx(4)
    assert hit(crate, (0, 0, 0), (1, 1, 0)) == np.inf
    cone = Frustum(
        label=1, texture=GREY, base=np.array([0.0, 5, 0]), radii=(2.0, 1.0), height=2.0, slopes=(-0.5, -0.5), around=2.0
    )
    assert hit(cone, (0, 0, 1), (0, 1, 0)) == pytest.approx(3.5)  # half way up the radius is 1.5
    assert hit(cone, (0, 0, 2.5), (0, 1, 0)) == np.inf


def test_relief_is_hit_at_its_height():
    x, _, z = np.eye(3)
    plate = Rectangle(label=1, texture=GREY, corner=np.array([0.0, 3, 2]), right=x, down=-z, size=(2.0, 2.0))
    heights = np.zeros((64, 64), np.float32)
    heights[:, 32:] = 0.5
    relief = Relief(plate=plate, heights=heights)
    assert hit(relief, (1.5, 0, 1), (0, 1, 0)) == pytest.approx(2.5, abs=1e-3)
    assert hit(relief, (0.5, 0, 1), (0, 1, 0)) == pytest.approx(3, abs=1e-3)


def test_moving_a_shape_moves_its_hits():
    crate = Cuboid(label=1, texture=GREY, corner=np.zeros(3), axes=np.eye(3), size=(1.0, 2.0, 1.0))
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = crate.moved(quarter_turn, np.array([0.0, 5, 0]))  # now x in [-2, 0], y in [5, 6]
    assert hit(moved, (-1.5, 0, 0.5), (0, 1, 0)) == pytest.approx(5)
    assert hit(moved, (0.5, 0, 0.5), (0, 1, 0)) == np.inf


# --- truth -----------------------------------------------------------------------------------------------------------


def test_projection_of_a_hand_made_view():
    matrix = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    pose = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 2]])  # looks along +y from (0, -2, 0), upright
    view = View(name="v", camera_matrix=matrix, cam_from_world=pose, width=100, height=80, light="day")
    np.testing.assert_allclose(view.centre, [0, -2, 0])
    points, depth = view.project(np.array([[1.0, 2, 0], [0, 2, 1], [0, -3, 0]]))
    np.testing.assert_allclose(points[:2], [[75, 40], [50, 15]])
    np.testing.assert_allclose(depth, [4, 4, -1])
    np.testing.assert_allclose(view.rays(points[:1]) * 4 + view.centre, [[1, 2, 0]], atol=1e-12)


def test_views_are_rigid_and_inside_the_room(views):
    for view in views:
        rotation = view.cam_from_world[:, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert np.all(view.centre > 0)
        assert np.all(view.centre < [7, 6, 2.9])


def test_depth_map_holds_the_depth_at_pixel_centres(views, renderings):
    points = pixel_centres(step=7)
    np.testing.assert_allclose(at(renderings[LEFT].depth, points), depth_at(points, views[LEFT]), rtol=1e-9)


def test_corresponding_points_lead_back(views):
    points0 = pixel_centres(step=3) + 0.31
    points1, visible = correspond(points0, views[LEFT], views[MIDDLE])
    assert 0.3 < visible.mean() < 0.95
    back, visible_back = correspond(points1[visible], views[MIDDLE], views[LEFT])
    assert visible_back.mean() > 0.999
    close = np.linalg.norm(back - points0[visible], axis=1) < 1e-3
    assert close.mean() > 0.98  # the rest lies on the relief, whose height is found to a tenth of a millimetre
    assert np.median(np.linalg.norm(back - points0[visible], axis=1)) < 1e-9


def test_warped_labels_depths_and_colours_agree(views, renderings):
    points0 = pixel_centres()
    points1, visible = correspond(points0, views[MIDDLE], views[RIGHT])
    first, second = renderings[MIDDLE], renderings[RIGHT]
    edges = cv2.morphologyEx(second.labels.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0
    inner = visible.copy()
    inner[visible] = ~at(edges, points1[visible])
    points0, points1 = points0[inner], points1[inner]
    assert len(points0) > 2000
    assert np.mean(at(first.labels, points0) == at(second.labels, points1)) > 0.999
    warped = cv2.remap(second.pixels, (points1[:, None] - 0.5).astype(np.float32), None, cv2.INTER_LINEAR)[:, 0]
    difference = np.abs(warped.astype(float) - at(first.pixels, points0)).mean(axis=1)
    shifted = np.roll(points1, 5, axis=0)
    wrong = cv2.remap(second.pixels, (shifted[:, None] - 0.5).astype(np.float32), None, cv2.INTER_LINEAR)[:, 0]
    assert np.median(difference) < 8
    assert np.median(difference) < 0.5 * np.median(np.abs(wrong.astype(float) - at(first.pixels, points0)).mean(axis=1))


# --- overlap ---------------------------------------------------------------------------------------------------------


def test_overlap_of_a_view_with_itself(views, renderings):
    shown = views[LEFT], renderings[LEFT]
    box = Box(x0=20, y0=30, x1=80, y1=90)
    assert overlap(*shown, box, *shown, box) == 1.0
    assert overlap(*shown, box, *shown, Box(x0=20, y0=30, x1=50, y1=90)) == 0.5
    assert overlap(*shown, box, *shown, Box(x0=80, y0=30, x1=120, y1=90)) == 0.0
    assert overlap(*shown, Box(x0=-20, y0=0, x1=-1, y1=9), *shown, FRAME) == 0.0


def test_overlap_counts_what_is_seen(views, renderings):
    points = pixel_centres()
    for index0, index1 in ((LEFT, MIDDLE), (MIDDLE, LEFT), (MIDDLE, RELIEF)):
        _, visible = correspond(points, views[index0], views[index1])
        share = overlap(views[index0], renderings[index0], FRAME, views[index1], renderings[index1], FRAME)
        assert share == pytest.approx(visible.mean(), abs=0.03)  # rims are a pixel wide, and pixels are large here


# --- what the scene promises -----------------------------------------------------------------------------------------


def test_room_is_closed_and_full_of_labels(renderings):
    for index in (LEFT, MIDDLE, RIGHT):
        rendering = renderings[index]
        assert np.isfinite(rendering.depth).all()
        assert rendering.labels.min() >= 1  # nothing is void
        assert len(np.unique(rendering.labels)) >= 10


@pytest.mark.parametrize("name", ["chair", "painting", "shelf", "vase"])
def test_labels_come_several_times(renderings, name):
    for index in (LEFT, MIDDLE, RIGHT):
        of_label = (renderings[index].labels == LABELS[name]).astype(np.uint8)
        _, _, stats, _ = cv2.connectedComponentsWithStats(of_label)
        assert np.count_nonzero(stats[1:, cv2.CC_STAT_AREA] >= 30) >= 2


def test_close_up_is_at_least_two_and_a_half_times_as_large(views):
    points0 = pixel_centres(step=2)
    points1, visible = correspond(points0, views[RELIEF], views[MIDDLE])
    assert visible.sum() > 1000
    depth1 = depth_at(points1[visible], views[MIDDLE])
    assert np.median(depth1 / depth_at(points0[visible], views[RELIEF])) >= 2.5


def test_things_hide_each_other(views):
    points1, visible = correspond(pixel_centres(step=2), views[LEFT], views[RIGHT])
    hidden = FRAME.contains(points1) & ~visible
    assert hidden.mean() > 0.03


def test_relief_is_not_a_plane(views, renderings):
    points = pixel_centres()
    on_relief = points[at(renderings[RELIEF].labels, points) == LABELS["relief"]]
    view = views[RELIEF]
    world = view.centre + at(renderings[RELIEF].depth, on_relief)[:, None] * view.rays(on_relief)
    assert np.ptp(world[:, 1]) > 0.1  # metres out of the wall


def test_light_changes_the_picture_only(views, renderings):
    assert {view.light for view in views} == {"day", "evening"}
    evening = render(replace(views[LEFT], light="evening"))
    assert np.abs(evening.pixels.astype(float) - renderings[LEFT].pixels).mean() > 12
    np.testing.assert_array_equal(evening.depth, renderings[LEFT].depth)
    np.testing.assert_array_equal(evening.labels, renderings[LEFT].labels)


def test_rendering_twice_gives_the_same(views, renderings):
    again = render(views[LEFT])
    np.testing.assert_array_equal(again.pixels, renderings[LEFT].pixels)
    np.testing.assert_array_equal(again.depth, renderings[LEFT].depth)


def test_too_few_views():
    with pytest.raises(OptionError) as error:
        demo_views(count=5)
    assert str(error.value) == "demo with 5 views; expected at least 8: four along the arc and four close-ups"


# --- files -----------------------------------------------------------------------------------------------------------


def test_written_scene_reads_back(tmp_path: Path, views, renderings):
    done = []
    chosen = (views[LEFT], views[MIDDLE], views[RELIEF])
    write_scene(tmp_path, chosen, min_overlap=0.48, advance=lambda view: done.append(view.name))
    assert done == [view.name for view in chosen]
    pixels = cv2.cvtColor(cv2.imread(str(tmp_path / "images" / chosen[0].name)), cv2.COLOR_BGR2RGB)
    assert np.abs(pixels.astype(float) - renderings[LEFT].pixels).mean() < 4  # JPEG
    labels = cv2.imread(str(tmp_path / "labels" / f"{chosen[0].name}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(labels, renderings[LEFT].labels)
    assert (tmp_path / "pairs.txt").read_text().splitlines() == ["view01.jpg view03.jpg", "view03.jpg view10.jpg"]
    truth = pycolmap.Reconstruction(str(tmp_path / "ground_truth"))
    poses = {image.name: image.cam_from_world().matrix() for image in truth.images.values()}
    for view in chosen:
        np.testing.assert_allclose(poses[view.name], view.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(truth.cameras[1].calibration_matrix(), chosen[0].camera_matrix)
