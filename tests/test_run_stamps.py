"""Logs whose stamps are no times: the order of the rows decides, and the map is as good as usual."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from tests.recorded import Played
from tests.steps import Steps
from tests.test_bad_input import hall, recorded

from impslam.cli.inspect_survey import Survey
from impslam.columns import batches
from impslam.config import load
from impslam.diagnosis.diagnose import diagnose
from impslam.geometry.se2 import between
from impslam.run import map_log
from impslam.sources.base import recognise
from impslam.types import LaserScan, OdometryPose, TruePose, WheelAngles

SETTINGS = ["tracker.kind=scan_to_map", "estimator.kind=graph"]
SETTINGS += [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "corners")]
ACCURACY = 0.04
"""m, rms: the first wrong stamps are believed, so that a few scans get the motion of their neighbours."""
MAX_WRONG = 24
"""Scans that get the motion of their neighbours: until a stamp was repeated ten times."""
EPOCH = 1000.0


def zero(stamp, k):
    return 0.0


def far(stamp, k):
    return 1e12


def far_at_times(stamp, k):
    return 1e12 if k % 7 == 3 else stamp


def coarse(stamp, k):
    return 5.0 * math.floor(stamp / 5.0)


def equal(stamp, k):
    return 1.01893e9


def forth_and_back(stamp, k):
    return stamp + (-40.0, 7.0, 300.0, 0.0, -2.5)[k * k % 5]


def random(stamp, k):
    return float(np.random.default_rng(k).uniform(-1e4, 1e9))


BROKEN = {
    function.__name__: function
    for function in (zero, far, far_at_times, coarse, equal, forth_and_back, random)
}
STREAMS = {"scans": (LaserScan,), "odometry": (WheelAngles,), "both": (LaserScan, WheelAngles)}


def spoilt(messages, change, kinds):
    """Return the messages with other stamps, in the same order."""
    return [
        replace(m, stamp=change(m.stamp, k)) if isinstance(m, kinds) else m
        for k, m in enumerate(messages)
    ]


@pytest.fixture(scope="module")
def drive():
    """Return a lap of a hall, without the truth, and the true poses at its scans."""
    messages = [replace(m, stamp=m.stamp + EPOCH) for m in recorded(hall(), beam_time=0.0)]
    true = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
    sound = [m for m in messages if not isinstance(m, TruePose)]
    truth = np.array([true[m.stamp] for m in sound if isinstance(m, LaserScan)])
    return sound, between(truth[0], truth)


class Mapped(Steps):
    """The path of a run against the truth."""

    def errors(self, truth):
        """Return (n,) m."""
        rows = self.known.rows()
        return np.hypot(*between(truth, between(rows.poses[0], rows.poses))[:, :2].T)

    @property
    def odometry(self):
        """(n, 3) dead-reckoned poses."""
        return np.array([step.odometry for step in self.results])


def mapped(source):
    kept = Mapped()
    map_log(load("imp", SETTINGS), source, [kept])
    return kept


@pytest.fixture(scope="module")
def sound(drive, tmp_path_factory):
    return mapped(Played.of(drive[0], tmp_path_factory.mktemp("sound")))


@pytest.fixture(scope="module")
def run(drive, tmp_path_factory):
    """Return a function that maps the drive with broken stamps of some streams, once each."""

    @functools.cache
    def of(how, who):
        messages = spoilt(drive[0], BROKEN[how], STREAMS[who])
        return mapped(Played.of(messages, tmp_path_factory.mktemp("broken")))

    return of


@pytest.mark.parametrize("who", STREAMS)
@pytest.mark.parametrize("how", BROKEN)
def test_broken_stamps_cost_no_accuracy(drive, sound, run, how, who):
    truth, kept = drive[1], run(how, who)
    errors, usual = kept.errors(truth), sound.errors(truth)
    assert len(errors) == len(usual)
    assert np.sqrt(np.mean(errors**2)) < np.sqrt(np.mean(usual**2)) + ACCURACY
    lengths = [np.hypot(*np.diff(run.odometry, axis=0)[:, :2].T).sum() for run in (kept, sound)]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.005)
    assert "unusable stamp" in kept.outcome.dropped
    seconds = kept.outcome.log_seconds
    unknown = math.isnan(seconds)
    assert unknown or seconds == pytest.approx(sound.outcome.log_seconds, rel=0.2)
    assert not unknown or who == "both"


@pytest.mark.parametrize("how", BROKEN)
def test_inspect_and_a_run_measure_the_same_odometry(drive, run, how, tmp_path):
    messages = spoilt(drive[0], BROKEN[how], STREAMS["scans"])
    survey, kept = Survey(load("imp", SETTINGS)), run(how, "scans")
    with Played.of(messages, tmp_path) as source:
        assert len(list(survey.read(source))) == len(messages)
    length = np.hypot(*np.diff(kept.odometry, axis=0)[:, :2].T).sum()
    assert survey.distance == pytest.approx(length, rel=1e-4)
    assert "clocks differ" not in survey.problems.counts


@pytest.mark.parametrize("how", BROKEN)
def test_findings_that_need_times_are_not_made(drive, how):
    messages = spoilt(drive[0], BROKEN[how], (LaserScan,))
    named = batches((type(m).__name__, m) for m in messages)
    findings = [one.kind for one in diagnose(load("imp", SETTINGS), named, {})]
    assert not {"odometry stands still", "odometry stops", "stamps late"} & set(findings)


@pytest.fixture(scope="module")
def poses(drive):
    """Return the scans of the drive, of a few beams, and the exact odometry pose before each."""
    messages, truth = drive
    scans = [thinned(m) for m in messages if isinstance(m, LaserScan)]
    return [
        message
        for scan, pose in zip(scans, truth, strict=True)
        for message in (OdometryPose(scan.stamp, pose), scan)
    ]


def thinned(scan, step=40):
    """Return a scan of every 40th beam: dead reckoning uses none."""
    each = slice(None, None, step)
    offsets = scan.time_offsets[each]
    return replace(scan, angles=scan.angles[each], ranges=scan.ranges[each], time_offsets=offsets)


def carmen(messages, path):
    """Write a CARMEN log of odometry and scans; each scan has the pose of the odometry before it."""
    lines, pose = list[str](), np.zeros(3)
    for m in messages:
        if isinstance(m, OdometryPose):
            pose = m.pose
            lines.append(f"ODOM {pose[0]} {pose[1]} {pose[2]} 0 0 0 {m.stamp:.6f} host 0.0")
        else:
            ranges = m.ranges[::-1] if m.angles[0] > m.angles[-1] else m.ranges
            words = ["FLASER", len(ranges), *ranges.round(3), *pose, *pose]
            lines.append(" ".join(map(str, [*words, f"{m.stamp:.6f}", "host", 0.0])))
    path.write_text("\n".join(lines) + "\n")
    return path


def csv(messages, path):
    """Write a row for each message."""
    scan = next(m for m in messages if isinstance(m, LaserScan))
    angles = [repr(a) for a in np.degrees(scan.angles).round(4).tolist()]
    lines = [",".join(["stamp", "x", "y", "theta", *angles])]
    for m in messages:
        is_scan = isinstance(m, LaserScan)
        pose = ["", "", ""] if is_scan else map(repr, m.pose.tolist())
        ranges = map(str, m.ranges.round(3)) if is_scan else [""] * len(angles)
        lines.append(",".join([f"{m.stamp:.6f}", *pose, *ranges]))
    path.write_text("\n".join(lines) + "\n")
    return path


WRITERS = {"carmen": (carmen, "log.clf"), "csv": (csv, "log.csv")}


def dead_reckoned(log, rows):
    """Return the dead-reckoned motions to the scans of a log, read so many rows at a time."""
    config = load("default", ["tracker.kind=odometry"])
    robot, found = config.make_robot(), []
    with recognise(log)(path=log) as source:
        for batch in robot.streams.read(source, rows):
            found += robot.sense(batch)
    found += robot.flush()
    return np.concatenate([motions.d_pose for motions, _ in found]), robot


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("how", BROKEN)
@pytest.mark.parametrize("kinds", [LaserScan, OdometryPose])
def test_a_scan_gets_the_odometry_beside_it_in_the_file(poses, form, how, kinds, tmp_path):
    write, name = WRITERS[form]
    log = write(spoilt(poses, BROKEN[how], kinds), tmp_path / name)
    whole, robot = dead_reckoned(log, 10**6)
    truth = np.array([m.pose for m in poses if isinstance(m, OdometryPose)])
    expected = between(truth[:-1], truth[1:])
    # The first wrong stamps are believed: a few scans get the motion of their neighbours.
    assert (np.abs(whole[1:] - expected).max(axis=1) > 1e-5).sum() <= MAX_WRONG
    total = np.hypot(*whole[1:, :2].T).sum()
    assert total == pytest.approx(np.hypot(*expected[:, :2].T).sum(), rel=0.01)
    for rows in (1, 7):
        cut, other = dead_reckoned(log, rows)
        assert cut.tobytes() == whole.tobytes()
        assert other.problems == robot.problems
        assert other.elapsed == robot.elapsed or math.isnan(robot.elapsed)
