"""A worker that needs numpy and OpenCV: RootSIFT, mutual nearest neighbours, ratio test on both sides."""

import cv2
import numpy as np
from sgam_worker import serve_matcher

RATIO = 0.8
NONE = np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)


def nearest(distances):
    """The nearest column of each row, and how much nearer it is than the second."""
    order = np.argsort(distances, axis=1)[:, :2]
    best, second = np.take_along_axis(distances, order, axis=1).T
    return order[:, 0], best / np.maximum(second, 1e-9)


def load(settings):
    sift = cv2.SIFT_create(nfeatures=512, contrastThreshold=0.02, enable_precise_upscale=True)

    def features(image):
        keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        if len(keypoints) < 2:
            return np.zeros((0, 2)), np.zeros((0, 128))
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6))
        return np.array([keypoint.pt for keypoint in keypoints]), root.astype(np.float64)

    def match_pair(image0, image1):
        (points0, descriptors0), (points1, descriptors1) = features(image0), features(image1)
        if not (len(points0) and len(points1)):
            return NONE
        distances = np.sqrt(np.maximum(2 - 2 * descriptors0 @ descriptors1.T, 0))
        (there, ratio0), (back, ratio1) = nearest(distances), nearest(distances.T)
        rows = np.flatnonzero(back[there] == np.arange(len(there)))
        rows = rows[(ratio0[rows] < RATIO) & (ratio1[there[rows]] < RATIO)]
        return points0[rows], points1[there[rows]], 1 - ratio0[rows]

    return lambda pairs: [match_pair(*pair) for pair in pairs]


serve_matcher(load, origin="center")
