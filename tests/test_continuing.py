"""Going on with a map: where a log was stopped, with another log, and frozen."""

from itertools import accumulate, pairwise

import numpy as np
import pytest
from tests.estimators.drives import ANGLES, RING, scanned
from tests.numeric import wrapped

import impslam
from impslam.config import load
from impslam.continuing import KnownMap, begin_with
from impslam.errors import ConfigError, ImpError
from impslam.geometry.se2 import between, compose
from impslam.map import Map
from impslam.map_builder import MapBuilder, blended

CORNERS = np.array(
    [[3, 1.25], [18.75, 1.25], [18.75, 12.75], [1.25, 12.75], [1.25, 1.25], [9, 1.25]]
)
STEP = 0.1  # m between scans


@pytest.fixture(scope="module")
def drive():
    """Poses (n, 3) along the ring and 6 m of a second lap, and the ranges seen there (n, b)."""
    rows = [np.array([*CORNERS[0], 0.0])]
    for a, b in pairwise(CORNERS):
        heading = float(np.arctan2(*(b - a)[::-1]))
        turn = np.remainder(heading - rows[-1][2] + np.pi, 2.0 * np.pi) - np.pi
        rows += [rows[-1] + [0.0, 0.0, turn * s / 8] for s in range(1, 9)]
        n = round(np.hypot(*(b - a)) / STEP)
        rows += [np.array([*(a + (b - a) * s / n), heading]) for s in range(1, n + 1)]
    poses, rng = np.array(rows), np.random.default_rng(3)
    ranges = [scanned(RING, pose, noise=0.01, rng=rng).ranges for pose in poses]
    return poses, np.array(ranges)


def given(slam, drive, rows, late=0.0):
    poses, ranges = drive
    stamps = late + 0.1 * np.arange(len(poses))[rows]
    slam.add_odometry(stamps, poses[rows])
    slam.add_scans(stamps, ranges[rows], ANGLES, range_max=20.0)
    return slam


def mapped(drive, rows, late=0.0, config="default", **how):
    return given(impslam.Slam(config, **how), drive, rows, late).finish()


@pytest.fixture(scope="module")
def whole(drive):
    return mapped(drive, slice(None))


@pytest.mark.parametrize("stop", [1, 157, 400])
def test_a_log_that_was_stopped_gives_the_map_of_the_whole_log(drive, whole, stop, tmp_path):
    part = Map.load(mapped(drive, slice(stop)).save(tmp_path / "part.imp"))
    again = mapped(drive, slice(None), known=part)
    np.testing.assert_array_equal(again.stamps, whole.stamps)
    np.testing.assert_array_equal(again.tracked, whole.tracked)
    np.testing.assert_array_equal(again.keyframes.points, whole.keyframes.points)
    assert np.abs(wrapped(again.path()[:, 1:] - whole.path()[:, 1:], 2)).max() < 0.01
    assert again.keyframes.placed.all()
    assert again.keyframes.sessions.max() == 0


@pytest.mark.parametrize("stop", [157, 400])
@pytest.mark.parametrize("in_log", [False, True], ids=["in the map", "in the log"])
def test_scans_that_are_missing_do_not_make_another_log(drive, stop, in_log):
    """A computer that is too slow drops scans while it maps, or while it records."""
    some = np.random.default_rng(2).random(len(drive[0])) > 0.1
    some[[0, stop - 1]] = True
    rows = np.arange(len(some))
    log = rows[some] if in_log else rows
    before = rows[:stop] if in_log else rows[:stop][some[:stop]]
    again = mapped(drive, log, known=mapped(drive, before))
    expected = 0.1 * np.concatenate((before, log[log >= stop]))
    np.testing.assert_allclose(again.stamps, expected)
    assert again.keyframes.sessions.max() == 0
    truth = between(drive[0][0], drive[0][np.rint(10.0 * again.stamps).astype(int)])
    assert np.hypot(*(again.path()[:, 1:] - truth)[:, :2].T).max() < 0.05
    steps = between(again.live_poses[:-1], again.live_poses[1:])
    assert np.hypot(*steps[:, :2].T).max() < 0.6  # no jump where the log goes on


def test_another_log_begins_a_session_that_is_found(drive, whole, tmp_path):
    file = whole.save(tmp_path / "ring.imp")
    rows = slice(170, 340)
    known = mapped(drive, rows, late=1000.0, known=file)
    n = len(whole.stamps)
    np.testing.assert_array_equal(known.stamps[:n], whole.stamps)
    assert known.keyframes.sessions.max() == 1
    assert known.keyframes.placed.all()
    off = wrapped(known.path()[n:, 1:] - known.path()[rows, 1:], 2)
    assert np.abs(off).max() < 0.05


