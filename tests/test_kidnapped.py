"""A robot that is carried elsewhere without a word from odometry: it says so, and is found again."""

import numpy as np
import pytest
from tests.estimators.drives import ANGLES
from tests.test_continuing import drive

import impslam
from impslam.geometry.se2 import between, compose, inverse
from impslam.health import ASSUMED, CHANGED, LOST, NONE, TRACKING

__all__ = ["drive"]  # a fixture
LEFT, FOUND = (
    360,
    155,
)  # scans: in the middle of a corridor, and where it is put down, near a corner


def test_a_robot_that_is_carried_elsewhere_is_lost_and_found(drive):
    poses, ranges = drive
    rows = np.r_[0:LEFT, FOUND : FOUND + 120]
    carried = compose(compose(poses[LEFT - 1], inverse(poses[FOUND])), poses[FOUND : FOUND + 120])
    told = np.vstack((poses[:LEFT], carried))  # by odometry, which does not know of it
    slam = impslam.Slam("default")
    stamps = 0.1 * np.arange(len(rows))
    slam.add_odometry(stamps, told)
    slam.add_scans(stamps, ranges[rows], ANGLES, range_max=20.0)
    known = slam.finish()
    health = slam._run._health.health
    assert (health.states[:LEFT] == TRACKING).all()
    assert health.reasons[LEFT] != NONE  # the first scan after it
    first = int(np.argmax(health.states == LOST))
    assert LEFT < first <= LEFT + 10  # within a second
    assert health.states[-1] == TRACKING
    assert known.keyframes.placed.all()
    sizes = np.diff(known.keyframes.starts)
    meanwhile = (known.keyframes.stamps >= stamps[LEFT]) & (known.keyframes.stamps < stamps[first])
    assert not sizes[meanwhile].any()  # the map takes in nothing
    truth = compose(inverse(poses[0]), poses[rows])
    off = np.hypot(*(known.path()[:, 1:] - truth)[first:, :2].T)
    assert np.median(off) < 0.1


@pytest.mark.parametrize(
    ("left", "found", "seconds"),
    [(600, 20, 5000.0), (600, 400, 5000.0), (450, 250, 1e6), (450, 250, -1e6)],
    ids=["hour", "elsewhere", "days", "clock set"],
)
def test_a_second_drive_in_a_log_is_not_where_odometry_jumps_to(drive, left, found, seconds):
    """It begins elsewhere, and its odometry at zero: the pose is right, or said to be in doubt."""
    poses, ranges = drive
    rows = np.r_[0:left, found : found + 120]
    told = np.vstack((between(poses[0], poses[:left]), between(poses[found], poses[rows[left:]])))
    stamps = 0.1 * np.arange(len(rows))
    stamps[left:] += seconds
    slam = impslam.Slam("default")
    slam.add_odometry(stamps, told)
    slam.add_scans(stamps, ranges[rows], ANGLES, range_max=20.0)
    known = slam.finish()
    off = np.hypot(*between(between(poses[0], poses[rows]), known.live_poses)[:, :2].T)
    states = slam._run._health.health.states
    assert (states[:left] == TRACKING).all()
    assert (states[left : left + 20] != TRACKING).any()
    assert off[states == TRACKING].max() < 0.2


def test_the_map_of_a_robot_that_is_carried_before_it_drives_is_that_of_the_drive(drive, tmp_path):
    """It is never found where it was switched on, of which the map contains a single keyframe."""
    poses, ranges = drive
    rows = np.r_[np.full(30, LEFT), FOUND : FOUND + 150]
    there = compose(poses[LEFT], inverse(poses[FOUND]))
    told = compose(np.where(rows[:, None] == LEFT, np.zeros(3), there), poses[rows])
    slam = impslam.Slam("default")
    stamps = 0.1 * np.arange(len(rows))
    slam.add_odometry(stamps, told)
    slam.add_scans(stamps, ranges[rows], ANGLES, range_max=20.0)
    known = slam.finish()
    assert not known.keyframes.placed[0]
    assert known.keyframes.placed[1:].all()
    path = known.path()
    assert len(path) >= 145
    truth = compose(inverse(poses[rows[-len(path)]]), poses[rows[-len(path) :]])
    off = compose(inverse(path[0, 1:]), path[:, 1:]) - truth
    assert np.hypot(*off[:, :2].T).max() < 0.1
    assert np.sqrt(known.keyframes.covariances[1:, 0, 0]).max() < 0.3
    known.save(tmp_path / "map.imp")
    known = impslam.Map.load(tmp_path / "map.imp")
    slam = impslam.Slam("default", known=known, hint=tuple(path[0, 1:]))
    slam.add_odometry(stamps[33:] + 100.0, told[33:])
    slam.add_scans(stamps[33:] + 100.0, ranges[rows[33:]], ANGLES, range_max=20.0)
    placed = slam.finish().keyframes.placed
    assert not placed[0]
    assert placed[1:].all()
    assert len(placed) > len(known.keyframes)


