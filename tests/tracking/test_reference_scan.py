"""Which beams of a reference scan a motion changes."""

import math

import numpy as np
import pytest

from impslam.tracking.beams import Geometry
from impslam.tracking.reference_scan import beam_towards, changed_beam, ranges_at_once

ANGLES = np.linspace(-1.0, 1.0, 201)
WALL = 3.0 / np.cos(ANGLES)  # a wall across the path, 3 m ahead
POINTS = WALL[:, None] * np.column_stack((np.cos(ANGLES), np.sin(ANGLES)))
GEOMETRY = Geometry(np.zeros(3), -1.0, 0.01)


@pytest.mark.parametrize(("ahead", "changes"), [(0.0, False), (0.05, False), (0.2, True)])
def test_a_motion_towards_a_wall_changes_its_beams(ahead, changes):
    k, predicted = changed_beam(100, np.array([ahead, 0.0, 0.0]), POINTS, WALL, GEOMETRY)
    assert k == (100 if changes else -1)
    assert predicted == pytest.approx(3.0 - ahead)


def test_a_point_is_seen_by_the_beam_in_its_direction_after_the_motion():
    motion = np.array([0.5, 0.3, 0.2])
    k, predicted = changed_beam(120, motion, POINTS, WALL, GEOMETRY)
    x, y = POINTS[120] - motion[:2]
    assert k == round((np.arctan2(y, x) - 0.2 + 1.0) / 0.01)
    assert predicted == pytest.approx(np.hypot(x, y))


@pytest.mark.parametrize("spacing", [1.0, -1.0])
@pytest.mark.parametrize(
    ("first", "beams", "off", "nearest"),
    [
        (-135, 271, -0.3, 0),
        (-135, 271, 270.3, 270),
        (-135, 271, -0.7, -1),
        (0, 360, -0.3, 0),
        (0, 360, 359.6, 0),
    ],
)
def test_the_beam_towards_a_direction_is_the_nearest_one(spacing, first, beams, off, nearest):
    geometry = Geometry(np.zeros(3), math.radians(first), math.radians(spacing))
    direction = geometry.first + math.radians(off * spacing)
    for turns in (-1, 0, 1):
        assert beam_towards(direction + turns * math.tau, beams, geometry) == nearest


def test_an_invalid_point_changes_nothing():
    ranges = np.where(np.arange(201) == 100, 0.0, WALL)
    assert changed_beam(100, np.array([0.5, 0.0, 0.0]), POINTS, ranges, GEOMETRY)[0] == -1


@pytest.mark.parametrize("beams", [1, 4])
def test_beams_in_one_direction_never_change(beams):
    """A sonar has one beam; a driver that knows no angles gives all beams the same one."""
    points, ranges = np.tile([3.0, 0.0], (beams, 1)), np.full(beams, 3.0)
    same = Geometry(np.zeros(3), 0.0, 0.0)
    assert changed_beam(0, np.array([0.5, 0.0, 0.0]), points, ranges, same)[0] == -1


@pytest.mark.parametrize("rate", [0.0, 2.5, -2.5])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_sweep_of_a_turn_is_as_if_taken_at_once(rate, sign):
    """Ranges are a function of the direction; a sweep of 0.2 s is off by 14 deg at either end."""
    nominal = sign * np.radians(np.arange(-120.0, 120.5, 0.5))
    geometry = Geometry(
        np.array([0.1, 0.0, 0.4]), float(nominal[0]), float(nominal[1] - nominal[0])
    )
    directions = nominal + 0.4 + rate * np.linspace(-0.1, 0.1, len(nominal))
    seen = ranges_at_once(3.0 + np.sin(directions), directions, geometry)
    expected = 3.0 + np.sin(nominal + 0.4)
    covered = seen > 0.0
    assert covered.mean() > 0.85
    np.testing.assert_allclose(seen[covered], expected[covered], atol=0.025)
    if rate == 0.0:
        np.testing.assert_array_equal(seen, expected)
