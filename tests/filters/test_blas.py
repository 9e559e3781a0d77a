"""The BLAS that filters use is scipy's, whichever is imported first."""

import subprocess
import sys

import numpy as np
import pytest

from impslam.filters import blas


@pytest.mark.parametrize("first", ["import impslam.filters.blas", "import scipy.linalg.blas"])
def test_it_is_scipys_own(first: str) -> None:
    code = (
        f"{first}; import impslam.filters.blas as ours;"
        "from scipy.linalg import blas, cholesky; import numpy as np;"
        "print(ours._blas.dgemm is blas.dgemm, cholesky(4.0 * np.eye(1))[0, 0])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (said.stdout, said.stderr) == ("True 2.0\n", "")


@pytest.mark.parametrize("n", [1, 63, 64, 65, 300])
@pytest.mark.parametrize("square", [True, False])
def test_a_product_is_subtracted_from_the_lower_triangle_alone(n: int, square: bool) -> None:
    """Rows and columns from n on stay as they are, and above the diagonal nobody looks."""
    rng, size = np.random.default_rng(n), n + 9
    P = np.asfortranarray(rng.normal(size=(size, size)))
    L, R = rng.normal(size=(2, 3, n + 4))
    before = P.copy()
    if square:
        blas.subtract_square(P, n, L)
    else:
        blas.subtract_product(P, n, L, R)
    product = (L.T @ (L if square else R))[:n, :n]
    np.testing.assert_allclose(np.tril(P[:n, :n]), np.tril(before[:n, :n] - product), atol=1e-12)
    assert np.array_equal(P[n:], before[n:])
    assert np.array_equal(P[:, n:], before[:, n:])
