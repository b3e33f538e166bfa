"""The partners of every image by a score of all pairs, a block of rows at a time: memory grows with images, not pairs.

Images are rows 0..N-1; pairs come back as rows (i, j), i < j, each once, sorted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, Int

from sgam_sfm.progress import Advance

ScoreRows = Callable[[Int[np.ndarray, " B"]], Float32[np.ndarray, "B N"]]
"""Scores of some images with all: larger is better, -inf for a pair that is not wanted."""

_BLOCK = 256  # rows: 10 MB of scores for 10,000 images
_DIGITS = 5  # of a cosine: below it sums differ between machines, and the order with them


def best_partners(
    rows: Int[np.ndarray, " R"], scores_of: ScoreRows, num: int, min_score: float, advance: Advance
) -> Int[np.ndarray, "P 2"]:
    """Pairs of each of `rows` with its `num` best partners (0: all) that score at least `min_score`.

    A pair is kept when either of its images chose the other. Among equal scores the earlier image wins. advance: is
    told of every row.
    """
    chosen = [np.zeros((0, 2), np.int64)]
    for start in range(0, len(rows), _BLOCK):
        block = rows[start : start + _BLOCK]
        scores = scores_of(block)
        scores[np.arange(len(block)), block] = -np.inf
        if num:
            columns = np.argsort(-scores, axis=1, kind="stable")[:, :num]
            scores = np.take_along_axis(scores, columns, axis=1)
        else:
            columns = np.broadcast_to(np.arange(scores.shape[1]), scores.shape)
        wanted = (scores >= min_score) & np.isfinite(scores)
        partners = np.column_stack([np.broadcast_to(block[:, None], columns.shape)[wanted], columns[wanted]])
        chosen.append(np.unique(np.sort(partners, axis=1), axis=0))
        advance(len(block))
    found: np.ndarray = np.unique(np.concatenate(chosen), axis=0)
    return found


def cosine_scores(vectors: Float32[np.ndarray, "N D"]) -> ScoreRows:
    """Cosine similarity of descriptors, in -1..1; a descriptor of zeros is like none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit = (vectors / np.where(length > 0, length, 1)).astype(np.float32)

    def scores_of(rows: Int[np.ndarray, " B"]) -> Float32[np.ndarray, "B N"]:
        return np.round(unit[rows] @ unit.T, _DIGITS)

    return scores_of
