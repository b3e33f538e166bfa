"""Joint segmentation of a collection without classes: clusters of DINOv2 patch features are the labels."""

from __future__ import annotations

import hashlib
import logging
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from jaxtyping import Float16, Float32, Int32
from scipy.ndimage import gaussian_filter

from sgam_core.errors import OptionError, SGAMError
from sgam_sfm.files import replacing
from sgam_sfm.images import ImageFile, read_image
from sgam_sfm.segmenters.clustering import Projection, principal_components, stable_clusters
from sgam_sfm.segmenters.dino import PatchFeatures
from sgam_sfm.threads import in_order, num_cores
from sgam_sfm.weights import DINOV2_FOCUS, find_weights

logger = logging.getLogger(__name__)

_BLOCK = 8  # of 12: the later ones were tuned for saliency and merge what is salient
_MIN_IMAGE_SIZE = 224  # pixels: at least as many patches as one image needs for clusters
_SMOOTHING_SIGMA = 1.0  # patches: specks under 0.3 % of an image shrink from 6 % of its area to 1 %
_NUM_COMPONENTS = 32  # of 384 of the installed network: keeps about 80 % of the variance
_CANDIDATES = (8, 10, 12, 14, 16)  # numbers of labels
_NUM_RUNS = 5  # of k-means for each candidate
_TOLERANCE = 0.05  # of agreement between runs: about its own noise; within it more labels, so more areas, are preferred
_MAX_SAMPLES = 20_000  # patches that k-means sees
_LABEL_MAP_WIDTH = 640  # pixels, as the layout constants of the method
_FEATURE_SHARE = 0.9  # of an image's work
_MOST_AT_ONCE = 8  # images, each with a photo and up to 150 MB of the network's in memory


