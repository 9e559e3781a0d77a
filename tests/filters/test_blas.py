"""The BLAS that filters use is scipy's, whichever is imported first."""

import subprocess
import sys

import pytest
import scipy.linalg.blas

from impslam.filters import blas


@pytest.mark.parametrize("first", ["import impslam.filters.blas", "import scipy.linalg.blas"])
def test_it_is_scipys_own(first: str) -> None:
    code = (
        f"{first}; import impslam.filters.blas as ours;"
        "from scipy.linalg import blas, cholesky, lapack; import numpy as np;"
        "print(all(getattr(ours, f) is getattr(blas, f) for f in ('dsyrk', 'dsyr2', 'dtrsm', 'dtrsv')),"
        "ours.dpotrf is lapack.dpotrf, cholesky(4.0 * np.eye(1))[0, 0])"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (said.stdout, said.stderr) == ("True True 2.0\n", "")


def test_it_is_found_where_scipy_keeps_it_elsewhere() -> None:
    assert blas.load("_elsewhere", "blas") is scipy.linalg.blas
