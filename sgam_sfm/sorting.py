"""The order of numbers, equal ones in the order in which they come."""

from __future__ import annotations

import numpy as np

from sgam_sfm.compiled import compiled


def stable_order(values: np.ndarray) -> np.ndarray:
    """What `np.argsort` gives for numbers (N,) with kind="stable", several times as fast.

    Numbers within 16 bits of each other are counted. All others are sorted with the processor's wide instructions,
    which leave equal ones in any order; these are put in order afterwards, so there should not be many of a kind.
    """
    if values.dtype.kind == "i" and len(values):
        low = values.min()
        if values.max() - low < 2**16:
            return np.argsort((values - low).astype(np.uint16), kind="stable")
    order = np.argsort(values)
    _order_equal(values, order)
    return order


@compiled
def _order_equal(values: np.ndarray, order: np.ndarray) -> None:
    begin = 0
    for end in range(1, len(order) + 1):
        if end < len(order) and values[order[end]] == values[order[begin]]:
            continue
        if end - begin > 1:
            order[begin:end].sort()
        begin = end
