"""Beams that hit the robot itself keep their range at every heading; a wall beside the robot does not."""

import numpy as np
import pytest

from impslam.diagnosis.beam_samples import BeamSamples
from impslam.diagnosis.beams import body_beams

ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)
BESIDE = np.abs(ANGLES - 0.5 * np.pi) < 0.1


def scans(headings, distance):
    """Return scans of a robot at these headings, beside a wall at a distance on its left, in open space."""
    ranges = distance / np.maximum(np.sin(ANGLES + np.asarray(headings)[:, None]), distance / 20.0)
    return BeamSamples(ranges, np.ones(ranges.shape, bool), ANGLES, np.asarray(headings))


ALONG, AROUND = np.zeros(140), np.linspace(0.0, 2.0 * np.pi, 20)


@pytest.mark.parametrize("headings", [ALONG, np.concatenate((ALONG, AROUND))])
def test_a_wall_beside_a_straight_drive_is_not_the_robot(headings):
    hits, farthest = body_beams(scans(headings, 0.7))
    assert not len(hits)
    assert farthest == 0.0


def test_beams_that_keep_their_range_at_every_heading_hit_the_robot():
    sample = scans(np.concatenate((ALONG, AROUND)), 0.7)
    sample.ranges[:, BESIDE] = 0.3
    hits, farthest = body_beams(sample)
    np.testing.assert_array_equal(hits, np.flatnonzero(BESIDE))
    assert farthest == 0.3
