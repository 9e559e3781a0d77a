"""Distances to the nearest marked cell of a grid are exact."""

import numpy as np
import pytest

from impslam.maps.distances import distances


@pytest.mark.parametrize("share", [0.002, 0.05, 0.5, 1.0])
def test_distances_are_those_to_the_nearest_marked_cell(rng, share):
    marked = rng.random((40, 57)) < share
    marked[3, 5] = True
    cells, all_cells = np.argwhere(marked), np.indices(marked.shape).reshape(2, -1).T
    nearest = np.linalg.norm(all_cells[:, None] - cells, axis=2).min(axis=1).reshape(marked.shape)
    np.testing.assert_allclose(distances(marked, 0.1), 0.1 * nearest, rtol=1e-6)


def test_without_a_marked_cell_all_are_infinitely_far():
    assert np.isinf(distances(np.zeros((4, 6), bool), 0.05)).all()
