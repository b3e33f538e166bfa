"""Match the pairs of a collection: images and label maps of two names in, the record of the pair out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

from sgam_core import AreaMatcher, Image, PairResult, PointMatcher, WholeImages, match_described
from sgam_core.errors import OptionError, SGAMError, StageError
from sgam_sfm import registry
from sgam_sfm.colmap.cameras import camera_matrix
from sgam_sfm.external import WorkerCommand
from sgam_sfm.images import read_image, read_mask
from sgam_sfm.inputs import Inputs
from sgam_sfm.label_maps import LabelMaps
from sgam_sfm.logs import in_one_line
from sgam_sfm.machine import out_of_memory, single_threads
from sgam_sfm.models import require_licence
from sgam_sfm.options import MatchOptions
from sgam_sfm.pairs import Pair
from sgam_sfm.read_ahead import ReadAhead
from sgam_sfm.runs.store import PairRecord
from sgam_sfm.runs.supervised import crashes, given_up
from sgam_sfm.threads import in_order

_log = logging.getLogger(__name__)
_DESCRIPTIONS_IN_MEMORY = 1024  # about 1 MB each
_MOST_FAULTS = 3  # that nobody foresaw, before there is any result
_MOST_AT_ONCE = 16  # pairs, each with crops in memory; more would wait for the interpreter


def create_matcher(options: MatchOptions) -> PointMatcher:
    """The point matcher that the options name.

    Raises: OptionError when its licence forbids commercial use and is not accepted, or for wrong options.
    """
    require_licence("matcher", options.matcher, options.accept_licence)
    if options.precision != "auto" and not registry.takes("matcher", options.matcher, "precision"):
        raise OptionError(f"--precision {options.precision}: '{options.matcher}' has no choice of it; leave it out")
    if options.weights is not None and not registry.takes("matcher", options.matcher, "weights"):
        raise OptionError(f"--weights '{options.weights}': '{options.matcher}' has none; leave it out")
    matcher: PointMatcher = registry.create(
        "matcher",
        options.matcher,
        weights=options.weights,
        device=options.device,
        precision=options.precision,
        seed=options.seed,
        worker=WorkerCommand.of(options, "matcher", options.matcher),
    )
    return matcher


def reset(matcher: PointMatcher) -> None:
    """Empty a point matcher's caches, where it has any."""
    forget = getattr(matcher, "reset", None)
    if forget is not None:
        forget()


def is_repeatable(matcher: PointMatcher) -> bool:
    """Whether a point matcher says that its caches change no result."""
    return getattr(matcher, "repeatable", False)


def is_concurrent(matcher: PointMatcher) -> bool:
    """Whether a point matcher says that threads may ask it at once, and get what they would get one after the other."""
    return getattr(matcher, "concurrent", False)


def create_area_matcher(options: MatchOptions, ignored: Collection[int] = ()) -> AreaMatcher:
    """The area matcher that the options name; ignored: more labels that form no areas."""
    matcher: AreaMatcher = registry.create("area-matcher", options.area_matcher, options=options.sgam_ignoring(ignored))
    return matcher


