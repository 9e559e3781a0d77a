"""The covariances of poses at the stamps of sweeps, which are not those of their middles."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import motions_of, sweeps_of

from impslam.geometry.se2 import compose_uncertain, exp
from impslam.tracking.base import KeyframeGate
from impslam.tracking.odometry import OdometryTracker
from impslam.types import Increment

PERIOD, SHARE = 0.1, 0.4  # s between sweeps, and the share of it from a stamp to the middle
TWIST = np.array([0.04, 0.0, 0.05])
SPREAD = np.diag([4e-6, 2e-6, 1e-5])
STILL = np.zeros(3), np.zeros((3, 3))


def followed(sign):
    """Return the track of six sweeps whose stamps are before (-1) or after (1) their middles."""
    first = Increment(0.0, *STILL, 0.0)
    increments = [Increment(PERIOD * k, exp(TWIST), SPREAD, PERIOD) for k in range(1, 7)]
    scan = cast(room(-2.0, 3.5, -1.5, 2.2)).scan
    sweeps = sweeps_of([scan] * 7, PERIOD * np.arange(7))
    sweeps = replace(
        sweeps,
        middles=sweeps.middles - sign * SHARE * PERIOD,
        T_middle_stamp=np.tile(exp(sign * SHARE * TWIST), (7, 1)),
        stamp_covariance=np.tile(SHARE * SPREAD, (7, 1, 1)),
        scans=None,
    )
    tracker = OdometryTracker()
    tracker.start(np.zeros(3), KeyframeGate(distance=math.inf, angle=math.inf, seconds=math.inf))
    *_, track = tracker.follow(motions_of([first, *increments]), sweeps)
    return track


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_errors_of_odometry_up_to_a_stamp_count_once(sign):
    """A stamp before the middle is on the path to the middle, one after it is beyond."""
    track = followed(sign)
    assert len(track.stamps) == 6
    last = SHARE if sign > 0 else 1.0 - SHARE
    for k, (pose, covariance) in enumerate(
        zip(track.T_anchor_base, track.covariance, strict=True), start=1
    ):
        reached, spread = STILL
        for _ in range(k if sign > 0 else k - 1):
            reached, spread = compose_uncertain(reached, spread, exp(TWIST), SPREAD)
        reached, spread = compose_uncertain(reached, spread, exp(last * TWIST), last * SPREAD)
        np.testing.assert_allclose(pose, reached, atol=1e-12)
        np.testing.assert_allclose(covariance, spread, atol=1e-12)