class CoSeg:
    """Label maps whose labels agree across a collection, from the images alone.

    Patch features of all images are projected to their principal components and clustered by k-means; distances to the
    centres, interpolated between patches, give each pixel its label, 1..K. All that is drawn at random follows from
    `seed` and the content of the images: their order and their names do not matter.

    name: hub id or folder of a larger DINOv2 or DINOv3 (`sgam_sfm.segmenters.dino_hub`); the installed one when empty.
    weights: an ONNX file in place of the installed one. num_labels: 2..255; None takes the number on which runs of
    k-means agree best. cache_folder: where features are kept between runs. image_size: pixels of the longer side at
    which images enter the network. threads: 0 = as many as there are cores.

    After a run, `num_labels_chosen` is the number of labels, and `stability` how well runs of k-means agreed (mean
    adjusted Rand index), for every number that was tried.

    Raises: WeightsError when there are no weights; OptionError for an option out of range.
    """

    def __init__(
        self,
        *,
        name: str = "",
        weights: Path | None = None,
        device: str = "cpu",
        seed: int = 0,
        num_labels: int | None = None,
        cache_folder: Path | None = None,
        image_size: int = 518,
        threads: int = 0,
    ) -> None:
        if num_labels is not None and not 2 <= num_labels <= 255:
            raise OptionError(f"num_labels is {num_labels}; expected 2 to 255, or none to choose it")
        if image_size < _MIN_IMAGE_SIZE:
            raise OptionError(f"image_size is {image_size}; expected at least {_MIN_IMAGE_SIZE} pixels")
        self._patch_features: Callable[[np.ndarray], np.ndarray]
        settings: tuple[str | int, ...]
        if name:
            from sgam_sfm.segmenters.dino_hub import HubPatchFeatures

            self._at_once = 1  # torch takes all cores, or the GPU, for one
            self._patch_features = large = HubPatchFeatures(name, image_size=image_size, device=device)
            settings = (large.digest, image_size, device)
        else:
            path = find_weights(DINOV2_FOCUS, weights)
            threads = threads or num_cores()
            self._at_once = min(threads, _MOST_AT_ONCE)
            self._patch_features = PatchFeatures(
                path, block=_BLOCK, image_size=image_size, device=device, threads=threads // self._at_once
            )
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            settings = (digest, _BLOCK, image_size, device, onnxruntime.__version__)
        self._settings_key = hashlib.sha256(repr(settings).encode()).hexdigest()[:16]
        self._cache_folder = cache_folder
        self._seed = seed
        self._num_labels = num_labels
        self.num_labels_chosen: int | None = None
        self.stability: dict[int, float] = {}

    def segment(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Int32[np.ndarray, "H W"] | Exception]]:
        # Two passes over the features, which need not fit into memory: without a cache they wait on the disk too.
        with self._cache() as cache:

            def sample_of(image: ImageFile) -> np.ndarray:
                return self._draw(image, self._features(image, cache), _MAX_SAMPLES // len(images))

            errors: dict[str, SGAMError] = {}
            samples: list[np.ndarray] = []
            for image, drawn in self._of_each(sample_of, sorted(images, key=lambda image: image.digest)):
                if isinstance(drawn, SGAMError):
                    errors[image.name] = drawn
                else:
                    samples.append(drawn)
                advance(_FEATURE_SHARE)
            if samples:
                project, centers = self._cluster(np.concatenate(samples))

            def labels_of(image: ImageFile) -> np.ndarray:
                if image.name in errors:
                    raise errors[image.name]
                return _label_map(project(self._features(image, cache)), centers, image)

            for image, labels in self._of_each(labels_of, images):
                yield image, labels
                advance(1 - _FEATURE_SHARE)

    def describe(
        self, images: Sequence[ImageFile], advance: Callable[[float], None]
    ) -> Iterator[tuple[ImageFile, Float32[np.ndarray, " C"] | SGAMError]]:
        """The mean of the patch features of every image, to tell which images are alike; they are cached as for labels.

        On the images of docs/pairs.md it found at least as many overlapping pairs as the network's class token there.
        """
        with self._cache() as cache:
            for image, mean in self._of_each(
                lambda image: self._patches(image, cache).mean(axis=(0, 1), dtype=np.float32), images
            ):
                yield image, mean
                advance(1)

    def _of_each(
        self, function: Callable[[ImageFile], np.ndarray], images: Sequence[ImageFile]
    ) -> Iterator[tuple[ImageFile, np.ndarray | SGAMError]]:
        """A function of every image, or why there is none; of several at once."""

        def tried(image: ImageFile) -> tuple[ImageFile, np.ndarray | SGAMError]:
            try:
                return image, function(image)
            except SGAMError as error:
                return image, error

        return in_order(tried, images, self._at_once)

    @contextmanager
    def _cache(self) -> Iterator[Path]:
        """The folder of the features: the given one, or one that is removed at the end."""
        with ExitStack() as stack:
            cache = self._cache_folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="coseg-")))
            cache.mkdir(parents=True, exist_ok=True)
            yield cache

    def _features(self, image: ImageFile, cache: Path) -> Float32[np.ndarray, "rows columns C"]:
        """Smoothed patch features."""
        patches = self._patches(image, cache).astype(np.float32)
        return gaussian_filter(patches, (_SMOOTHING_SIGMA, _SMOOTHING_SIGMA, 0), mode="nearest")

    def _patches(self, image: ImageFile, cache: Path) -> Float16[np.ndarray, "rows columns C"]:
        """Patch features, from the cache when it has them."""
        path = cache / f"{image.digest}-{self._settings_key}.npy"
        features = _load(path)
        if features is None:
            features = self._patch_features(read_image(image))
            with replacing(path) as partial, partial.open("wb") as file:
                np.save(file, features)
        return features

    def _draw(self, image: ImageFile, features: np.ndarray, num_samples: int) -> Float32[np.ndarray, "N C"]:
        patches = features.reshape(-1, features.shape[-1])
        rng = np.random.default_rng([self._seed, int(image.digest, 16)])
        return patches[rng.permutation(len(patches))[: max(num_samples, 1)]]

    def _cluster(self, samples: np.ndarray) -> tuple[Projection, Float32[np.ndarray, "K D"]]:
        project = principal_components(samples, _NUM_COMPONENTS)
        candidates = _CANDIDATES if self._num_labels is None else (self._num_labels,)
        clusters, stability = stable_clusters(project(samples), candidates, _NUM_RUNS, _TOLERANCE, self._seed)
        self.num_labels_chosen = len(clusters.centers)
        self.stability = dict(stability)
        logger.info("%d labels; agreement between runs of k-means: %s", self.num_labels_chosen, self.stability)
        return project, clusters.centers


def _load(path: Path) -> np.ndarray | None:
    if not path.exists():
        return None
    try:
        features: np.ndarray = np.load(path)
    except (OSError, ValueError, EOFError) as error:
        logger.warning("cached features '%s' are damaged (%s); computed again", path, error)
        return None
    return features


def _label_map(points: np.ndarray, centers: np.ndarray, image: ImageFile) -> Int32[np.ndarray, "H W"]:
    """The nearest centre of every pixel, where distances are interpolated between the centres of the patches."""
    width = min(_LABEL_MAP_WIDTH, image.width)
    size = (width, max(1, round(width * image.height / image.width)))
    labels = np.zeros(size[::-1], np.int32)
    nearest = np.full(size[::-1], np.inf, np.float32)
    for label, center in enumerate(centers, start=1):  # one plane at a time: maps of many labels stay small in memory
        distance = cv2.resize(np.square(points - center).sum(axis=2), size, interpolation=cv2.INTER_LINEAR)
        labels[distance < nearest] = label
        np.minimum(nearest, distance, out=nearest)
    return labels
