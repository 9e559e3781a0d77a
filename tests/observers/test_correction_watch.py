"""Corrections of odometry by landmarks: white if the filter is consistent, else to one side."""

from types import SimpleNamespace

import numpy as np
import pytest

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose, compose_uncertain
from impslam.observers.correction_watch import CorrectionWatch

Q = np.diag([3e-3, 2e-3, 4e-3]) ** 2
STEP = np.array([0.12, 0.0, 0.02])
R = np.diag([4e-3, 4e-3, 3e-3]) ** 2


def drive(seed=0, n=2000, bias=(1.0, 0.0, 0.0), start=(0.0, 0.0, 0.0), informed=True):
    """Return the results of a Kalman filter that measures its pose, with `bias` as factor and offsets.

    The motion by odometry is the true one times the first bias, plus the others.
    """
    rng, watch, out = np.random.default_rng(seed), CorrectionWatch(), []
    truth = pose = np.array(start)
    P = np.eye(3) * 1e-8
    for _ in range(n):
        truth = compose(truth, STEP)
        odometry = STEP * [bias[0], 1.0, 1.0] + [0.0, *bias[1:]]
        odometry = odometry + rng.multivariate_normal(np.zeros(3), Q)
        motion = SimpleNamespace(d_pose=odometry, covariance=Q)
        pose, P = compose_uncertain(pose, P, odometry, Q)
        if informed:
            K = P @ np.linalg.inv(P + R)
            z = truth + rng.multivariate_normal(np.zeros(3), R)
            difference = z - pose
            difference[2] = wrap(difference[2])
            pose, P = pose + K @ difference, (np.eye(3) - K) @ P
        keyframe = SimpleNamespace(motion=motion, lost=False)
        revision = SimpleNamespace(matches=[1], ids=[0], poses=pose[None], covariances=P[None])
        out.append(watch.revise(keyframe, revision))
    return np.array(out)


@pytest.mark.parametrize("seed", range(5))
def test_white_corrections_have_no_bias(seed):
    assert not drive(seed).any()


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (3.0, -2.0, 2.0)])
@pytest.mark.parametrize(
    "bias", [(1.2, 0.0, 0.0), (0.8, 0.0, 0.0), (1.0, 0.02, 0.0), (1.0, 0.0, 0.02)]
)
def test_a_bias_is_found_within_two_metres(bias, start):
    found = drive(n=40, bias=bias, start=start)
    assert np.argmax(found) <= 16
    assert found[16:].all()


def test_without_corrections_there_is_no_bias():
    assert not drive(n=100, bias=(1.2, 0.0, 0.0), informed=False).any()


def test_a_single_wrong_match_does_not_decide():
    watch, pose, P = CorrectionWatch(), np.zeros(3), np.eye(3) * 1e-4
    for k in range(40):
        jump = 1.0 if k == 20 else 0.0
        pose = compose(pose, STEP) + np.array([jump, 0.0, 0.0])
        motion = SimpleNamespace(d_pose=STEP, covariance=Q)
        keyframe = SimpleNamespace(motion=motion, lost=False)
        revision = SimpleNamespace(matches=[1], ids=[0], poses=pose[None], covariances=P[None])
        assert not watch.revise(keyframe, revision)
