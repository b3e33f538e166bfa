"""The last bundle adjustment, on a synthetic model whose truth is known."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from sgam_sfm.colmap.refinement import refine

WRONG = range(1, 151)  # points of which two images alone see something, and not the same


def true_model() -> pycolmap.Reconstruction:
    """Eight images that all see the same 300 points."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 300
    return pycolmap.synthesize_dataset(options)


def observations(model: pycolmap.Reconstruction, point_id: int) -> list[tuple[int, int]]:
    """Image and number of the keypoint of all observations, which stay valid when the track changes."""
    return [(seen.image_id, seen.point2D_idx) for seen in model.point3D(point_id).track.elements]


def leave(model: pycolmap.Reconstruction, point_id: int, images: set[int]) -> None:
    """Take a point away from all other images."""
    for image_id, row in observations(model, point_id):
        if image_id not in images:
            pycolmap.ObservationManager(model).delete_observation(image_id, row)


def shift(model: pycolmap.Reconstruction, point_id: int, image_id: int, pixels: tuple[float, float]) -> None:
    """Move what an image sees of a point."""
    row = dict(observations(model, point_id))[image_id]
    point = model.image(image_id).point2D(row)
    point.xy = point.xy + pixels


def bent_model(pipeline: pycolmap.IncrementalPipelineOptions) -> pycolmap.Reconstruction:
    """A model that follows points of image pairs, each shifted by 3 pixels, like any others."""
    model = true_model()
    for point_id in WRONG:
        first = 1 + point_id % 7
        leave(model, point_id, {first, first + 1})
        shift(model, point_id, first + 1, (3.0, 0.0))
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.set_constant_cam_intrinsics(1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(pipeline.get_global_bundle_adjustment(), config, model).solve()
    return model


def worst_rotation_deg(model: pycolmap.Reconstruction) -> float:
    """The largest error of a rotation between two images."""
    truth = true_model()
    rotations = [
        [m.image(i).cam_from_world().rotation.matrix() for i in sorted(model.reg_image_ids())] for m in (model, truth)
    ]
    relative = [[a @ b.T for a in some for b in some] for some in rotations]
    cosines = [(np.trace(found @ true.T) - 1) / 2 for found, true in zip(*relative, strict=True)]
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


@pytest.fixture
def pipeline() -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.constant_cameras, options.num_threads = {1}, 1
    return options


def test_points_of_two_images_bend_no_poses(pipeline):
    model = bent_model(pipeline)
    assert worst_rotation_deg(model) > 0.02
    refine(model, pipeline)
    assert worst_rotation_deg(model) < 0.001
    assert set(model.points3D) == set(true_model().points3D) - set(WRONG)
    assert model.camera(1).params.tolist() == true_model().camera(1).params.tolist()


def test_single_wrong_observations_bend_no_poses(pipeline):
    model = true_model()
    for point_id in WRONG:
        shift(model, point_id, 1 + point_id % 8, (2.0, 1.0))
    refine(model, pipeline)
    assert worst_rotation_deg(model) < 0.01


def test_an_image_with_nothing_else_keeps_its_points_of_two_images(pipeline):
    model = true_model()
    for point_id in range(21, 301):
        leave(model, point_id, {7, 8} if point_id > 250 else {1, 2} if point_id > 200 else {*range(1, 8)})
    refine(model, pipeline)
    assert {*range(1, 201), *range(251, 301)} == set(model.points3D)
    assert worst_rotation_deg(model) < 0.001


def test_a_model_without_points_stays_as_it_is(pipeline):
    model = true_model()
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    refine(model, pipeline)
    assert model.num_reg_images() == 8
