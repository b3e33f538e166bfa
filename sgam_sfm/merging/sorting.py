"""The order of numbers, equal ones in the order in which they come."""

from __future__ import annotations

import numpy as np

from sgam_sfm.merging.compiled import compiled

_FEW = 200  # to insert one by one


def stable_order(values: np.ndarray) -> np.ndarray:
    """What `np.argsort` gives for numbers (N,) with kind="stable", several times as fast.

    Numbers within 16 bits of each other are counted. All others are sorted with the processor's wide instructions,
    which leave equal ones in any order; these are put in order afterwards.
    """
    if values.dtype.kind == "i" and len(values):
        low = int(values.min())
        if int(values.max()) - low < 2**16:
            return np.argsort((values - low).astype(np.uint16), kind="stable")
    order = np.argsort(values)
    return order if _order_equal(values[order], order) else np.argsort(values, kind="stable")


@compiled
def _order_equal(values: np.ndarray, order: np.ndarray) -> bool:
    """Sort those of an order (N,) whose values (N,), which are sorted, are equal; False where there are too many."""
    begin = 0
    for end in range(1, len(order) + 1):
        if end < len(order) and values[end] == values[begin]:
            continue
        if end - begin > _FEW:
            return False
        for place in range(begin + 1, end):
            row, slot = order[place], place
            while slot > begin and order[slot - 1] > row:
                order[slot] = order[slot - 1]
                slot -= 1
            order[slot] = row
        begin = end
    return True
