"""Chi-square quantiles equal scipy's, also in the closed form."""

import numpy as np
import pytest
from scipy.stats import chi2

from impslam.geometry.chi_square import (
    GATE_2D,
    GATE_3D_95,
    GATE_3D_99,
    GATE_3D_999,
    GATE_3D_9999,
    quantile,
    quantiles,
)


@pytest.mark.parametrize("probability", [0.5, 0.99, 0.999, 1.0 - 1e-6, 1.0])
@pytest.mark.parametrize("dof", [1, 2, 3, 40])
def test_quantiles(probability: float, dof: int) -> None:
    assert quantile(probability, dof) == pytest.approx(chi2.ppf(probability, dof), rel=1e-9)
    np.testing.assert_allclose(
        quantiles(probability, dof)[dof], chi2.ppf(probability, dof), rtol=1e-9
    )


def test_constants_are_quantiles() -> None:
    assert pytest.approx(quantile(0.999, 2), abs=0.02) == GATE_2D
    constants = GATE_3D_95, GATE_3D_99, GATE_3D_999, GATE_3D_9999
    probabilities = 0.95, 0.99, 0.999, 0.9999
    assert constants == pytest.approx([quantile(p, 3) for p in probabilities], abs=1e-3)
