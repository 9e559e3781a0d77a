"""Parts of scipy are found alone, and are scipy's own."""

import subprocess
import sys

import scipy.optimize

from impslam.geometry.scipy_extension import load


def test_it_is_scipys_own_and_comes_alone() -> None:
    code = (
        "import sys; from impslam.geometry.scipy_extension import load;"
        "ours = load('scipy.optimize._lsap', 'scipy.optimize').linear_sum_assignment;"
        "print('scipy.optimize' in sys.modules);"
        "from scipy.optimize import linear_sum_assignment; print(ours is linear_sum_assignment)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (said.stdout, said.stderr) == ("False\nTrue\n", "")


def test_the_public_module_is_the_fallback() -> None:
    assert load("scipy.optimize._elsewhere", "scipy.optimize") is scipy.optimize
