"""Range and bearing to Cartesian."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.geometry.polar import to_cartesian

STEP = 1e-6


@given(st.floats(0.02, 30.0), st.floats(-7.0, 7.0))
def test_covariance_is_carried_by_the_numerical_jacobian(r: float, alpha: float) -> None:
    R_polar = np.array([[0.03**2, 2e-5], [2e-5, 0.01**2]])
    columns = [
        (
            to_cartesian(r + dr, alpha + da, R_polar)[0]
            - to_cartesian(r - dr, alpha - da, R_polar)[0]
        )
        / (2.0 * STEP)
        for dr, da in ((STEP, 0.0), (0.0, STEP))
    ]
    jacobian = np.column_stack(columns)
    _, R = to_cartesian(r, alpha, R_polar)
    np.testing.assert_allclose(R, jacobian @ R_polar @ jacobian.T, rtol=1e-5, atol=1e-10)
    assert np.linalg.eigvalsh(R)[0] > 0.0


def test_axes_are_along_and_across_the_beam() -> None:
    z, R = to_cartesian(2.0, np.pi / 2.0, np.diag([0.03**2, 0.01**2]))
    assert z == pytest.approx([0.0, 2.0], abs=1e-15)
    np.testing.assert_allclose(R, np.diag([0.02**2, 0.03**2]), atol=1e-15)
