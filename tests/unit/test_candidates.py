import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sgam_core.candidates import split_candidates

INF = np.inf


def test_a_clear_nearest_neighbour_is_certain():
    assert split_candidates(np.array([[0.1, 0.5], [0.6, 0.2]]), 0.2) == ([(0, 0), (1, 1)], [])


def test_similar_distances_make_a_doubtful_group():
    certain, doubtful = split_candidates(np.array([[0.1, 0.2, INF], [INF, INF, 0.3]]), 0.2)
    assert certain == [(1, 2)]
    assert doubtful == [[(0, 0), (0, 1)]]


def test_an_area_whose_best_partner_prefers_another_stays_out():
    # Row 1 has only column 0, which row 0 fits far better.
    assert split_candidates(np.array([[0.0], [0.4]]), 0.2) == ([(0, 0)], [])


def test_no_areas_no_candidates():
    assert split_candidates(np.zeros((0, 3)), 0.2) == ([], [])
    assert split_candidates(np.full((2, 2), INF), 0.2) == ([], [])


@given(
    arrays(float, st.tuples(st.integers(1, 5), st.integers(1, 5)), elements=st.sampled_from([0, 0.1, 0.3, 0.5, INF]))
)
def test_exchanging_the_images_exchanges_the_candidates(distances):
    certain, doubtful = split_candidates(distances, 0.2)
    swapped_certain, swapped_doubtful = split_candidates(distances.T, 0.2)
    assert {(j, i) for i, j in certain} == set(swapped_certain)
    assert {frozenset((j, i) for i, j in group) for group in doubtful} == set(map(frozenset, swapped_doubtful))
    assert len({i for i, _ in certain}) == len({j for _, j in certain}) == len(certain)
