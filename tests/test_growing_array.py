"""Arrays that grow: what was handed out stays as it was."""

from copy import copy

import numpy as np

from impslam.growing_array import GrowingArray


def test_a_copy_and_its_original_grow_independently():
    grown = GrowingArray(2)
    grown.append(np.arange(6.0).reshape(3, 2), 3)
    other, view = copy(grown), grown.array
    other.append([10.0, 11.0])
    grown.append([20.0, 21.0])
    assert other.array.tolist() == [[0, 1], [2, 3], [4, 5], [10, 11]]
    assert grown.array.tolist() == [[0, 1], [2, 3], [4, 5], [20, 21]]
    other.shorten(2)
    other.append([7.0, 7.0])
    assert grown.array[2].tolist() == [4, 5]
    assert view.tolist() == [[0, 1], [2, 3], [4, 5]]


def test_a_copy_of_an_empty_one_is_empty():
    empty = GrowingArray()
    other = copy(empty)
    other.append(1.0)
    assert len(empty) == 0
    assert other.array.tolist() == [1.0]


def test_removed_rows_stay_in_copies_and_views():
    grown = GrowingArray(2)
    grown.append(np.arange(8.0).reshape(4, 2), 4)
    other, view = copy(grown), grown.array
    grown.remove(np.array([1, 2]))
    grown.append([8.0, 9.0])
    assert grown.array.tolist() == [[0, 1], [6, 7], [8, 9]]
    assert other.array.tolist() == view.tolist() == [[0, 1], [2, 3], [4, 5], [6, 7]]
