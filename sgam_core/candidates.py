"""From distances between the areas of two images to certain matches and doubtful groups (T_da of the paper)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Edges = list[tuple[int, int]]


def split_candidates(distances: Float[np.ndarray, "A B"], doubt_margin: float) -> tuple[Edges, list[Edges]]:
    """Candidates that nothing competes with, and groups of those that compete.

    (i, j) is a candidate when distances[i, j] <= min(best of row i, best of column j) + doubt_margin. A connected
    component with one candidate is a certain match, any other a doubtful group.

    Args: distances (A, B) between the areas of image 0 and 1, infinite where a match is impossible.
    Returns: (certain, doubtful), both ordered by row then column.
    """
    if distances.size == 0:
        return [], []
    best = np.minimum(distances.min(axis=1)[:, None], distances.min(axis=0)[None, :])
    rows, columns = np.nonzero(np.isfinite(distances) & (distances <= best + doubt_margin))
    nodes = sum(distances.shape)
    graph = coo_array((np.ones(len(rows)), (rows, columns + len(distances))), shape=(nodes, nodes))
    component = connected_components(graph, directed=False)[1][rows]
    groups: dict[int, Edges] = {}
    for key, i, j in zip(component.tolist(), rows.tolist(), columns.tolist(), strict=True):
        groups.setdefault(key, []).append((i, j))
    certain = [group[0] for group in groups.values() if len(group) == 1]
    return sorted(certain), sorted(group for group in groups.values() if len(group) > 1)
