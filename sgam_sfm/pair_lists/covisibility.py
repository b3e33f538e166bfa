"""How many points of a model two images share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int
from scipy.sparse import csr_array

from sgam_sfm.pair_lists.ranking import ScoreRows


def shared_point_scores(points: Sequence[Int[np.ndarray, " _"]]) -> ScoreRows:
    """The number of points that pairs share.

    Args: points: ids of the points that each image observes, each id once in an image.
    """
    ids, columns = np.unique(np.concatenate([np.zeros(0, np.int64), *points]), return_inverse=True)
    rows = np.repeat(np.arange(len(points)), [len(seen) for seen in points])
    sees = csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(len(points), len(ids)))
    seen_by = sees.T.tocsr()

    def scores_of(block: Int[np.ndarray, " B"]) -> Float32[np.ndarray, "B N"]:
        shared: np.ndarray = (sees[block] @ seen_by).toarray().astype(np.float32)
        return shared

    return scores_of
