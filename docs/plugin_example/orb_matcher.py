"""ORB as a point matcher of sgam-sfm."""

import cv2
import numpy as np

from sgam_core import Matches


class Orb:
    """Mutual nearest neighbours of ORB features."""

    def match(self, pairs):  # pairs of sgam_core.Crop -> one Matches each, in pixels of the crops
        return [self._match(*self._features(crop0), *self._features(crop1)) for crop0, crop1 in pairs]

    def _features(self, crop):
        mask = None if crop.mask() is None else crop.mask().astype(np.uint8)
        found, descriptors = cv2.ORB_create(2000).detectAndCompute(crop.pixels(), mask)
        return np.array([keypoint.pt for keypoint in found]).reshape(-1, 2) + 0.5, descriptors

    def _match(self, points0, seen0, points1, seen1):
        found = cv2.BFMatcher(cv2.NORM_HAMMING, True).match(seen0, seen1) if len(points0) and len(points1) else []
        rows0, rows1, bits = np.array([(m.queryIdx, m.trainIdx, m.distance) for m in found], int).reshape(-1, 3).T
        return Matches(points0=points0[rows0], points1=points1[rows1], scores=1 - bits / 256)
