"""Chi-square quantiles equal scipy's, also in the closed form."""

import numpy as np
import pytest
from scipy.stats import chi2

from impslam.geometry.chi_square import quantile, quantiles


@pytest.mark.parametrize("probability", [0.5, 0.99, 0.999, 1.0 - 1e-6, 1.0])
@pytest.mark.parametrize("dof", [1, 2, 3, 40])
def test_quantiles(probability: float, dof: int) -> None:
    assert quantile(probability, dof) == pytest.approx(chi2.ppf(probability, dof), rel=1e-9)
    np.testing.assert_allclose(
        quantiles(probability, dof)[dof], chi2.ppf(probability, dof), rtol=1e-9
    )
