"""The textbook EKF: iterations."""

import numpy as np
from tests.filters.worlds import MODELS, drive, observe, step
from tests.numeric import wrapped

from impslam.filters.ekf import Ekf
from impslam.landmarks.gps import GpsFrame
from impslam.landmarks.point import Cylinder
from impslam.types import Increment, Observation


def test_a_large_slip_vanishes_in_one_iterated_scan():
    """A slip of 0.2 m and 5 degrees that the covariance allows for; one linearisation leaves 1 cm."""
    belief = Ekf(iterations=5)
    belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    steps = list(drive(30))
    for pose, increment in steps:
        step(belief, increment, observe(pose))
    slip = Increment(31.0, np.array([0.2, -0.1, 0.09]), np.diag([0.3, 0.3, 0.2]) ** 2, 1.0)
    step(belief, slip, observe(pose))
    assert np.abs(wrapped(belief.pose - pose, 2)).max() < 0.001


def test_the_frame_of_a_gps_is_no_object_that_beams_could_hit():
    belief = Ekf()
    belief.start(np.zeros(3), 1e-8 * np.eye(3), {"gps": GpsFrame(), "cylinder": Cylinder()})
    seen = [Observation(kind, np.array([2.0, 1.0]), np.eye(2)) for kind in ("gps", "cylinder")]
    _, pillar = belief.extend(seen, 0.0)
    assert belief.outlines()[0].tolist() == [pillar]


def test_beliefs_on_either_side_of_plus_and_minus_pi_resemble_each_other():
    """A wall behind the robot, whose normal is there in map."""
    beliefs = []
    for alpha in (np.pi - 1e-6, -np.pi + 1e-6):
        belief = Ekf()
        belief.start(np.zeros(3), 1e-4 * np.eye(3), MODELS)
        ends = np.array([[-2.0, -1.0], [-2.0, 1.0]])
        seen = Observation("wall", np.array([2.0, alpha]), 1e-3 * np.eye(2), end_points=ends)
        belief.extend((seen,), 0.0)
        beliefs.append(belief)
    assert beliefs[0].resembles(beliefs[1], 0.2)