def test_another_log_with_the_same_stamps_is_told_by_its_odometry(drive, whole):
    """The stamps of simulators, and of robots whose clocks count from their start, are alike."""
    poses, ranges = drive
    rows = np.arange(170, 340)
    poses = poses.copy()
    poses[rows] = compose(np.array([1.0, 2.0, 0.5]), poses[rows])  # odometry has a start of its own
    known = mapped((poses, ranges), rows, late=-17.0, known=whole)
    assert known.stamps[len(whole.stamps)] < 1.0
    assert len(known.stamps) == len(whole.stamps) + len(rows)
    assert known.keyframes.sessions.max() == 1
    assert known.keyframes.placed.all()


@pytest.mark.parametrize(("rest", "alike", "dropped"), [(5, 5, 0), (0, 3, 0), (0, 15, 15)])
def test_the_first_scans_of_another_log_are_used(drive, rest, alike, dropped):
    """Simulated drives begin at the same stamp and at rest; only a longer motion tells what is the same."""
    poses, ranges = drive
    order = np.concatenate((np.full(rest, 10), np.arange(10, 170)))  # moves from scan 10 on
    first = mapped((poses[order], ranges[order]), slice(None))
    other = poses[order].copy()
    other[alike:, 0] += 0.01
    slam = given(impslam.Slam("default", known=first), (other, ranges[order]), slice(None))
    known = slam.finish()
    assert slam._run._continuation.unused == dropped
    used = len(known.stamps) - len(first.stamps)
    assert used == len(order) if dropped == 0 else used < len(order) - dropped + 1
    assert known.keyframes.sessions.max() == 1


def test_an_estimator_that_cannot_go_on_gives_way_to_one_that_can(drive, whole):
    """Unless it is asked for."""
    known = mapped(drive, slice(170, 340), late=1000.0, known=whole, config="imp", settings=[
        "odometry.kind=odometry_pose", "sensors.lidar.range_max=20",
    ])  # fmt: skip
    assert known.keyframes.placed.all()
    with pytest.raises(ConfigError, match="cannot continue a map"):
        impslam.Slam("imp", ["estimator.kind=landmarks"], known=whole)


@pytest.mark.parametrize("stop", [150, 300])
def test_an_estimator_that_cannot_go_on_leaves_all_that_it_has_seen(drive, stop, tmp_path):
    """Its keyframes are closer together than those of the graph that continues the map.

    The drive begins at speed: no wheel reaches 2 m/s within 0.1 s, and the estimator would expect a slip.
    """
    drive = tuple(rows[10:] for rows in drive)
    settings = ["odometry.kind=odometry_pose", "sensors.lidar.range_max=20"]
    part = mapped(drive, slice(stop), config="imp", settings=settings)
    part = Map.load(part.save(tmp_path / "part.imp"))
    again = mapped(drive, slice(None), config="imp", settings=settings, known=part)
    assert len(again.stamps) == len(drive[0])
    np.testing.assert_array_equal(again.stamps[:stop], part.stamps)
    assert again.keyframes.sessions.max() == 0
    assert again.keyframes.placed.all()
    off = wrapped(again.path()[:, 1:] - between(drive[0][0], drive[0]), 2)
    assert np.abs(off).max() < 0.25  # the graph has 0.17 with this lidar
    assert len(again.landmarks) >= len(part.landmarks) > 4


def test_a_robot_that_is_carried_elsewhere_is_found_again(drive, whole):
    """Odometry does not tell that it was."""
    poses, ranges = drive
    rows = np.concatenate([np.arange(len(poses)), np.arange(170, 400)])
    steps = between(poses[rows[:-1]], poses[rows[1:]])
    steps[len(poses) - 1] = 0.0
    odometry = np.array(list(accumulate(steps, compose, initial=poses[0])))
    slam = impslam.Slam("default")
    stamps = 0.1 * np.arange(len(rows))
    slam.add_odometry(stamps, odometry)
    slam.add_scans(stamps, ranges[rows], ANGLES, range_max=20.0)
    known = slam.finish()
    assert known.keyframes.sessions.max() == 1
    assert known.keyframes.placed.all()
    off = np.hypot(*(known.path()[len(poses) + 5 :] - whole.path()[175:400])[:, 1:3].T)
    assert off.max() < 0.1


def test_a_frozen_map_is_not_changed(drive, whole):
    rows = slice(170, 340)
    known = mapped(drive, rows, late=1000.0, known=whole, frozen=True)
    n = len(whole.keyframes)
    assert known.stamps[0] == pytest.approx(1017.0)
    for name in ("poses", "covariances", "motions"):
        before, after = (getattr(m.keyframes, name)[:n] for m in (whole, known))
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(known.keyframes.points, whole.keyframes.points)
    np.testing.assert_array_equal(known.grid().logodds, whole.grid().logodds)
    assert known.landmarks == whole.landmarks
    off = wrapped(known.path()[:, 1:] - whole.path()[rows, 1:], 2)
    assert np.abs(off).max() < 0.05


