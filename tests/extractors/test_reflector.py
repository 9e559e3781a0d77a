"""Beacons by the brightness of their echoes: position, covariance, and rejections."""

import math

import numpy as np
import pytest

from impslam.extractors.reflector import Reflector
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import LaserScan

RNG, STILL = np.random.default_rng(0), np.zeros(3)
ANGLES = np.radians(np.arange(-90.0, 90.25, 0.5))
STEP = math.radians(0.5)
BRIGHT = 8192.0


def scan(ranges, bright, lidar=None, angles=ANGLES, brightness=BRIGHT):
    """Return a scan in which some beams (by index) come back bright."""
    echoes = np.zeros(len(angles))
    echoes[list(bright)] = brightness
    ranges = np.broadcast_to(np.asarray(ranges, float), angles.shape)
    message = LaserScan(
        0.0, angles, ranges.copy(), np.zeros(len(angles)), range_max=80.0, intensities=echoes
    )
    return (lidar or Lidar2D(sigma=0.02)).scan(message, STILL)


def find(ready, **parameters):
    return Reflector(**parameters).extract(ready, RNG)


def test_a_beacon_is_in_the_middle_of_its_beams():
    (seen,) = find(scan(5.0, [199, 200, 201]))
    angle = ANGLES[200]
    np.testing.assert_allclose(seen.z, 5.0 * np.array([math.cos(angle), math.sin(angle)]))
    assert seen.kind == "point"
    np.testing.assert_array_equal(seen.beams, [199, 200, 201])


def test_a_mounted_lidar_sees_it_from_base_link():
    (seen,) = find(scan(5.0, [180], Lidar2D(mount=(1.0, 2.0, math.pi / 2))))
    np.testing.assert_allclose(seen.z, [1.0, 7.0], atol=1e-12)


def test_a_post_has_its_axis_behind_its_surface():
    (seen,) = find(scan(5.0, [180]), radius=0.1)
    np.testing.assert_allclose(seen.z, [5.1, 0.0], atol=1e-12)


def test_two_beacons_side_by_side_and_one_behind_the_other_are_two():
    assert len(find(scan(5.0, [100, 101, 130, 131]))) == 2
    ranges = np.full(len(ANGLES), 5.0)
    ranges[101] = 8.0
    assert len(find(scan(ranges, [100, 101]))) == 2


def test_a_beam_lost_on_a_reflector_does_not_cut_it():
    assert len(find(scan(5.0, [100, 102]))) == 1


def test_a_beacon_across_the_ends_of_a_full_turn_is_one():
    angles = np.radians(np.arange(0.0, 360.0))
    beside, ahead = find(scan(5.0, [0, 1, 90, 358, 359], angles=angles))
    assert ahead.beams.tolist() == [358, 359, 0, 1]
    middle = math.radians(-0.5)
    np.testing.assert_allclose(ahead.z, 5.0 * np.array([math.cos(middle), math.sin(middle)]))
    assert beside.beams.tolist() == [90]


def test_bright_walls_are_no_beacons():
    assert find(scan(5.0, range(100, 130))) == []  # 1.3 m
    assert len(find(scan(5.0, range(100, 130)), max_size=2.0)) == 1


def test_faint_echoes_and_few_beams_are_left_out():
    assert find(scan(5.0, [100], brightness=0.5)) == []
    assert find(scan(5.0, [100]), threshold=BRIGHT + 1.0) == []
    assert find(scan(5.0, [100, 101, 140]), min_beams=2)[0].beams.tolist() == [100, 101]


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, 81.91])
def test_bright_beams_without_a_range_are_left_out(bad):
    ranges = np.full(len(ANGLES), 5.0)
    ranges[100] = bad
    (seen,) = find(scan(ranges, [100, 150]))
    assert seen.beams.tolist() == [150]


def test_brightness_that_is_no_number_is_not_bright():
    assert find(scan(5.0, [100], brightness=np.nan)) == []


def test_lidars_without_brightness_find_none():
    message = LaserScan(0.0, ANGLES, np.full(len(ANGLES), 5.0), np.zeros(len(ANGLES)))
    assert find(Lidar2D().scan(message, STILL)) == []


def test_directions_across_pi_are_averaged_the_short_way():
    lidar = Lidar2D(mount=(0.0, 0.0, math.pi))
    (seen,) = find(scan(5.0, [179, 180, 181], lidar))
    np.testing.assert_allclose(seen.z, [-5.0, 0.0], atol=1e-12)


def test_covariance_is_that_of_many_beacons(rng):
    """Flat reflectors 30 cm wide anywhere among the beams, ranges with noise: NEES is 2."""
    half, d2 = 0.15, []
    for _ in range(1500):
        distance, bearing = rng.uniform(3.0, 12.0), rng.uniform(-1.0, 1.0)
        hit = np.flatnonzero(np.abs(ANGLES - bearing) * distance <= half)
        ranges = distance + 0.02 * rng.standard_normal(len(ANGLES))
        (seen,) = find(scan(ranges, hit), sigma_surface=0.0)
        error = seen.z - distance * np.array([math.cos(bearing), math.sin(bearing)])
        d2.append(error @ np.linalg.solve(seen.R, error))
    # Each of two ends is uniform within a spacing; their mean is surer than R's one spacing.
    assert 1.3 < np.mean(d2) < 2.2


def test_a_lone_beams_covariance_is_that_of_its_spacing(rng):
    """A narrow reflector is met by one beam or none: its direction is uniform about that beam."""
    d2, middle = [], ANGLES[180]
    for _ in range(1500):
        bearing = middle + rng.uniform(-0.5, 0.5) * STEP
        ranges = 6.0 + 0.02 * rng.standard_normal(len(ANGLES))
        (seen,) = find(scan(ranges, [180]), sigma_surface=0.0)
        error = seen.z - 6.0 * np.array([math.cos(bearing), math.sin(bearing)])
        d2.append(error @ np.linalg.solve(seen.R, error))
    assert np.mean(d2) == pytest.approx(2.0, abs=0.2)


def test_uncertainty_of_the_surface_widens_both_axes():
    (seen,) = find(scan(6.0, [180], Lidar2D(sigma=0.01, bias=0.03)), sigma_surface=0.05)
    across = 36.0 * STEP**2 / 12.0 + 0.05**2
    expected = np.diag([0.01**2 + 0.03**2 + 0.05**2, across])
    np.testing.assert_allclose(seen.R, expected, atol=1e-9)
