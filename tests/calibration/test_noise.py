"""Variances of odometry: their effect on a motion, and their estimation."""

import numpy as np
import pytest
from tests.calibration.drives import SCALES, TRUE, drive, twists, wheels
from tests.numeric import jacobian

from impslam.calibration.noise import (
    MATCHING,
    cost,
    covariance_slopes,
    fit_variances,
    noise_names,
    scan_covariances,
    unit_covariances,
)
from impslam.calibration.residuals import residuals

ODOMETRY = len(MATCHING)
WHEELS, TWISTS = drive(wheels(20.0)[0]), drive(twists(20.0), true=SCALES)


def test_covariance_of_wheel_noise_matches_simulated_readings(rng):
    """800 noisy readings of one drive; the covariance in the lidar's frame, for each motion."""
    exact, _ = wheels(6.0)
    of = drive(exact)
    B = unit_covariances(of, TRUE)[ODOMETRY] * 0.01**2
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
def test_unit_covariances_are_symmetric_and_not_negative(of, true):
    B = unit_covariances(of, true)
    assert len(B) == len(noise_names(of))
    np.testing.assert_allclose(B, np.swapaxes(B, -1, -2))
    assert np.linalg.eigvalsh(B).min() > -1e-9


def test_gradient_of_the_cost(rng):
    of = drive(wheels(20.0)[0])
    C, B, e = (
        scan_covariances(of),
        unit_covariances(of, TRUE),
        rng.normal(0.0, 0.01, (len(of.motions.begins), 4)),
    )
    at = rng.uniform(0.5, 1.5, len(B)) * 1e-4
    found = jacobian(lambda v: np.atleast_1d(cost(v, e, C, B)[0]), at, 1e-9)
    np.testing.assert_allclose(cost(at, e, C, B)[1], found[0], rtol=1e-4)


def test_variances_are_estimated_within_their_sigma(rng):
    of = drive(wheels(400.0)[0])
    C, B = scan_covariances(of), unit_covariances(of, TRUE)
    true = np.array([0.002, 0.001, 0.002, 0.003, 0.01, 0.005, 0.005, 0.02]) ** 2
    S = C + np.tensordot(true, B, axes=1)
    e = np.einsum("kij,kj->ki", np.linalg.cholesky(S), rng.normal(size=(len(S), 4)))
    found = fit_variances(e, C, B, np.full(8, 1e-5))
    sigmas = np.sqrt(np.diag(np.linalg.inv(found.information)))
    assert np.abs((found.variances - true) / sigmas).max() < 3.0


def test_slopes_of_wheel_noise():
    """The variance of turns is proportional to 1 / track^2; the mount acts through the lever alone."""
    only = np.arange(len(noise_names(WHEELS))) == ODOMETRY
    B, found, step = (
        unit_covariances(WHEELS, TRUE)[ODOMETRY],
        covariance_slopes(WHEELS, TRUE, 1.0 * only),
        1e-6,
    )
    np.testing.assert_allclose(found[0, :, 2, 2], 2.0 / TRUE[0] * B[:, 2, 2])
    np.testing.assert_allclose(found[2, :, 2, 2], -2.0 / TRUE[2] * B[:, 2, 2], rtol=1e-4)
    for j in (3, 4, 5):
        moved = TRUE + step * (np.arange(9) == j)
        by_hand = (unit_covariances(WHEELS, moved)[ODOMETRY] - B) / step
        np.testing.assert_allclose(found[j], by_hand, atol=1e-4 * np.abs(by_hand).max())


@pytest.mark.parametrize(("of", "true"), [(WHEELS, TRUE), (TWISTS, SCALES)])
def test_slopes_of_stamp_jitter(of, true):
    """The covariance of the lidar's motion, as computed from the readings, for jittering stamps."""
    only, step = np.arange(len(noise_names(of))) == MATCHING.index("jitter"), 1e-6
    found, p = covariance_slopes(of, true, 1.0 * only), len(true) - 6
    seconds = (of.motions.ends - of.motions.begins)[:, None]

    def spread(parameters):
        moved = of.motions.joint + residuals(of, parameters).values
        return 2.0 * np.einsum("ki,kj->kij", moved / seconds, moved / seconds)

    for j in (0, 1, 2, p, p + 1, p + 2, p + 5):
        shift = step * (np.arange(len(true)) == j)
        by_hand = (spread(true + shift) - spread(true - shift)) / (2.0 * step)
        np.testing.assert_allclose(found[j], by_hand, atol=1e-4 * np.abs(found).max())
    assert not found[p + 3 : p + 5].any()


def test_slopes_of_the_noise_of_poses():
    """Noise in the readings has a variance proportional to the square of the scale applied to it."""
    for j, by in ((0, 0), (1, 0), (2, 1), (3, 1)):
        only = 1.0 * (np.arange(len(noise_names(TWISTS))) == ODOMETRY + j)
        straight = np.array([*SCALES[:3], 0.0, 0.0, 0.0, *SCALES[6:]])
        B, found = (
            unit_covariances(TWISTS, straight)[ODOMETRY + j],
            covariance_slopes(TWISTS, straight, only),
        )
        trace = np.einsum("kii->k", B[:, :2, :2]) if by == 0 else B[:, 2, 2]
        slope = np.einsum("kii->k", found[by, :, :2, :2]) if by == 0 else found[by, :, 2, 2]
        np.testing.assert_allclose(slope, 2.0 / SCALES[by] * trace, rtol=1e-9)
