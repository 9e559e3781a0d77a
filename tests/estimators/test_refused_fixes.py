"""A gate that refuses every fix opens again where these agree, and stays shut against outliers."""

import math

import numpy as np
from tests.sensors.test_gps import SETTINGS, T_MAP_EAST, drive, errors
from tests.steps import Steps

from impslam.config import load
from impslam.estimators.refused_fixes import MIN_FIXES, MIN_SPAN, RefusedFixes
from impslam.geometry.se2 import compose, inverse, transform
from impslam.run import Run
from impslam.types import Fix, Landmark, Observation

FRAME = np.array([3.0, -2.0, 0.4])


def frame(observations=20):
    parameters = {"yaw": float(FRAME[2])}
    return Landmark(0, "gps", FRAME[:2], parameters, np.eye(2), None, observations, 0.0, 1.0)


def refuse(pose_error, way=20.0, rng=None, sigma=0.5, scatter=None, count=30, marks=20):
    """Return what is found of fixes along a way that the filter has at another place."""
    refused = RefusedFixes()
    rng = rng or np.random.default_rng(1)
    for k in range(count):
        true = np.array([way * k / (count - 1), 1.0, 0.0])
        z = transform(inverse(FRAME), true[None, :2])[0]
        z = z + (sigma if scatter is None else scatter) * rng.standard_normal(2)
        fix = Observation("gps", z, sigma**2 * np.eye(2))
        found = refused.refuse(compose(pose_error, true)[:2], fix, frame(marks))
        if found is not None:
            return found
    return None


def test_the_error_of_a_wrong_pose_is_estimated():
    off = np.array([12.0, -9.0, 0.2])
    found = refuse(off)
    assert found is not None
    assert not found.frame_is_wrong
    assert math.sqrt(found.covariance[2, 2]) == np.clip(math.sqrt(found.covariance[2, 2]), 0.1, 0.3)
    assert 12.0 < math.sqrt(found.covariance[0, 0]) < 20.0  # 15 m, and the turn about the origin


def test_fixes_that_scatter_more_than_their_noise_do_not_agree():
    assert refuse(np.array([12.0, -9.0, 0.2]), scatter=5.0) is None


def test_few_fixes_over_a_short_distance_are_not_enough():
    assert refuse(np.array([12.0, -9.0, 0.0]), way=0.5 * MIN_SPAN * 0.5) is None
    assert refuse(np.array([12.0, -9.0, 0.0]), count=MIN_FIXES - 1) is None


def test_a_stationary_robot_stores_one_refused_fix():
    refused, fix = RefusedFixes(), Observation("gps", np.array([9.0, 4.0]), np.eye(2))
    for step in np.linspace(0.0, 0.05, 100):
        assert refused.refuse(np.array([1.0 + step, 2.0]), fix, frame()) is None
    assert len(refused) == 1


def test_an_unconfirmed_frame_is_removed():
    assert refuse(np.array([12.0, -9.0, 0.2]), marks=1).frame_is_wrong


def carried(messages, truth, at=120.0, way=(20.0, -15.0)):
    """Return a drive in which the robot is carried elsewhere, which its wheels do not feel."""
    moved, truth = [], truth.copy()
    truth[truth[:, 0] >= at, 1:3] += way
    for m in messages:
        if isinstance(m, Fix) and m.stamp >= at:
            place = transform(T_MAP_EAST, m.position[None])[0] + way
            z = transform(inverse(T_MAP_EAST), place[None])[0]
            moved.append(Fix(m.stamp, z, m.covariance))
        else:
            moved.append(m)
    return moved, truth


def test_a_path_whose_fixes_are_refused_recovers(rng):
    messages, truth = carried(*drive(rng))
    run = Run(load("default", SETTINGS))
    known = run.play(messages)
    (found,) = (mark for mark in known.landmarks if mark.kind == "gps")
    T_map_east = np.array([*found.position, found.parameters["yaw"]])
    off = errors(known.rows(), truth, T_map_east)
    stamps = known.rows().stamps
    assert off[(stamps > 121.0) & (stamps < 124.0)].min() > 15.0  # the gate refuses the fixes
    assert np.median(off[stamps > 150.0]) < 1.5
    assert off[stamps > 150.0].max() < 5.0
    assert run.estimator.counts() == {"pose covariances widened by refused GPS fixes": 1}


def test_a_wrong_first_fix_does_not_exclude_all_others(rng):
    messages, truth = drive(rng)
    bad = [
        Fix(m.stamp, m.position + np.array([400.0, 0.0]), m.covariance)
        if isinstance(m, Fix) and m.stamp < 10.0
        else m
        for m in messages
    ]
    run = Run(load("default", SETTINGS))
    known = run.play(bad)
    (found,) = (mark for mark in known.landmarks if mark.kind == "gps")
    off = errors(known.rows(), truth, np.array([*found.position, found.parameters["yaw"]]))
    assert np.median(off[known.rows().stamps > 120.0]) < 2.0
    assert run.estimator.counts()


def test_a_revision_names_the_frame_that_is_removed(rng):
    """The frame of one wrong fix, the first that has a course."""
    messages = [
        Fix(m.stamp, m.position + 400.0, m.covariance)
        if isinstance(m, Fix) and 3.0 < m.stamp < 4.0
        else m
        for m in drive(rng)[0]
        if m.stamp < 20.0
    ]
    steps = Steps()
    (found,) = Run(load("default", SETTINGS), [steps]).play(messages).landmarks
    first, second = (number for step in steps.results for number in step.added)
    assert [step.removed for step in steps.results if step.removed] == [(first,)]
    assert found.id == second
