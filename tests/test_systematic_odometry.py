"""Systematic errors of odometry, from the config to the keyframes and poses."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from impslam.columns import batches
from impslam.config import load
from impslam.diagnosis.diagnose import find_log_fault
from impslam.health import NO_FAULT
from impslam.noise import MotionNoise
from impslam.observers.base import Observer
from impslam.odometry.encoders import Encoders
from impslam.open_log import open_log
from impslam.run import Run
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.tracking.base import Tracker
from impslam.types import Imu, TruePose

SECONDS = 12.0
BARE = [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "cylinders", "corners")]


class Parts(Observer):
    """Stores the systematic part of each keyframe's motion."""

    def __init__(self):
        self.parts = []

    def revise(self, keyframe, revision, path):
        self.parts.append(keyframe.motion.systematic)


class Keyframes(Observer):
    """Stores the keyframes."""

    def __init__(self):
        self.keyframes = []

    def revise(self, keyframe, revision, path):
        self.keyframes.append(keyframe)


@cache
def recording(with_gyro=False):
    robot = SimulatedRobot() if with_gyro else SimulatedRobot(imu=None)
    messages = list(simulate(load_world("arena"), robot, 0))
    return [m for m in messages if m.stamp - messages[0].stamp < SECONDS]


def played(messages, *settings):
    seen = Parts()
    run = Run(load("imp", settings), [seen])
    return run.play(messages).rows(), seen.parts


def test_noise_is_split_into_parts_with_the_same_sum_at_one_metre_and_one_radian():
    noise = MotionNoise(systematic=0.8)
    rest, errors = noise.split()
    for d_pose in ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]):
        distance, turn = d_pose[0], d_pose[2]
        total = rest.covariance(distance, turn)
        total[2, 2] += errors.turn_variances(np.array(d_pose))
        np.testing.assert_allclose(total, noise.covariance(distance, turn), atol=1e-12)
    at_once = errors.errors(np.array([0.0, 0.0, 1.0]))
    assert at_once[2] @ at_once[2] == pytest.approx(0.8 * noise.turn_per_turn**2)


def test_keyframes_carry_them_if_the_filter_can_consider_them_and_odometry_is_alone():
    assert all(part is not None for part in played(recording())[1])
    for settings in (
        ["filter.kind=ukf"],
        ["tracker.kind=scan_to_map"],
        ["estimator.kind=graph"],
        ["odometry.slip.systematic=0.0"],
    ):
        assert all(part is None for part in played(recording(), *settings)[1]), settings


def test_from_the_first_reading_of_a_gyro_on_they_include_its_own_whatever_the_batches():
    messages = recording(with_gyro=True)
    began = messages[0].stamp + 5.0
    late = [m for m in messages if not isinstance(m, Imu) or m.stamp > began]
    rows, parts = played(late)
    single = Run(load("imp"), [seen := Parts()])
    for batch in batches(((type(m).__name__, m) for m in late), 1):
        single.feed(batch)
    single.flush()
    for part, same in zip(parts, seen.parts, strict=True):
        np.testing.assert_array_equal(part.errors, same.errors)
        np.testing.assert_array_equal(part.correlation, same.correlation)
    assert parts[0].errors.shape[1] == 2
    assert parts[-1].learned.tolist() == [False, False, True, True]
    np.testing.assert_array_equal(rows.covariances, single.map().rows().covariances)


def test_motions_after_a_keyframe_are_corrected_by_what_was_learned_of_the_gyro(monkeypatch):
    """Landmarks cannot correct the headings of scans between keyframes, here a second apart."""
    messages = recording(with_gyro=True)
    true = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
    settings = (
        "keyframes.angle=1",
        "keyframes.distance=1",
        "keyframes.seconds=1",
        f"start={[0.0, 0.0, np.pi / 2]}",
    )
    errors, sigmas = {}, {}
    for learns in (True, False):
        if not learns:
            monkeypatch.setattr(Tracker, "learn", lambda *_: None)
        rows, _ = played(messages, *settings)
        late = rows.stamps > messages[0].stamp + 3.0
        headings = np.array([true[stamp][2] for stamp in rows.stamps[late].tolist()])
        errors[learns] = np.std(rows.poses[late, 2] - headings)
        sigmas[learns] = np.sqrt(rows.covariances[late, 2, 2].mean())
    assert errors[True] < 0.8 * errors[False]
    assert sigmas[True] < 0.9 * sigmas[False]


