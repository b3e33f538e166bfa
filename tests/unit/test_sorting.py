"""The order of numbers, equal ones in the order in which they come."""

import numpy as np
import pytest

from sgam_sfm.merging.sorting import stable_order


@pytest.mark.parametrize("top", [3, 500, 2**15, 2**40])
@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.float32, np.float64])
def test_equal_numbers_stay_in_their_order(top, dtype):
    values = np.random.default_rng(0).integers(-top // 2, top // 2 + 1, 3000).clip(-(2**30), 2**30).astype(dtype)
    np.testing.assert_array_equal(stable_order(values), np.argsort(values, kind="stable"))


@pytest.mark.parametrize("values", [[], [7], [2**40, 0, 2**40, 0], [-(2**31), 2**31 - 1, -(2**31)]])
def test_few_numbers_far_apart(values):
    values = np.array(values, np.int64)
    np.testing.assert_array_equal(stable_order(values), np.argsort(values, kind="stable"))


def test_numbers_of_32_bits_at_both_ends():
    values = np.array([2**31 - 1, -(2**31), 2**31 - 1, -(2**31)], np.int32)
    np.testing.assert_array_equal(stable_order(values), [1, 3, 0, 2])