def test_a_hint_tells_about_where_it_begins(drive, whole):
    slam = impslam.Slam("default", known=whole, frozen=True, hint=drive[0][170])
    assert not slam.placed  # until the start is found
    given(slam, drive, slice(170, 340), late=1000.0)
    assert slam.placed
    assert np.abs(slam.pose[:2] - whole.path()[339, 1:3]).max() < 0.1


def test_a_hint_shortens_the_drive_that_locates_a_session(drive, whole):
    """Several closures are needed without one, and a single one with it."""
    short = slice(170, 215)
    for hint in (drive[0][170], drive[0][170, :2]):
        known = mapped(drive, short, late=1000.0, known=whole, hint=hint)
        assert known.keyframes.placed.all()
    assert not mapped(drive, short, late=1000.0, known=whole).keyframes.placed.all()


@pytest.mark.parametrize("dof", [2, 3])
def test_a_wrong_hint_excludes_the_true_place(drive, whole, dof):
    """The drive is longer than the hint is off, so the robot passes the hinted place."""
    hint = (whole.path()[170, 1:] + [0.0, 8.0, 0.0])[:dof]
    known = mapped(drive, slice(170, 290), late=1000.0, known=whole, hint=hint)
    assert not known.keyframes.placed.all()


def test_a_hint_is_about_the_first_session_only(drive, whole):
    """After the robot was carried, it is searched for everywhere."""
    poses, ranges = drive
    rows = np.concatenate([np.arange(170, 290), np.arange(20, 200)])
    steps = between(poses[rows[:-1]], poses[rows[1:]])
    steps[119] = 0.0
    odometry = np.array(list(accumulate(steps, compose, initial=poses[170])))
    slam = impslam.Slam("default", known=whole, hint=poses[170])
    stamps = 1000.0 + 0.1 * np.arange(len(rows))
    slam.add_odometry(stamps, odometry)
    slam.add_scans(stamps, ranges[rows], ANGLES, range_max=20.0)
    known = slam.finish()
    assert known.keyframes.sessions.max() == 2
    assert known.keyframes.placed.all()
    off = np.hypot(*(known.path()[-100:] - whole.path()[100:200])[:, 1:3].T)
    assert off.max() < 0.1


def test_a_session_that_is_too_short_to_be_found_is_kept_apart(drive, whole):
    known = mapped(drive, slice(170, 190), late=1000.0, known=whole)
    n, k = len(whole.stamps), len(whole.keyframes)
    assert len(known.stamps) == n + 20
    assert len(known.path()) == len(known.odometry()) == len(known.live_path()) == n
    assert not known.keyframes.placed[k:].any()
    refined = blended(whole.revised(load("default").make_estimator(whole).refine()))
    np.testing.assert_array_equal(known.keyframes.poses[:k], refined.keyframes.poses)
    np.testing.assert_array_equal(known.grid().logodds, refined.grid().logodds)


def test_a_continued_map_knows_all_of_its_logs(drive, whole):
    """Else the second log would be compared with the first scans of the first one, and mapped twice."""
    half = mapped(drive, slice(0, 300))
    later = mapped(drive, slice(300, 500), late=1000.0, known=half)
    assert [log["scans"] for log in later.about["logs"]] == [300, 200]
    again = mapped(drive, slice(300, 500), late=1000.0, known=later)
    assert len(again.stamps) == len(later.stamps)


def test_nothing_new_is_no_news(drive, whole):
    again = mapped(drive, slice(None), known=whole)
    assert len(again.stamps) == len(whole.stamps)
    assert len(again.keyframes) == len(whole.keyframes)


def test_a_log_that_differs_in_the_middle_begins_a_session(drive, whole):
    """Its first scans are those of the map, the later ones are not: the tracker may notice it as well."""
    slam = given(impslam.Slam("default", known=whole), drive, slice(100))
    given(slam, drive, slice(170, 340), late=1000.0)
    known = slam.finish()
    assert len(known.stamps) > len(whole.stamps)
    assert 1 <= known.keyframes.sessions.max() <= 2


def test_a_map_is_what_frozen_and_hints_are_about(whole, tmp_path):
    assert begin_with(None) is None
    assert isinstance(begin_with(whole), KnownMap)
    for how in ({"frozen": True}, {"hint": [1.0, 2.0]}):
        with pytest.raises(ConfigError, match="give one to localise in"):
            begin_with(None, **how)
    for hint in ([1.0], [1.0, np.nan], [1.0, 2.0, 3.0, 4.0]):
        with pytest.raises(ConfigError, match="is not a pose in a map"):
            begin_with(whole, hint=hint)
    with pytest.raises(ImpError, match="no such file"):
        begin_with(tmp_path / "gone.imp")
    with pytest.raises(ConfigError, match="has no keyframes"):
        begin_with(MapBuilder().map(), frozen=True)
