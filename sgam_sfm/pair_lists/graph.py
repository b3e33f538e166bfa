"""The graph that pairs make of images: its connected parts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sgam_sfm.pairs import Pair


def connected_parts(pairs: Sequence[Pair]) -> list[tuple[str, ...]]:
    """The images that pairs join, directly or through others: the largest part first, names sorted."""
    names = sorted({name for pair in pairs for name in pair})
    row = {name: index for index, name in enumerate(names)}
    edges = np.array([(row[name0], row[name1]) for name0, name1 in pairs], np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(edges.shape[1], np.int8), tuple(edges)), shape=(len(names), len(names)))
    _, labels = connected_components(graph, directed=False) if names else (0, [])
    parts: dict[int, list[str]] = {}
    for name, label in zip(names, labels, strict=True):
        parts.setdefault(int(label), []).append(name)
    return sorted((tuple(part) for part in parts.values()), key=lambda part: (-len(part), part))
