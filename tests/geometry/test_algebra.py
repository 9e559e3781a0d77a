"""Symmetric (3, 3) matrices in kernels, against numpy, and what has no inverse."""

import numpy as np
import pytest

from impslam.geometry.algebra import SINGULAR, invert, invert_into, solve


def test_solve_equals_numpy(rng):
    for _ in range(50):
        root = rng.normal(size=(3, 5))
        A, b = root @ root.T + 1e-3 * np.eye(3), rng.normal(size=3)
        x, inverse = b.copy(), A.copy()
        assert solve(A, x)
        assert invert(inverse)
        np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(inverse @ A, np.eye(3), atol=1e-8)


@pytest.mark.parametrize(
    "diagonal", [[1, 1, 0], [1, -1, 1], [0, 1, 1], [np.nan, 1, 1], [1, 1, np.inf]]
)
def test_a_matrix_that_is_not_positive_definite_has_no_solution(diagonal):
    A, b = np.diag(np.array(diagonal, float)), np.ones(3)
    assert not solve(A, b)
    assert not invert(A)
    assert (b == 1.0).all()
    np.testing.assert_array_equal(np.diag(A), diagonal)


def test_an_inverse_is_exact_for_badly_scaled_matrices():
    scale = np.array([1e-4, 1.0, 1e5])
    A = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -1.0], [0.5, -1.0, 2.0]]) * np.outer(scale, scale)
    truth = np.array([1.0, 2.0, 3.0]) / scale
    x, inverse = A @ truth, A.copy()
    assert solve(A, x)
    assert invert(inverse)
    np.testing.assert_allclose(x, truth, rtol=1e-12)
    np.testing.assert_array_equal(inverse, inverse.T)
    np.testing.assert_allclose(inverse, np.linalg.inv(A), rtol=1e-12)


@pytest.mark.parametrize("pivot", range(3))
def test_a_pivot_that_is_only_rounding_has_no_inverse(pivot):
    diagonal, scale, out = np.ones(3), [1.0, 1.0, 1.0], np.zeros((3, 3))
    scale[pivot] = 0.9 / SINGULAR
    assert invert_into(np.diag(diagonal), tuple(scale), out)
    np.testing.assert_array_equal(out, np.eye(3))
    scale[pivot], out[:] = 1.1 / SINGULAR, 0.0
    assert not invert_into(np.diag(diagonal), tuple(scale), out)
    assert not out.any()
