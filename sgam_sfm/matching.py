"""Match the pairs of a collection, block by block, into the store."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from sgam_core import AreaMatcher, Image, PairResult, PointMatcher, WholeImages, match_described
from sgam_core.errors import SGAMError
from sgam_sfm import registry
from sgam_sfm.database import camera_matrix
from sgam_sfm.images import read_image, read_mask
from sgam_sfm.inputs import Inputs
from sgam_sfm.label_maps import LabelMaps
from sgam_sfm.models import require_licence
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair
from sgam_sfm.progress import Stages
from sgam_sfm.store import PairRecord, PairStore

if TYPE_CHECKING:
    from sgam_sfm.executors import Executor, MatchingJob

_log = logging.getLogger(__name__)
_DESCRIPTIONS_IN_MEMORY = 1024  # about 1 MB each


def create_matcher(options: MatchOptions) -> PointMatcher:
    """The point matcher that the options name.

    Raises: OptionError when its licence forbids commercial use and is not accepted, or for wrong options.
    """
    require_licence("matcher", options.matcher, options.accept_licence)
    matcher: PointMatcher = registry.create(
        "matcher", options.matcher, weights=options.weights, device=options.device, seed=options.seed
    )
    return matcher


def create_area_matcher(options: MatchOptions, ignored: Collection[int] = ()) -> AreaMatcher:
    """The area matcher that the options name; ignored: more labels that form no areas."""
    matcher: AreaMatcher = registry.create("area-matcher", options.area_matcher, options=options.sgam_ignoring(ignored))
    return matcher


def match_blocks(
    work: Sequence[Sequence[Pair]],
    store: PairStore,
    executor: Executor,
    job: MatchingJob,
    stages: Stages,
    numbers: Collection[int] | None = None,
) -> dict[str, float]:
    """Match every block that the store does not hold yet, and give the seconds that each step took, of all workers.

    A block follows from its pairs and the options alone: the point matcher starts each one with empty caches, so that
    what it did before cannot decide how it batches.

    Args: numbers: of the blocks to see to; all of them by default.
    """
    wanted = [(number, work[number]) for number in (range(len(work)) if numbers is None else numbers)]
    seconds: dict[str, float] = {}
    with stages.stage("Matching pairs", sum(len(block) for _, block in wanted)) as advance:
        waiting = []
        for number, block in wanted:
            if store.has(number):
                advance(len(block))
            else:
                waiting.append((number, block))
        for number, records in executor.run(job, waiting, advance):
            store.write(number, records)
            for record in records:
                for step, spent in ({} if record.result is None else record.result.seconds).items():
                    seconds[step] = seconds.get(step, 0.0) + spent
    return seconds


def special_labels(options: MatchOptions, labels: LabelMaps | None) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The labels that form no areas, and those that nothing is matched in.

    Raises: OptionError when the options name a label that is none.
    """
    if labels is None:
        return (), ()
    ignored = (*labels.set.ignored, *labels.set.ids(options.ignore_labels, "--ignore-labels"))
    return ignored, labels.set.ids(options.mask_matches, "--mask-matches")


class CollectionMatcher:
    """Matches pairs of one collection by name; images are read and described once while they stay in memory.

    Raises: OptionError when the options ignore or mask a label that is none.
    """

    def __init__(
        self, options: MatchOptions, inputs: Inputs, labels: LabelMaps | None, point_matcher: PointMatcher
    ) -> None:
        self._options, self._inputs, self._labels, self._point_matcher = options, inputs, labels, point_matcher
        ignored, self._masked = special_labels(options, labels)
        self._area_matcher = create_area_matcher(options, ignored)
        self.image = lru_cache(2 * options.block_images)(self._read_image)  # those of one block
        self._description = lru_cache(_DESCRIPTIONS_IN_MEMORY)(self._describe)

    def start_block(self) -> None:
        """Empty the point matcher's caches, where it has any."""
        reset = getattr(self._point_matcher, "reset", None)
        if reset is not None:
            reset()

    def match(self, pair: Pair) -> PairRecord:
        """The record of one pair; an error of its images becomes part of it."""
        try:
            result = self._match(pair)
        except SGAMError as error:
            _log.warning("%s - %s: %s", *pair, error)
            return PairRecord(pair=pair, result=None, error=str(error))
        return PairRecord(pair=pair, result=result)

    def _match(self, pair: Pair) -> PairResult:
        image0, image1 = (self.image(name) for name in pair)
        failed = {} if self._labels is None or not self._area_matcher.needs_labels else self._labels.set.failed
        reason = next((failed[name] for name in pair if name in failed), "")
        if reason:
            whole = match_described(image0, image1, None, None, WholeImages(), self._point_matcher, self._options.sgam)
            return replace(whole, fallback=f"no usable label map: {reason}")
        described = (self._description(pair[0]), self._description(pair[1]))
        return match_described(image0, image1, *described, self._area_matcher, self._point_matcher, self._options.sgam)

    def _read_image(self, name: str) -> Image:
        file = self._inputs.images[name]
        mask = read_mask(self._options.mask_path, file) if self._options.mask_path else None
        if self._labels is not None and (wanted := self._labels.mask(file, self._masked)) is not None:
            mask = wanted if mask is None else mask & wanted
        matrix = camera_matrix(self._inputs.cameras[name])
        return Image(name=name, pixels=read_image(file), mask=mask, camera_matrix=matrix)

    def _describe(self, name: str) -> Any:
        labels = None if self._labels is None else self._labels.read(name)
        return self._area_matcher.describe(self.image(name), labels)