def special_labels(options: MatchOptions, labels: LabelMaps | None) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The labels that form no areas, and those that nothing is matched in.

    Raises: OptionError when the options name a label that is none.
    """
    if labels is None:
        return (), ()
    ignored = (*labels.set.ignored, *labels.set.ids(options.ignore_labels, "--ignore-labels"))
    return ignored, labels.set.ids(options.mask_matches, "--mask-matches")


def failed_record(pair: Pair, reason: str) -> PairRecord:
    """The record of a pair that could not be matched."""
    _log.warning("%s - %s: %s", *pair, reason)
    return PairRecord(pair=pair, result=None, error=reason)


class CollectionMatcher:
    """Matches pairs of one collection by name; images are read and described once while they stay in memory.

    Threads may match at once where the point matcher is concurrent.

    Raises: OptionError when the options ignore or mask a label that is none.
    """

    def __init__(
        self, options: MatchOptions, inputs: Inputs, labels: LabelMaps | None, point_matcher: PointMatcher
    ) -> None:
        self._options, self._inputs, self._labels, self._point_matcher = options, inputs, labels, point_matcher
        ignored, self._masked = special_labels(options, labels)
        self._area_matcher = create_area_matcher(options, ignored)
        self.image = ReadAhead(self._read_image, 2 * options.block_images)  # those of one block
        self._description = lru_cache(_DESCRIPTIONS_IN_MEMORY)(self._describe)
        self._faults, self._any_result = 0, False
        reset(point_matcher)  # what it keeps goes by image names, which were another collection's

    def match_blocks(
        self, blocks: Sequence[tuple[int, Sequence[Pair]]], begin: Callable[[Pair], None], *, alone: int = 0
    ) -> Iterator[tuple[int, PairRecord]]:
        """The number of the block and the record of every pair, in their order.

        Where the point matcher is concurrent, a pair has one thread, and several are matched at once: that is faster
        than many threads for one, and results do not depend on how many there are.

        Args: begin: told of each pair that is matched alone. alone: so many blocks whose pairs are, in any case.
        """
        if not is_concurrent(self._point_matcher):
            yield from self._match_alone(blocks, begin)
            return
        with single_threads() as threads:
            at_once = min(threads, _MOST_AT_ONCE)
            alone = alone if at_once > 1 else len(blocks)
            yield from self._match_alone(blocks[:alone], begin)
            pairs = self._in_blocks(blocks[alone:])
            yield from in_order(lambda item: (item[0], self._unless_given_up(item[1])), pairs, at_once)

    def _match_alone(
        self, blocks: Sequence[tuple[int, Sequence[Pair]]], begin: Callable[[Pair], None]
    ) -> Iterator[tuple[int, PairRecord]]:
        for number, pair in self._in_blocks(blocks):
            begin(pair)
            yield number, self._unless_given_up(pair)

    def _in_blocks(self, blocks: Sequence[tuple[int, Sequence[Pair]]]) -> Iterator[tuple[int, Pair]]:
        """What surrounds the matching of each block's pairs: caches of the point matcher start empty, but for those
        that change no result.

        Images of the pairs that follow are read while one is matched; not once a process of this run has been ended
        from outside, so that what a pair is told to have done was done for this pair.
        """
        for number, pairs in blocks:
            if not is_repeatable(self._point_matcher):
                reset(self._point_matcher)
            names = () if crashes() else [name for pair in pairs for name in pair]
            with self.image.ahead(names):
                for pair in pairs:
                    yield number, pair

    def _unless_given_up(self, pair: Pair) -> PairRecord:
        reason = given_up(pair)
        return failed_record(pair, reason) if reason else self.match(pair)

    def match(self, pair: Pair) -> PairRecord:
        """The record of one pair; whatever stops it becomes part of it, such as a fault in somebody's point matcher.

        Raises: StageError when the point matcher is at its end, and not only this pair; what nobody foresaw, when it
            is all that has come of this matcher so far.
        """
        try:
            result = self._match_within_memory(pair)
        except StageError:
            raise
        except SGAMError as error:
            return failed_record(pair, str(error))
        except Exception as error:
            self._faults += 1
            if "CUDA error" in str(error) or (self._faults == _MOST_FAULTS and not self._any_result):
                raise  # nothing will work in this process any more, or nothing ever did
            _log.info("%s - %s failed", *pair, exc_info=error)
            return failed_record(pair, f"{in_one_line(error)}; the log has the traceback")
        self._any_result = True
        return PairRecord(pair=pair, result=result)

    def _match_within_memory(self, pair: Pair) -> PairResult:
        """Match a pair; once more, with empty caches, when memory does not suffice."""
        try:
            return self._match(pair)
        except Exception as error:
            if isinstance(error, SGAMError) or not out_of_memory(error):
                raise
            _log.warning("%s - %s: memory does not suffice (%s), tried again with empty caches", *pair, error)
        self._empty_caches()  # here, where the error no longer holds what the attempt had in memory
        try:
            return self._match(pair)
        except Exception as error:
            if isinstance(error, SGAMError) or not out_of_memory(error):
                raise
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise OptionError(
                f"memory does not suffice ({reason}); lower --image-size and --area-size, or take another --matcher"
            ) from error

    def _empty_caches(self) -> None:
        import torch

        reset(self._point_matcher)
        self.image.clear()
        self._description.cache_clear()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()

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