def run(poses, shown):
    """Return the map of a drive, with errors in m and the health of its scans."""
    slam = impslam.Slam("default")
    stamps = 0.1 * np.arange(len(poses))
    slam.add_odometry(stamps, poses)
    slam.add_scans(stamps, shown, ANGLES, range_max=20.0)
    known = slam.finish()
    truth = compose(inverse(poses[0]), poses)
    off = np.hypot(*(known.path()[:, 1:] - truth)[:, :2].T)
    return known, off, slam._run._health.health


def test_a_robot_whose_view_alone_changes_is_found_where_odometry_expects_it(drive):
    """For a second it sees what is elsewhere. The building looks the same if turned by half."""
    poses, ranges = drive
    shown = ranges.copy()
    shown[LEFT : LEFT + 10] = ranges[FOUND : FOUND + 10]
    known, off, health = run(poses, shown)
    assert 10 < np.count_nonzero(health.states == LOST) < 100  # 10 m
    assert not (health.reasons == ASSUMED).any()
    assert health.reasons[-1] == NONE
    assert known.keyframes.placed.all()
    assert off[LEFT + 20 :].max() < 0.1


def test_scans_with_something_near_that_soon_leaves_are_in_doubt_and_not_mapped(drive):
    """A flat object approaches the left side of the robot for half a second."""
    poses, ranges = drive
    shown, rows = ranges.copy(), slice(LEFT, LEFT + 5)
    distances = np.linspace(0.9, 0.5, 5)[:, None]
    left = np.flatnonzero(np.sin(ANGLES) > 0.4)
    shown[rows, left] = np.minimum(ranges[rows, left], distances / np.sin(ANGLES[left]))
    known, off, health = run(poses, shown)
    assert (health.reasons[LEFT : LEFT + 10] == CHANGED).all()
    assert not health.reasons[:LEFT].any()
    assert not health.reasons[LEFT + 15 :].any()
    keys, stamps = known.keyframes, health.stamps
    meanwhile = (keys.stamps >= stamps[LEFT]) & (keys.stamps < stamps[LEFT + 10])
    assert meanwhile.any()
    assert not np.diff(keys.starts)[meanwhile].any()
    assert off.max() < 0.1


TURNING = slice(143, 168)  # scans: a corner, behind which nothing was in view before
END = 470  # scans: the end of new ground


def covered(drive, rows):
    """Return a drive whose lidar sees nothing but a dense crowd in some scans."""
    poses, ranges = drive[0], drive[1].copy()
    people = np.random.default_rng(1).uniform(0.5, 1.5, ranges[rows].shape)
    ranges[rows] = np.minimum(ranges[rows], people)
    return poses, ranges


@pytest.mark.parametrize("first", [184, 192, 200, 208, 216])
def test_a_robot_that_was_in_a_crowd_is_found_on_ground_that_was_in_view_before(drive, first):
    """For a second, in a corridor whose end was in view before; other corridors look the same."""
    known, off, health = run(*covered([one[:END] for one in drive], slice(first, first + 10)))
    assert 0 < np.count_nonzero(health.states == LOST) < 100  # 10 m
    assert not (health.reasons == ASSUMED).any()
    assert health.reasons[-1] == NONE
    assert known.keyframes.placed.all()
    assert off[first + 110 :].max() < 0.1


def test_on_new_ground_a_place_by_odometry_is_reported_as_assumed(drive):
    known, _, health = run(*covered([one[:END] for one in drive], TURNING))
    assert (health.states == LOST).any()
    assert health.reasons[-1] == ASSUMED
    assert known.keyframes.placed.all()


def test_a_place_from_before_shows_that_odometry_was_right(drive):
    """The robot drives all the way back, in reverse."""
    there = [np.concatenate([one[:END], one[END - 2 :: -1]]) for one in drive]
    _, off, health = run(*covered(there, TURNING))
    assert (health.reasons == ASSUMED).any()
    assert health.reasons[-1] == NONE
    assert np.median(off) < 0.1
