"""Latitude and longitude correct the pose as fixes in metres do."""

import math

import numpy as np
import pytest
from tests.sensors.test_gps import SETTINGS, drive, errors

from impslam.columns import single_row
from impslam.config import load
from impslam.errors import ShapeError
from impslam.geometry.geodesy import LocalPlane
from impslam.geometry.se2 import compose
from impslam.run import Run
from impslam.sensors.gps import NavSat
from impslam.types import Fix, SatelliteFix

PLANE = LocalPlane(-33.9, 151.2, 60.0)
NAVSAT = tuple(s.replace('kind="gps"', 'kind="navsat"') for s in SETTINGS)
UNKNOWN = np.full((3, 3), math.nan)


def on_earth(message, covariance=UNKNOWN, status=0):
    lat, lon, height = PLANE.geodetic(np.array([*message.position, 0.0]))
    return SatelliteFix(message.stamp, lat, lon, height, covariance, status)


def test_the_path_is_as_good_as_by_fixes_in_metres(rng):
    messages, truth = drive(rng)
    told = [on_earth(m) if isinstance(m, Fix) else m for m in messages]
    known = Run(load("default", NAVSAT)).play(told)
    (frame,) = (mark for mark in known.landmarks if mark.kind == "gps")
    first = next(m for m in messages if isinstance(m, Fix)).position  # the origin of its plane
    found = np.array([*frame.position, frame.parameters["yaw"]])
    off = errors(known.rows(), truth, compose(found, np.array([*-first, 0.0])))
    assert np.median(off) < 1.5
    assert off[-1] < 1.5
    assert frame.observations > 180


def test_without_a_fix_it_reports_a_problem_and_continues(rng):
    messages, truth = drive(rng)
    told = [
        (
            SatelliteFix(m.stamp, math.nan, math.nan, math.nan, UNKNOWN, -1)
            if 60.0 < m.stamp < 100.0
            else on_earth(m)
        )
        if isinstance(m, Fix)
        else m
        for m in messages
    ]
    # One that claims a place all the same is not believed.
    told.insert(50, SatelliteFix(told[50].stamp, 0.0, 0.0, 0.0, UNKNOWN, -1))
    run = Run(load("default", NAVSAT))
    known = run.play(told)
    assert "no fix" in run.robot.problems.examples["fix"]
    (frame,) = (mark for mark in known.landmarks if mark.kind == "gps")
    assert frame.observations > 140
    assert len(truth)


def test_its_covariance_counts_and_is_never_below_sigma():
    sensor = NavSat(sigma=1.5)
    rows = [
        (0.0, 0.0, UNKNOWN),
        (1.0, 40.0, np.diag([9.0, 16.0, 4.0])),
        (2.0, 80.0, 1e-4 * np.eye(3)),
    ]
    found = []
    for k, (stamp, north, covariance) in enumerate(rows):
        lat, lon, height = PLANE.geodetic(np.array([0.0, north, 0.0]))
        fix = SatelliteFix(stamp, lat, lon, height, covariance)
        (columns,) = single_row("/fix", fix, k).values()
        sensor.spans(columns)
        found += sensor.observe(_Row(columns), 0, np.random.default_rng(0))
    np.testing.assert_allclose(found[0].R, np.diag([9.0, 16.0]))
    np.testing.assert_allclose(found[1].R, 1.5**2 * np.eye(2))
    np.testing.assert_allclose(found[0].z, [0.0, 40.0], atol=1e-6)


class _Row:
    def __init__(self, columns):
        self.columns = columns


def test_a_covariance_of_another_shape_is_refused():
    with pytest.raises(ShapeError):
        SatelliteFix(0.0, 1.0, 2.0, 3.0, np.eye(2))
