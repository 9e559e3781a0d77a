"""Dead reckoning as a function of its parameters: agreement with `odometry`, and derivatives."""

import numpy as np
import pytest
from tests.calibration.drives import SCALES, TRUE, twists, wheels
from tests.numeric import jacobian

from impslam.calibration.odometry_models import WINDOW, covered, make_model, motion, sum_between
from impslam.columns import batches
from impslam.geometry.se2 import compose
from impslam.odometry.encoders import Encoders
from impslam.odometry.odometry_pose import OdometryPoses
from impslam.odometry.velocity import Velocities
from impslam.types import OdometryPose, Velocity, WheelAngles

MODELS = [(wheels(12.0)[0], TRUE[:3]), (twists(12.0), SCALES[:3])]
BEGINS, ENDS = np.array([0.505, 3.011, 8.003]), np.array([2.507, 4.013, 8.507])


def columns(messages):
    """Return messages of one kind as columns."""
    (batch,) = batches(("odom", m) for m in messages)
    return batch["odom"]


def added_up(motions):
    """Return the pose after all motions."""
    pose = np.zeros(3)
    for d_pose in motions.d_pose:
        pose = compose(pose, d_pose)
    return pose


def readings(odometry, rng):
    """Return 200 readings of an odometry."""
    stamps = 0.05 * np.arange(200)
    if isinstance(odometry, Encoders):
        turned = np.cumsum(rng.uniform(-10.0, 30.0, (200, 2)), axis=0)
        return columns(WheelAngles(t, *row) for t, row in zip(stamps, turned, strict=True))
    speeds = rng.uniform([-0.2, -1.0], [0.5, 1.0], (200, 2))
    if isinstance(odometry, Velocities):
        return columns(Velocity(t, *row) for t, row in zip(stamps, speeds, strict=True))
    pose, rows = np.zeros(3), []
    for t, (x, turn) in zip(stamps, 0.05 * speeds, strict=True):
        pose = compose(pose, np.array([x, 0.1 * x, turn]))
        rows.append(OdometryPose(t, pose))
    return columns(rows)


@pytest.mark.parametrize(
    "odometry",
    [
        Encoders(wheel_radius=0.05, track=0.3, right_left_ratio=1.02, per_turn=360.0),
        OdometryPoses(distance_scale=0.9, turn_scale=1.1, turn_per_metre=0.05),
        Velocities(speed_scale=0.9, turn_scale=1.1),
    ],
)
def test_motions_agree_with_odometry(odometry, rng):
    rows = readings(odometry, rng)
    model = make_model(odometry, rows)
    values = np.array([getattr(odometry, name) for name in model.names])
    found = motion(model, values, 0.0, model.stamps[:1], model.stamps[-1:])
    true = added_up(odometry.motions(rows))
    np.testing.assert_allclose(
        [found.translation[0].real, found.translation[0].imag], true[:2], atol=1e-9
    )
    assert np.cos(found.turn[0] - true[2]) == pytest.approx(1.0, abs=1e-12)


def test_poses_that_come_again_with_a_scan_do_not_count_at_the_newest_time():
    """A log of odometry at 10 Hz, in which every other pose is followed by an older one, that of a scan."""
    at = {
        k: OdometryPose(0.1 * k, np.array([0.05 * k, 0.0, 0.01 * k]))
        for k in np.arange(0, 100, 0.5)
    }
    order = [row for k in range(99) for row in ([k] if k % 2 else [k, k - 0.5])][2:]
    model, repeated = (
        make_model(OdometryPoses(), columns(at[k] for k in rows)) for rows in (range(99), order)
    )
    for one, other in zip(
        motion(model, SCALES[:3], 0.06, BEGINS, ENDS),
        motion(repeated, SCALES[:3], 0.06, BEGINS, ENDS),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize(("model", "values"), MODELS)
def test_jacobians(model, values):
    at = np.append(values, 0.06)

    def moved(parameters):
        found = motion(model, parameters[:-1], parameters[-1], BEGINS, ENDS)
        return np.concatenate((found.translation.real, found.translation.imag, found.turn))

    found = motion(model, values, 0.06, BEGINS, ENDS)
    exact = np.concatenate((found.translation_D.real, found.translation_D.imag, found.turn_D))
    np.testing.assert_allclose(exact[:, :3], jacobian(moved, at, 1e-5)[:, :3], atol=2e-7)
    np.testing.assert_allclose(exact[:, 3], jacobian(moved, at, WINDOW)[:, 3], atol=2e-3)


def test_derivatives_are_smooth_for_straight_motion():
    """Below turns of some 1e-3 rad a step, the series replaces the closed form."""
    model, values = MODELS[0]
    for track in (0.3, 300.0, 3e5):
        at = np.array([values[0], 1.0, track])
        found = motion(model, at, 0.0, BEGINS, ENDS).translation_D.imag[:, :2]

        def across(parameters, track=track):
            return motion(model, np.append(parameters, track), 0.0, BEGINS, ENDS).translation.imag

        np.testing.assert_allclose(found, jacobian(across, at[:2], 1e-5), atol=1e-7)


def test_spans_with_unknown_or_missing_steps_are_not_covered():
    model = wheels(2.0)[0]
    model.unknown[40] = True  # from 0.80 to 0.82 s
    begins, ends = np.array([-0.1, 0.1, 0.1, 0.83, 1.5]), np.array([0.5, 0.79, 0.81, 1.9, 2.1])
    assert covered(model, begins, ends).tolist() == [False, True, False, True, False]


def test_sums_between_readings():
    model = wheels(2.0)[0]
    ones = np.ones((len(model.left), 1))
    np.testing.assert_allclose(
        sum_between(model, ones, BEGINS[:1], np.array([1.5])), (1.5 - 0.505) * 50.0
    )
