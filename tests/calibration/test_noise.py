"""Variances of odometry: what they do to a motion, and whether they are found again."""

import numpy as np
import pytest
from tests.calibration.drives import SCALES, TRUE, drive, twists, wheels
from tests.numeric import jacobian

from impslam.calibration.noise import (
    MATCHING,
    cost,
    fitted,
    names,
    of_scans,
    slopes_of_wheels,
    spreads,
)
from impslam.calibration.residuals import residuals

ODOMETRY = len(MATCHING)
WHEELS, TWISTS = drive(wheels(20.0)[0]), drive(twists(20.0), true=SCALES)


def test_wheel_noise_spreads_motions_as_told(rng):
    """800 noisy readings of one drive; the spread in the lidar's frame, motion by motion."""
    exact, _ = wheels(6.0)
    of = drive(exact)
    B = spreads(of, TRUE)[ODOMETRY] * 0.01**2
    off = np.array([
        residuals(drive(exact, wheels(6.0, rng, 0.01)[1]), TRUE).values for _ in range(800)
    ])  # fmt: skip
    found = np.einsum("nki,nkj->kij", off, off)[:, :3, :3] / len(off)
    scale = np.sqrt(np.einsum("kii->ki", B[:, :3, :3]))
    np.testing.assert_allclose(
        found / scale[:, :, None] / scale[:, None], B[:, :3, :3] / scale[:, :, None] / scale[:, None],
        atol=0.2,
    )  # fmt: skip


@pytest.mark.parametrize(("of", "true"), [(WHEELS, TRUE), (TWISTS, SCALES)])
def test_spreads_are_covariances(of, true):
    B = spreads(of, true)
    assert len(B) == len(names(of))
    np.testing.assert_allclose(B, np.swapaxes(B, -1, -2))
    assert np.linalg.eigvalsh(B).min() > -1e-9


def test_slope_of_the_cost(rng):
    of = drive(wheels(20.0)[0])
    C, B, e = of_scans(of), spreads(of, TRUE), rng.normal(0.0, 0.01, (len(of.motions.begins), 4))
    at = rng.uniform(0.5, 1.5, len(B)) * 1e-4
    found = jacobian(lambda v: np.atleast_1d(cost(v, e, C, B)[0]), at, 1e-9)
    np.testing.assert_allclose(cost(at, e, C, B)[1], found[0], rtol=1e-4)


def test_variances_are_found_again(rng):
    of = drive(wheels(400.0)[0])
    C, B = of_scans(of), spreads(of, TRUE)
    true = np.array([0.002, 0.001, 0.002, 0.003, 0.01, 0.005, 0.005, 0.02]) ** 2
    S = C + np.tensordot(true, B, axes=1)
    e = np.einsum("kij,kj->ki", np.linalg.cholesky(S), rng.normal(size=(len(S), 4)))
    found = fitted(e, C, B, np.full(8, 1e-5))
    sigmas = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert np.abs((found.variances - true) / sigmas).max() < 3.0


def test_slopes_of_wheel_noise():
    """By the track, at which turns spread as 1 / track^2; by the mount, through the lever alone."""
    B, slopes, step = spreads(WHEELS, TRUE)[ODOMETRY], slopes_of_wheels(WHEELS, TRUE), 1e-6
    np.testing.assert_allclose(slopes[0, :, 2, 2], 2.0 / TRUE[0] * B[:, 2, 2])
    np.testing.assert_allclose(slopes[2, :, 2, 2], -2.0 / TRUE[2] * B[:, 2, 2], rtol=1e-4)
    for j in (3, 4, 5):
        moved = TRUE + step * (np.arange(9) == j)
        found = (spreads(WHEELS, moved)[ODOMETRY] - B) / step
        np.testing.assert_allclose(slopes[j], found, atol=1e-4 * np.abs(found).max())
    assert not slopes_of_wheels(TWISTS, SCALES).any()
