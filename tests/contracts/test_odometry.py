"""What every odometry keeps: motions that compose, for any cutting, and a fresh start after bad rows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.numeric import wrapped
from tests.odometry_steps import StepwiseOdometry, stacked
from tests.sensing import at_rest, joined

from impslam.component import components
from impslam.errors import MessageError
from impslam.geometry.se2 import compose, exp
from impslam.odometry.stream import OdometryStream
from impslam.types import OdometryPose, Steering, Velocity, WheelAngles

NEEDED = {
    "ackermann": {"wheelbase": 0.5, "encoder_offset": 0.3, "axle": (0.2, 0.1)},
    "encoders": {"wheel_radius": 0.05, "track": 0.3},
}
STRAIGHT = {"ackermann": {"axle": (0.0, 0.0)}}
"""base_link goes on an arc, where it is not off the axle."""
TWIST = np.array([0.4, 0.0, 0.7])
PLACES = (WheelAngles, OdometryPose)
"""Readings of where something is: a wrong one spoils the motion before it and after it."""


def reading(consumes, stamp, spoil=None):
    """Return the message of a robot that has gone at TWIST since 0 s."""
    if consumes is WheelAngles:
        v, w = TWIST[0], TWIST[2]
        left, right = ((v + side * w * 0.15) * stamp / 0.05 for side in (-1, 1))
        return WheelAngles(stamp, left if spoil is None else spoil, right)
    if consumes is Steering:
        speed, curvature = TWIST[0], TWIST[2] / TWIST[0]
        wheel = speed * (1.0 - 0.3 * curvature)
        return Steering(stamp, wheel if spoil is None else spoil, math.atan(0.5 * curvature))
    if consumes is Velocity:
        return Velocity(stamp, float(TWIST[0]) if spoil is None else spoil, float(TWIST[2]))
    pose = exp(TWIST * stamp)
    return OdometryPose(stamp, pose if spoil is None else np.array([spoil, *pose[1:]]))


MEASURING = sorted(name for name, kind in components("odometry").items() if kind.measures_motion)


@pytest.fixture(params=MEASURING)
def make(request):
    """Return what makes an odometry, with parameters of its own."""
    name = request.param
    return lambda **more: components("odometry")[name](**{**NEEDED.get(name, {}), **more})


@pytest.fixture
def odometry(make):
    """An odometry whose base_link goes on an arc."""
    plain = make()
    return make(**STRAIGHT.get(plain.name, {}))


def test_readings_give_one_motion_less(odometry):
    stamps = np.array([1.0, 1.1, 1.3, 1.35])
    readings = stacked(reading(odometry.consumes, t) for t in stamps.tolist())
    motions = odometry.motions(readings)
    np.testing.assert_allclose(motions.stamps, stamps[1:])
    np.testing.assert_allclose(motions.duration, np.diff(stamps))
    np.testing.assert_allclose(motions.d_pose, exp(np.diff(stamps)[:, None] * TWIST), atol=1e-12)
    assert motions.covariance.shape == (3, 3, 3)
    assert len(odometry.motions(readings.take(slice(1))).stamps) == 0


def test_the_first_message_gives_no_motion(odometry):
    assert StepwiseOdometry(odometry).update(reading(odometry.consumes, 1.0)) is None


def test_motions_compose_to_the_motion(odometry):
    stamps = np.cumsum(np.random.default_rng(2).uniform(0.005, 0.1, 40))
    motions = odometry.motions(stacked(reading(odometry.consumes, t) for t in stamps.tolist()))
    assert (motions.duration > 0.0).all()
    assert (np.linalg.eigvalsh(motions.covariance)[:, 0] >= -1e-18).all()
    np.testing.assert_allclose(
        motions.covariance, motions.covariance.swapaxes(1, 2), rtol=1e-12, atol=1e-20
    )
    moved = exp(TWIST * stamps[0])
    for d_pose in motions.d_pose:
        moved = compose(moved, d_pose)
    np.testing.assert_allclose(wrapped(moved - exp(TWIST * stamps[-1]), 2), 0.0, atol=1e-12)
    assert motions.duration.sum() == pytest.approx(stamps[-1] - stamps[0])


def test_uncertainty_does_not_depend_on_the_rate(odometry):
    """Ten small increments are as sure as one large one, to first order in the turn."""
    found = []
    for steps in (1, 10):
        stamps = np.linspace(0.0, 0.05, steps + 1)
        motions = odometry.motions(stacked(reading(odometry.consumes, t) for t in stamps.tolist()))
        total = at_rest(0.0)
        for k in range(steps):
            total = joined(total, motions.row(k))
        found.append(np.diag(total.covariance))
    np.testing.assert_allclose(found[1], found[0], rtol=0.02, atol=1e-9)


def test_no_motion_has_no_uncertainty(odometry):
    motions = odometry.motions(stacked([reading(odometry.consumes, 1.0)] * 2))
    np.testing.assert_allclose(motions.d_pose, np.zeros((1, 3)), atol=1e-15)
    assert np.abs(motions.covariance).max() < 1e-12


def test_a_stamp_that_runs_backwards_takes_no_time(odometry):
    motions = odometry.motions(stacked(reading(odometry.consumes, t) for t in (1.0, 0.99)))
    assert motions.duration.tolist() == [0.0]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e6])
def test_a_bad_message_is_refused_in_one_line(odometry, bad):
    consumes, felt = odometry.consumes, StepwiseOdometry(odometry)
    felt.update(reading(consumes, 1.0))
    with pytest.raises(MessageError) as error:
        felt.update(reading(consumes, 1.1, bad))
    assert "\n" not in str(error.value)
    if bad == 1e6 and consumes in PLACES:  # a jump there and back
        with pytest.raises(MessageError):
            felt.update(reading(consumes, 1.2))
    else:
        felt.update(reading(consumes, 1.2))
    after = felt.update(reading(consumes, 1.3))
    np.testing.assert_allclose(after.d_pose, exp(TWIST * 0.1), atol=1e-9)


def spoilt(consumes, seed=4, n=120):
    """Return messages of which some are bad, some run back, and with a silence of 5 s."""
    rng = np.random.default_rng(seed)
    stamps = 10.0 + np.cumsum(rng.uniform(0.005, 0.05, n))
    stamps[n // 2 :] += 5.0
    bad = np.where(rng.random(n) < 0.15, rng.choice([np.nan, np.inf, 1e6, -1e300], n), 0.0)
    messages = [reading(consumes, t, b or None) for t, b in zip(stamps, bad.tolist(), strict=True)]
    return [replace(m, stamp=m.stamp - 0.04 * (rng.random() < 0.1)) for m in messages]


@pytest.mark.parametrize("first_bad", [False, True])
def test_any_cutting_gives_the_same_bytes(make, first_bad):
    odometry = make()
    rows = stacked(
        [*([reading(odometry.consumes, 9.0, np.nan)] * first_bad), *spoilt(odometry.consumes)]
    )
    found = []
    for cut in (1, 2, 7, len(rows)):
        stream = OdometryStream(odometry)
        parts = [stream.motions(rows.take(slice(k, k + cut))) for k in range(0, len(rows), cut)]
        found.append((
            *(np.concatenate(column) for column in zip(*(p.motions for p in parts), strict=True)),
            np.concatenate([p.faults for p in parts]),
            next(p.example for p in parts if p.example),
        ))  # fmt: skip
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    *_, faults, _ = found[0]
    assert 10 < faults.sum() < 60


def test_bad_rows_do_not_touch_the_others(odometry):
    """Motions between good neighbours are to the byte those of a log without the bad ones."""
    messages = [reading(odometry.consumes, 1.0 + 0.05 * k) for k in range(40)]
    rows = stacked(messages)
    whole = OdometryStream(odometry).motions(rows)
    assert not whole.faults.any()
    messages[13] = reading(odometry.consumes, 1.65, np.nan)
    found = OdometryStream(odometry).motions(stacked(messages))
    assert np.flatnonzero(found.faults).tolist() == [13]
    alike = np.ones(40, np.bool_)
    alike[[0, 13, 14]] = False
    np.testing.assert_array_equal(found.motions.d_pose[alike], whole.motions.d_pose[alike])
    np.testing.assert_array_equal(found.motions.covariance[alike], whole.motions.covariance[alike])
    across = found.motions.d_pose[14]
    if odometry.holds:
        assert np.isnan(across).all()
    else:
        np.testing.assert_allclose(across, exp(0.1 * TWIST), atol=1e-12)
