"""Hues as a segmenter of sgam-sfm: eight labels, and void where there is no colour."""

import cv2
import numpy as np

from sgam_core.errors import SGAMError
from sgam_sfm.images import read_image


class Hues:
    """Equal labels mean the same hue in every image."""

    def segment(self, images, advance):  # sgam_sfm.images.ImageFile -> (image, labels) each, 0 = void
        for image in images:
            try:
                labels = self._labels(read_image(image))
            except SGAMError as error:  # a broken photo is left out, and named in the summary
                labels = error
            advance(1.0)
            yield image, labels

    def _labels(self, pixels):
        hue, saturation, _ = cv2.split(cv2.cvtColor(cv2.medianBlur(pixels, 9), cv2.COLOR_RGB2HSV))
        return np.where(saturation < 40, 0, 1 + hue // 23).astype(np.int32)  # OpenCV's hue ends at 180
