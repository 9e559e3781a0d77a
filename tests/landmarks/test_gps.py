"""The frame of a GPS: its yaw is an angle."""

import math

import numpy as np

from impslam.landmarks.gps import GpsFrame


def test_a_corrected_yaw_stays_between_plus_and_minus_pi():
    frames = np.array([[1.0, 2.0, 3.1], [1.0, 2.0, -3.1]])
    moved = GpsFrame().retract(frames, np.array([[0.5, 0.0, 0.1], [0.5, 0.0, -0.1]]))
    turn = 3.2 - 2.0 * math.pi
    np.testing.assert_allclose(moved, [[1.5, 2.0, turn], [1.5, 2.0, -turn]], atol=1e-12)
