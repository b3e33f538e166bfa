"""The last bundle adjustment of a model: robust, and by the points that three images agree on.

COLMAP starts no point from a track of two images. Points that two images see are what is left of longer tracks when
the others did not fit: two images can agree on the depth of any wrong match, three hardly. The mapper counts them like
all others, and every error up to its threshold in full; where things look alike, or matches are coarse, both bend the
model (docs/research.md).
"""

from __future__ import annotations

import zlib  # noqa: F401  (before pycolmap, whose wheel carries a zlib of its own: loaded later, ours would mix the two)
from collections import Counter
from statistics import median

import pycolmap


def refine(model: pycolmap.Reconstruction, pipeline: pycolmap.IncrementalPipelineOptions) -> None:
    """Drop the points that two images see, and adjust poses to the others, in place.

    Images that see too few others keep theirs. The loss is Cauchy's at the median error of the points; the other
    options of bundle adjustment are the mapper's own. Cameras stay as the mapper left them: on some paths around a
    thing they can change a lot and fit as well. Runs in the child `sgam_sfm.colmap.mappers`.
    """
    images = {point_id: {seen.image_id for seen in point.track.elements} for point_id, point in model.points3D.items()}
    pairwise = {point_id: seen for point_id, seen in images.items() if len(seen) < 3}
    support = Counter(image_id for point_id, seen in images.items() if point_id not in pairwise for image_id in seen)
    weak = {i for i in model.reg_image_ids() if support[i] < pipeline.mapper.abs_pose_min_num_inliers}
    for point_id, seen in pairwise.items():
        if not seen & weak:
            model.delete_point3D(point_id)
    if not model.num_points3D():
        return
    model.update_point_3d_errors()
    options = pipeline.get_global_bundle_adjustment()
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = max(median(point.error for point in model.points3D.values()), 1e-3)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in model.cameras:
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    limits = pipeline.mapper.filter_max_reproj_error, pipeline.mapper.filter_min_tri_angle
    pycolmap.ObservationManager(model).filter_all_points3D(*limits)