def test_dead_reckoning_is_as_uncertain_with_many_keyframes_as_with_few():
    """And less than with random errors alone: the drive turns by less than 1 rad at a time."""
    few, many, random = (
        played(recording(), *BARE, *settings)[0].covariances[-1]
        for settings in (
            ["keyframes.angle=0.2", "keyframes.distance=0.2"],
            ["keyframes.angle=0.02", "keyframes.distance=0.02"],
            ["odometry.slip.systematic=0.0"],
        )
    )
    np.testing.assert_allclose(few, many, rtol=0.02, atol=1e-3 * few.max())
    assert few[2, 2] < 0.7 * random[2, 2]


def test_the_total_noise_of_encoders_does_not_depend_on_the_share():
    parts = {"wheel_radius": 0.05, "track": 0.4}
    odometry = Encoders(**parts)
    rest, errors = odometry.split()
    assert errors is not None
    assert rest.split() == (rest, None)
    assert rest.slip.turn_per_turn**2 + errors.turn**2 == pytest.approx(
        odometry.slip.turn_per_turn**2
    )


def test_checks_of_a_log_take_all_errors_of_odometry():
    """Otherwise a track within its tolerance is reported as wrong: of clean drives, two of four were."""
    config = load("imp")
    for robot in (config.make_robot(), config.make_robot(for_estimator=True)):
        assert robot.odometry.slip == Encoders(wheel_radius=0.05, track=0.4).slip
    checked, estimated = (
        np.concatenate([m.covariance[:, 2, 2] for m, _ in sensed(robot) if len(m.stamps)])
        for robot in (config.make_robot(), config.make_robot(for_estimator=True))
    )
    assert estimated.sum() < 0.5 * checked.sum()


def sensed(robot):
    for batch in batches((type(m).__name__, m) for m in recording()):
        yield from robot.sense(batch)
    yield from robot.flush()


@pytest.mark.parametrize("seed", [2, 3])
def test_a_clean_drive_begins_sound(seed, tmp_path):
    log = tmp_path / "arena.mcap"
    with McapWriter(log) as writer:
        for message in simulate(load_world("arena"), SimulatedRobot(), seed):
            writer.write(message)
    assert find_log_fault(*open_log(log, "imp")) == NO_FAULT


@pytest.mark.parametrize("pause", [500.0, 1e5])
def test_the_bias_of_the_gyro_does_not_count_during_a_pause_of_the_log(pause):
    """The wheels turn on for 15 s. In 1e5 s, a clock was set: the gyro's time line has no gap there."""
    messages = list(simulate(load_world("arena"), SimulatedRobot(), 0))
    begin, end = messages[0].stamp + 30.0, messages[0].stamp + 45.0
    drive = [m for m in messages if m.stamp < begin]
    drive += [replace(m, stamp=m.stamp + pause) for m in messages if m.stamp >= end]
    seen = Keyframes()
    known = Run(load("imp"), [seen]).play(drive)
    across = next(keyframe.motion for keyframe in seen.keyframes if keyframe.stamp >= begin)
    assert 0.02 < np.sqrt(across.covariance[2, 2]) < 0.2  # the wheels' error of half a turn
    assert across.systematic is not None
    assert across.systematic.errors[:, 2:] == pytest.approx(0.0)
    assert sorted(mark.kind for mark in known.landmarks) == 4 * ["corner"] + 3 * [
        "cylinder"
    ] + 4 * ["wall"]
