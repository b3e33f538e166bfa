"""One descriptor an image, from the features of coseg, from label maps, or from a file of hloc."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from sgam_core.errors import InputError, SGAMError
from sgam_sfm.hloc_files import read_global_descriptors
from sgam_sfm.inputs import read_images, refuse_among_images
from sgam_sfm.machine import find_device, use_threads
from sgam_sfm.pair_lists.options import DescriptorOptions
from sgam_sfm.progress import Stages
from sgam_sfm.segmenters.coseg import CoSeg
from sgam_sfm.segmenters.labels import LabelFolder

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Descriptors:
    """vectors (N, D) of `names`, whose cosine tells how alike two images are; why the other images have none."""

    names: tuple[str, ...]
    vectors: Float32[np.ndarray, "N D"]
    failed: Mapping[str, str]


def describe_images(options: DescriptorOptions, names: Sequence[str], stages: Stages) -> Descriptors:
    """The descriptors of the images, by the options.

    Raises: SGAMError when no image has one; single images without one are named in the result.
    """
    if options.descriptors is not None:
        return hloc_descriptors(options.descriptors, names)
    if options.labels is not None:
        return label_histograms(options.labels, names, stages)
    return coseg_descriptors(options, stages)


def hloc_descriptors(path: Path, names: Sequence[str]) -> Descriptors:
    """Those of an h5 file of hloc."""
    found: dict[str, np.ndarray] = read_global_descriptors(path, names)
    missing = {name: f"'{name}' has no global_descriptor in '{path}'" for name in names if name not in found}
    return _described(found, missing)


def label_histograms(folder: Path, names: Sequence[str], stages: Stages) -> Descriptors:
    """Square roots of the shares of labels, so that the cosine is Bhattacharyya's coefficient.

    Pixels without a label, and labels that labels.json ignores, do not count.
    """
    maps = LabelFolder(folder)
    shares: dict[str, dict[int, float]] = {}
    failed: dict[str, str] = {}
    with stages.stage("Reading label maps", len(names)) as advance:
        for name in names:
            try:
                ids, counts = np.unique(maps.read(name), return_counts=True)
                shares[name] = dict(zip(ids.tolist(), (counts / counts.sum()).tolist(), strict=True))
            except InputError as error:
                failed[name] = str(error)
            advance(1)
    without = {0, *maps.label_set.ignored}
    columns = {
        label: place for place, label in enumerate(sorted({*(id for of in shares.values() for id in of)} - without))
    }
    vectors = {}
    for name, of in shares.items():
        vectors[name] = np.zeros(len(columns), np.float32)
        for label, share in of.items():
            if label not in without:
                vectors[name][columns[label]] = np.sqrt(share)
    return _described(vectors, failed)


def coseg_descriptors(options: DescriptorOptions, stages: Stages) -> Descriptors:
    """Mean patch features, the mean of all images subtracted: what every image shows tells none from another."""
    use_threads(options.threads)
    cache = options.cache or default_run(options.output) / "cache"
    refuse_among_images(cache, options.images, "--cache")
    found = read_images(options.images, cache, stages, options.max_image_size)
    device = str(find_device(options.device, "--device"))
    segmenter = CoSeg(device=device, threads=options.threads, cache_folder=cache)
    vectors: dict[str, np.ndarray] = {}
    failed = dict(found.failed)
    with stages.stage("Describing images", len(found.images)) as advance:
        for file, made in segmenter.describe(tuple(found.images.values()), advance):
            if isinstance(made, SGAMError):
                failed[file.name] = str(made)
            else:
                vectors[file.name] = made
    described = _described(vectors, failed)
    centred = described.vectors - described.vectors.mean(axis=0)
    return Descriptors(names=described.names, vectors=centred, failed=described.failed)


def default_run(output: Path) -> Path:
    """The result folder of the `match` that a pair list is for, where nothing else is said."""
    return output.parent / "out"


def _described(vectors: Mapping[str, np.ndarray], failed: Mapping[str, str]) -> Descriptors:
    if not vectors:
        raise InputError(f"none of the {len(failed)} images can be compared: {min(failed.values())}")
    for reason in failed.values():
        _log.warning("%s", reason)
    return Descriptors(names=tuple(vectors), vectors=np.stack(list(vectors.values())), failed=failed)
