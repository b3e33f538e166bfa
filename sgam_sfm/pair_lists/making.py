"""Make the pair list that the options ask for."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from sgam_core.errors import InputError, OptionError
from sgam_sfm.colmap.reading import read_observations
from sgam_sfm.evaluation.ground_truth import read_ground_truth
from sgam_sfm.files import replacing
from sgam_sfm.images import inspect_image, list_images, printable
from sgam_sfm.pair_lists.covisibility import shared_point_scores
from sgam_sfm.pair_lists.descriptors import describe_images
from sgam_sfm.pair_lists.existing import existing_pairs
from sgam_sfm.pair_lists.options import (
    Exhaustive,
    FromFile,
    FromModel,
    FromPoses,
    MethodOptions,
    Retrieval,
    Sequential,
)
from sgam_sfm.pair_lists.ranking import ScoreRows, best_partners, cosine_scores
from sgam_sfm.pair_lists.sequences import beyond, find_sequences, following
from sgam_sfm.pair_lists.shared_view import shared_view_scores, typical_depth
from sgam_sfm.pairs import Pair, all_pairs, write_pairs
from sgam_sfm.progress import Stages

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class MadePairs:
    """A pair list. names: the images of the folder. pairs: sorted, each once. failed: images left out, and why."""

    names: tuple[str, ...]
    pairs: tuple[Pair, ...]
    failed: Mapping[str, str]


def make_pair_list(options: MethodOptions, stages: Stages) -> MadePairs:
    """Choose the pairs and write them to the output.

    Raises: SGAMError for what cannot be used at all, or when no pair is left; single images that fail are named.
    """
    if options.output.is_dir():
        raise OptionError(f"--output '{options.output}' is a folder; give a file, '{options.output / 'pairs.txt'}'")
    names, failed = _usable_names(options)
    if len(names) < 2:
        raise InputError(f"'{options.images}' has {len(names)} image that can be used; a pair needs two")
    pairs, more_failed = _choose(options, names, stages)
    if not pairs:
        raise InputError(f"no pair is left of the {len(names)} images in '{options.images}': {_remedy(options)}")
    with replacing(options.output) as partial:
        write_pairs(partial, pairs)
    return MadePairs(names=names, pairs=pairs, failed=failed | dict(more_failed))


def _usable_names(options: MethodOptions) -> tuple[tuple[str, ...], dict[str, str]]:
    """The images by name alone, undecoded; those whose names no list can hold are left out."""
    failed: dict[str, str] = {}
    usable = []
    for name in list_images(options.images)[0]:
        if printable(name) == name:
            usable.append(name)
            continue
        try:
            inspect_image(options.images, name)
        except InputError as error:
            failed[printable(name)] = str(error)
    return tuple(usable), failed


def _choose(
    options: MethodOptions, names: tuple[str, ...], stages: Stages
) -> tuple[tuple[Pair, ...], Mapping[str, str]]:
    """The pairs, and images that failed."""
    match options:
        case Exhaustive():
            return all_pairs(names, options.max_images or len(names)), {}
        case Sequential():
            return _sequential(options, names, stages)
        case Retrieval():
            described = describe_images(options, names, stages)
            scores_of = cosine_scores(described.vectors)
            found = _ranked(described.names, scores_of, options.num, options.min_score, stages)
            return found, described.failed
        case FromModel():
            return _from_model(options, names, stages), {}
        case FromPoses():
            return _from_poses(options, names, stages), {}
        case FromFile():
            return _in_order(existing_pairs(options.file, names, options.min_score)), {}
    raise AssertionError(options)


def _sequential(
    options: Sequential, names: tuple[str, ...], stages: Stages
) -> tuple[tuple[Pair, ...], Mapping[str, str]]:
    pairs: list[Pair] = []
    for sequence in find_sequences(names):
        rows = following(sequence, options.overlap, quadratic=options.quadratic_overlap)
        pairs += [(names[i], names[j]) for i, j in rows.tolist()]
    if not options.loop_closure:
        return _in_order(pairs), {}
    described = describe_images(options, names, stages)
    sequences = find_sequences(described.names)
    looking = np.sort(np.concatenate([sequence[:: options.loop_period] for sequence in sequences]))
    scores_of = beyond(cosine_scores(described.vectors), sequences, options.overlap)
    loops = _ranked(described.names, scores_of, options.num, options.min_score, stages, looking)
    return _in_order([*pairs, *loops]), described.failed


def _from_model(options: FromModel, names: tuple[str, ...], stages: Stages) -> tuple[Pair, ...]:
    with stages.stage("Reading the model", None):
        observed = read_observations(options.model)
    others = sorted(set(observed) - set(names))
    if others:
        _log.warning("%s has %d images that are not in the folder, such as '%s'", options.model, len(others), others[0])
    known = tuple(name for name in names if name in observed)
    _require_two(known, names, f"the model in '{options.model}'", others)
    scores_of = shared_point_scores([observed[name] for name in known])
    return _ranked(known, scores_of, options.num, max(options.min_score, 1), stages)


def _from_poses(options: FromPoses, names: tuple[str, ...], stages: Stages) -> tuple[Pair, ...]:
    truth = read_ground_truth(options.poses, options.poses_format or None, options.images)
    views = {name: view for name, view in truth.views_of(names).items() if view.cam_from_world is not None}
    known = tuple(name for name in names if name in views)
    _require_two(known, names, f"'{options.poses}' ({truth.format})", sorted(truth.views))
    posed = [views[name] for name in known]
    depth = options.depth or typical_depth(posed)
    _log.info("the scene is taken to be %.4g away from the cameras, in the unit of the poses", depth)
    scores_of = shared_view_scores(posed, depth, options.max_rotation_deg)
    return _ranked(known, scores_of, options.num, options.min_score, stages)


def _ranked(
    names: Sequence[str],
    scores_of: ScoreRows,
    num: int,
    min_score: float,
    stages: Stages,
    rows: Int[np.ndarray, " R"] | None = None,
) -> tuple[Pair, ...]:
    rows = np.arange(len(names)) if rows is None else rows
    with stages.stage("Comparing images", len(rows)) as advance:
        found = best_partners(rows, scores_of, num, min_score, advance)
    return _in_order((names[i], names[j]) for i, j in found.tolist())


def _in_order(pairs: Iterable[Pair]) -> tuple[Pair, ...]:
    """Pairs sorted, each once, the name that sorts first in front."""
    return tuple(sorted({(min(pair), max(pair)) for pair in pairs}))


def _require_two(known: Sequence[str], names: Sequence[str], where: str, others: Sequence[str]) -> None:
    if len(known) < 2:
        hint = f"; its images are like '{others[0]}', those of the folder like '{names[0]}'" if others else ""
        raise InputError(f"{where} has {len(known)} of the {len(names)} images with a pose; expected two or more{hint}")


def _remedy(options: MethodOptions) -> str:
    if isinstance(options, FromModel):
        return f"no two images of the model share {max(options.min_score, 1):g} points; lower --min-score"
    if hasattr(options, "min_score"):
        return f"none scores {options.min_score:g}; lower --min-score"
    return "every folder holds one frame; put the frames of a video into one folder, or use another method"
