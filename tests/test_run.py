"""A run: exact without noise, patient with late odometry, and unmoved by bad messages."""

from dataclasses import replace

import numpy as np
import pytest
from tests.numeric import wrapped
from tests.recorded import Played, perfect
from tests.steps import Steps, feed

from impslam.bookkeeping import dropped
from impslam.config import load
from impslam.errors import SourceError
from impslam.geometry.se2 import compose, exp
from impslam.map import Map
from impslam.odometry.synchroniser import MAX_WAIT
from impslam.run import Run, map_log
from impslam.simulation.world import load_world
from impslam.sources.base import Problems
from impslam.types import (
    Image,
    LaserScan,
    OdometryPose,
    TruePose,
    WheelAngles,
)

EVERY_SCAN = ["keyframes.distance=0", "keyframes.angle=0", "keyframes.seconds=0"]


class Kept(Steps):
    """Tells how good the run was."""

    @property
    def worst(self):
        """Largest error of x, y or heading at any scan whose true pose is known."""
        errors = [
            np.abs(wrapped(r.pose - self.truths[r.stamp], 2)).max()
            for r in self.results
            if r.stamp in self.truths
        ]
        assert len(errors) > 50
        return max(errors)

    @property
    def dropped(self):
        return {kind: dropped.count for kind, dropped in self.outcome.dropped.items()}

    @property
    def sound(self):
        """Tell whether every pose is finite and every covariance positive definite."""
        return all(
            np.isfinite(r.pose).all() and np.linalg.eigvalsh(r.covariance)[0] > 0.0
            for r in self.results
        )


@pytest.fixture(scope="module")
def bare():
    """Four walls that do not meet: no beam can be taken for its neighbour's, so all fits are exact."""
    world = load_world("room")
    walls = tuple(shorter(wall) for wall in world.walls)
    return perfect(world.model_copy(update={"cylinders": (), "walls": walls}))


def shorter(wall, by=0.2):
    a, b = np.array(wall.start), np.array(wall.end)
    return wall.model_copy(
        update={"start": tuple(a + by * (b - a)), "end": tuple(b + by * (a - b))}
    )


@pytest.fixture(scope="module")
def room():
    return perfect(load_world("room"))


def play(messages, tmp_path, settings=()):
    """Run messages without scan matching, whose answer depends on where it starts from."""
    kept = Kept()
    map_log(load("imp", settings), Played.of(messages, tmp_path), [kept])
    return kept


def scans(messages):
    return [m for m in messages if isinstance(m, LaserScan)]


# --------------------------------------------------------------------------- exact


@pytest.mark.parametrize("settings", [[], EVERY_SCAN])
@pytest.mark.parametrize("filter_", ["ekf", "fej", "riekf"])
def test_a_noiseless_run_is_exact(bare, tmp_path, filter_, settings):
    kept = play(bare, tmp_path, [f"filter.kind={filter_}", *settings])
    assert len(kept.results) == len(scans(bare))
    assert kept.worst < 1e-6
    assert kept.dropped == {}
    feet = [m.position for m in kept.known.landmarks if m.kind == "wall"]
    expected = [[0, -0.8], [2.4, 0], [0, 1.8], [-0.6, 0]]
    assert len(feet) == 4
    for foot in expected:
        assert min(np.abs(foot - np.array(feet)).max(axis=1)) < 1e-6


def test_cylinders_are_found_to_a_tenth_of_a_millimetre(room, tmp_path):
    kept = play(room, tmp_path)
    assert kept.worst < 1e-4
    centres = [m.position for m in kept.known.landmarks if m.kind == "cylinder"]
    np.testing.assert_allclose(sorted(map(list, centres)), [[0.5, 0.9], [1.9, -0.2]], atol=2e-4)


def test_motion_during_the_sweep_is_undone(tmp_path):
    """Of a sweep of 67 ms, at 0.3 m/s and 0.8 rad/s: 2 cm and 3 degrees without."""
    messages = perfect(load_world("room"), beam_time=97.66e-6)
    undone = play(messages, tmp_path).worst
    assert undone < 2e-3  # the speed is not constant within a sweep
    assert play(messages, tmp_path, ["sensors.lidar.deskew=false"]).worst > 3 * undone


def test_dead_reckoning_is_the_composition_of_the_wheels_increments(bare, tmp_path):
    none = [f"sensors.lidar.extractors.{name}.kind=none" for name in ("walls", "corners")]
    kept = play(bare, tmp_path, [*none, "sensors.lidar.extractors.cylinders.kind=none"])
    assert kept.worst < 1e-12
    for result in kept.results:
        np.testing.assert_allclose(result.pose, result.odometry, atol=1e-12)


def test_scan_matching_does_not_change_what_odometry_alone_tells(room, tmp_path):
    """The matcher refines the filter's motion; the path by odometry is there to compare with."""
    slipping = [replace(m, left=0.9 * m.left) if isinstance(m, WheelAngles) else m for m in room]
    without = play(slipping, tmp_path)
    matched = play(slipping, tmp_path, ["tracker.kind=scan_to_map"])
    for a, b in zip(without.results, matched.results, strict=True):
        np.testing.assert_allclose(a.odometry, b.odometry, atol=1e-12)
    assert (
        matched.worst < 0.05 < np.abs(matched.results[-1].odometry - matched.results[-1].pose).max()
    )


def test_the_same_log_gives_the_same_bytes(room, tmp_path):
    one, two = (play(room, tmp_path, ["sensors.lidar.extractors.walls.kind=ransac"]) for _ in "ab")
    for a, b in zip(one.results, two.results, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_the_start_is_where_the_config_says(bare, tmp_path):
    start = np.array([3.0, -1.0, 2.0])
    kept = play(bare, tmp_path, [f"start={start.tolist()}"])
    for result in kept.results[::10]:
        moved = compose(start, kept.truths[result.stamp])
        assert np.abs(wrapped(result.pose - moved, 2)).max() < 1e-6


# --------------------------------------------------------------------------- order and waiting


def test_a_scan_waits_for_the_odometry_after_it(bare, tmp_path):
    """Scans that arrive before the wheel readings of their time change nothing."""
    early = sorted(bare, key=lambda m: m.stamp - 0.05 * isinstance(m, LaserScan))
    kept = play(early, tmp_path)
    assert kept.worst < 1e-6
    assert len(kept.results) == len(scans(bare))


def test_a_scan_of_a_live_robot_does_not_wait_for_ever(bare):
    kept, scan = Kept(), scans(bare)[0]
    course = Run(load("imp"), [kept])
    course.robot.wait_for_rows_only()
    feed(course, [scan])
    waited = 0
    while not kept.results:
        feed(course, [Image(scan.stamp, "jpeg", b"")])
        waited += 1
    assert waited == MAX_WAIT
    assert kept.results[0].stamp == scan.stamp


def test_scans_at_the_end_of_a_log_are_used(bare, tmp_path):
    """The odometry ends before the last scans: they are used with what is known."""
    last = scans(bare)[-5].stamp
    cut = [m for m in bare if not (isinstance(m, WheelAngles) and m.stamp >= last)]
    kept = play(cut, tmp_path)
    assert len(kept.results) == len(scans(bare))
    assert kept.sound


def test_a_scan_before_all_odometry_is_at_the_start(bare, tmp_path):
    first = next(i for i, m in enumerate(bare) if isinstance(m, WheelAngles))
    early = replace(scans(bare)[0], stamp=bare[first].stamp - 1.0)
    kept = play([early, *bare], tmp_path)
    np.testing.assert_allclose(kept.results[0].pose, 0.0, atol=1e-9)
    assert kept.worst < 1e-6


@pytest.mark.parametrize("latency", [0.05, 0.3])
def test_a_late_stamp_is_undone(bare, tmp_path, latency):
    """Every scan is stamped late; its result is the pose at the stamp, the log's own."""
    late = [replace(m, stamp=m.stamp + latency) if isinstance(m, LaserScan) else m for m in bare]
    late.sort(key=lambda m: m.stamp)
    kept = play(late, tmp_path, [f"sensors.lidar.latency={latency}"])
    path = {round(m.stamp, 6): m.pose for m in bare if isinstance(m, TruePose)}
    errors = [
        np.abs(wrapped(r.pose - path[round(r.stamp, 6)], 2)).max()
        for r in kept.results
        if round(r.stamp, 6) in path
    ]
    assert len(errors) > 50
    assert max(errors) < 1e-6
    assert play(late, tmp_path).worst > 1e-3  # it would be seen


@pytest.mark.parametrize(("latency", "earlier"), [(0.5, 0.0), (1.0, 0.0), (3600.0, 3600.0)])
def test_poses_of_a_lidar_whose_clock_is_ahead(bare, tmp_path, latency, earlier):
    """Its scans arrive in time, so odometry reaches their stamps long after them, or never."""
    ahead = [replace(m, stamp=m.stamp + latency) if isinstance(m, LaserScan) else m for m in bare]
    kept = play(ahead, tmp_path, [f"sensors.lidar.latency={latency}"])
    path = {round(m.stamp, 6): m.pose for m in bare if isinstance(m, TruePose)}
    errors = [
        np.abs(wrapped(r.pose - path[at], 2)).max()
        for r in kept.results
        if (at := round(r.stamp - earlier, 6)) in path
    ]
    assert len(errors) > 50
    assert max(errors) < 1e-6


def test_stamps_that_run_backwards_are_used_in_file_order(bare, tmp_path):
    """Some logs jitter: the scan is where it stands in the file, its stamp is what it is."""
    stamps = {id(m): m.stamp - 0.15 * (i % 7 == 3) for i, m in enumerate(scans(bare))}
    jittered = [replace(m, stamp=stamps[id(m)]) if isinstance(m, LaserScan) else m for m in bare]
    kept = play(jittered, tmp_path)
    assert [r.stamp for r in kept.results] == list(stamps.values())
    assert kept.dropped["backward stamp"] > 5
    assert kept.sound


def test_repeated_stamps_move_nothing(bare, tmp_path):
    doubled = [m for message in bare for m in (message, message)]
    kept = play(doubled, tmp_path)
    assert kept.worst < 1e-6
    assert kept.dropped["repeated stamp"] > 1000
    assert kept.outcome.counts["steps"] == 2 * len(scans(bare))


# --------------------------------------------------------------------------- keyframes


def test_between_keyframes_the_pose_is_dead_reckoned(bare, tmp_path):
    kept = play(bare, tmp_path)
    looked = [r.keyframe for r in kept.results]
    assert 20 < sum(looked) < 0.8 * len(looked)
    for before, after in zip(kept.results, kept.results[1:], strict=False):
        if not after.keyframe:
            step = compose(exp(np.zeros(3)), after.pose) - before.pose
            motion = after.odometry - before.odometry
            np.testing.assert_allclose(wrapped(step - motion, 2), 0.0, atol=1e-6)


# --------------------------------------------------------------------------- bad messages


def spoil(messages, every, change):
    """Return messages with every n-th scan changed."""
    numbers = {id(m): i for i, m in enumerate(scans(messages))}
    return [
        change(m) if isinstance(m, LaserScan) and numbers[id(m)] % every == every // 2 else m
        for m in messages
    ]


def filled(value):
    return lambda scan: replace(scan, ranges=np.full(len(scan.ranges), value))


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -np.inf, -1.0, 1e9])
def test_scans_without_a_valid_range_are_counted_and_dead_reckoned(bare, tmp_path, value):
    kept = play(spoil(bare, 5, filled(value)), tmp_path, EVERY_SCAN)
    assert kept.dropped == {"scan without valid beams": 20}
    example = kept.outcome.dropped["scan without valid beams"].example
    assert "no valid range" in example
    assert "\n" not in example
    assert kept.worst < 1e-6
    assert len(kept.results) == len(scans(bare))


def test_single_bad_ranges_are_left_out(bare, tmp_path):
    rng = np.random.default_rng(3)
    bad = np.array([0.0, np.nan, np.inf, -np.inf, -0.5, 19e-3, 1e9])

    def change(scan):
        ranges = scan.ranges.copy()
        at = rng.random(len(ranges)) < 0.1
        ranges[at] = rng.choice(bad, at.sum())
        return replace(scan, ranges=ranges)

    assert play(spoil(bare, 1, change), tmp_path).worst < 1e-6


def test_scans_may_change_their_length(bare, tmp_path):
    """By half a field of view, by every second beam, and down to one beam."""

    def sliced(*cuts):
        def change(scan):
            part = slice(*cuts)
            return replace(
                scan,
                angles=scan.angles[part],
                ranges=scan.ranges[part],
                time_offsets=scan.time_offsets[part],
            )

        return change

    mixed = bare
    for every, cuts in [
        (3, (0, 341)),
        (4, (None, None, 2)),
        (5, (300, 301)),
        (7, (None, None, -1)),
    ]:
        mixed = spoil(mixed, every, sliced(*cuts))
    kept = play(mixed, tmp_path, EVERY_SCAN)
    assert {len(s.ranges) for s in scans(mixed)} >= {682, 341, 1}
    assert kept.worst < 1e-6


def test_scans_without_beams_are_dropped_and_their_motion_kept(bare, tmp_path):
    nothing = np.empty(0)
    emptied = spoil(
        bare, 5, lambda s: replace(s, angles=nothing, ranges=nothing, time_offsets=nothing)
    )
    kept = play(emptied, tmp_path)
    assert kept.dropped == {"scan": 20}
    assert "no beams" in kept.outcome.dropped["scan"].example
    assert len(kept.results) == len(scans(bare)) - 20
    assert kept.worst < 1e-6


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_wheel_readings_that_are_no_numbers_are_counted(bare, tmp_path, value):
    """The motion across a lost reading is that between its neighbours."""
    wheels = [m for m in bare if isinstance(m, WheelAngles)]
    bad = set(map(id, wheels[5::100]))
    spoiled = [replace(m, left=value) if id(m) in bad else m for m in bare]
    kept = play(spoiled, tmp_path)
    assert kept.dropped == {"odometry": len(bad)}
    assert "not finite" in kept.outcome.dropped["odometry"].example
    assert kept.worst < 1e-6


def test_a_jump_of_an_encoder_is_counted_and_does_not_move_the_robot(bare, tmp_path):
    """A counter that was reset: what it tells from then on counts again."""
    wheels = [m for m in bare if isinstance(m, WheelAngles)]
    when = wheels[len(wheels) // 2].stamp
    jumped = [
        replace(m, right=m.right + 1e4) if isinstance(m, WheelAngles) and m.stamp > when else m
        for m in bare
    ]
    kept = play(jumped, tmp_path)
    assert kept.dropped == {"odometry": 1}
    assert "jumps by" in kept.outcome.dropped["odometry"].example
    assert kept.worst < 0.005  # one reading, 10 ms at 0.3 m/s, is lost until walls tell
    assert kept.sound


def test_a_pause_of_minutes_is_counted_and_bridged(bare, tmp_path):
    """The robot stands while its clock goes on."""
    middle = bare[len(bare) // 2].stamp
    paused = [replace(m, stamp=m.stamp + 300.0) if m.stamp > middle else m for m in bare]
    kept = play(paused, tmp_path)
    assert kept.dropped == {"gap": 3}  # of wheels, scans and truth
    assert kept.worst < 1e-6


def test_motion_after_the_last_scan_is_said(bare, tmp_path):
    """As if the lidar failed, or TF moved it so that its scans are dropped."""
    last = [m for m in bare if isinstance(m, WheelAngles)][-1]
    times = np.arange(0.1, 90.0, 0.1)
    ahead = [WheelAngles(last.stamp + t, last.left + 5 * t, last.right + 5 * t) for t in times]
    health = play([*bare, *ahead], tmp_path).outcome.health
    assert health.silent == pytest.approx(90.0, abs=0.5)
    assert health.at_end == "DEGRADED"
    end = "; at the end DEGRADED: no scan in the last 90 s, while the robot moves on"
    assert health.summary == "TRACKING throughout" + end
    stood = [WheelAngles(last.stamp + t, last.left, last.right) for t in times]
    health = play([*bare, *stood], tmp_path).outcome.health
    assert (health.silent, health.at_end) == (0.0, "TRACKING")


def test_messages_nobody_understands_are_passed_over(bare, tmp_path):
    others = [Image(bare[0].stamp, "jpeg", b"x"), OdometryPose(bare[0].stamp, np.full(3, 9.0))]
    kept = play([*others, *bare, *others[:1]], tmp_path)
    assert kept.worst < 1e-6
    assert kept.outcome.counts["Image"] == 2
    assert kept.outcome.counts["OdometryPose"] == 1


@pytest.mark.parametrize("seed", range(4))
def test_whatever_comes_the_filter_stays_sound(room, tmp_path, seed):
    """Every fault at once, at random places."""
    rng = np.random.default_rng(seed)
    spoiled = []
    for message in room:
        fault = rng.random()
        if isinstance(message, LaserScan) and fault < 0.3:
            ranges = message.ranges * rng.choice([1.0, -1.0, np.nan, 0.0, 1e6], len(message.ranges))
            message = replace(message, ranges=ranges)  # noqa: PLW2901
        elif isinstance(message, WheelAngles) and fault < 0.02:
            message = replace(message, left=rng.choice([np.nan, np.inf, 1e30, -1e300]))  # noqa: PLW2901
        if fault > 0.97:
            message = replace(message, stamp=message.stamp + rng.choice([-50.0, -0.1, 0.1]))  # noqa: PLW2901
        spoiled.extend([message] * (1 + (fault > 0.95)))
    kept = play(spoiled, tmp_path)
    assert kept.sound
    assert kept.dropped["odometry"] > 5
    assert np.abs(kept.results[-1].pose[:2]).max() < 5.0


# --------------------------------------------------------------------------- nothing to use


def test_a_log_without_scans_ends_in_one_line(bare, tmp_path):
    with pytest.raises(SourceError, match="no usable scan") as error:
        play([m for m in bare if not isinstance(m, LaserScan)], tmp_path)
    assert "\n" not in str(error.value)


def test_a_log_without_odometry_ends_in_one_line(bare, tmp_path):
    with pytest.raises(SourceError, match="no WheelAngles for odometry 'encoders'") as error:
        play([m for m in bare if not isinstance(m, WheelAngles)], tmp_path)
    assert "\n" not in str(error.value)


def test_the_outcome_tells_what_the_run_was(bare, tmp_path):
    kept = play(bare, tmp_path)
    outcome = kept.outcome
    assert outcome.counts["LaserScan"] == outcome.counts["steps"] == len(scans(bare))
    assert outcome.counts["landmarks"] == len(kept.known.landmarks)
    assert outcome.log_seconds == pytest.approx(bare[-1].stamp - bare[0].stamp, abs=0.2)
    assert outcome.config == load("imp", []).resolved()
    assert set(outcome.stages) == {"sense", "track", "extract", "estimate", "refine"}
    assert len(outcome.stages["estimate"]) == len(kept.known.keyframes)
    assert sum(times.sum() for times in outcome.stages.values()) < outcome.wall_seconds


def test_the_map_holds_the_path_as_it_was_known_and_as_it_is(bare, tmp_path):
    kept = play(bare, tmp_path)
    known = kept.known
    np.testing.assert_array_equal(known.stamps, [r.stamp for r in kept.results])
    np.testing.assert_array_equal(known.live_poses, [r.pose for r in kept.results])
    np.testing.assert_array_equal(known.odometry_poses, [r.odometry for r in kept.results])
    np.testing.assert_allclose(known.rows().poses, known.live_poses, atol=1e-12)
    spread = [r.covariance for r in kept.results]
    np.testing.assert_allclose(known.rows().covariances, spread, atol=1e-12)
    assert known.about["counts"] == dict(sorted(kept.outcome.counts.items()))


@pytest.mark.parametrize("filter_", ["ekf", "riekf", "ukf"])
def test_the_joint_covariance_of_landmarks_is_in_the_file_of_the_map(room, tmp_path, filter_):
    """As the filter has it: common errors of the drive make landmarks correlated."""
    course = Run(load("imp", [f"filter.kind={filter_}"]))
    course.play(room)
    file = course.map().save(tmp_path / "map.imp")
    known = Map.load(file)
    expected = course.estimator.landmark_covariance()
    assert expected.shape == (2 * len(known.landmarks),) * 2
    assert known.landmark_covariance.tobytes() == expected.tobytes()
    sigmas = np.sqrt(np.diag(expected))
    between = expected / np.outer(sigmas, sigmas) - np.eye(len(sigmas))
    assert np.abs(between).max() > 0.1
    drawn, _ = course.draft(tmp_path / "played.log")()
    assert drawn.landmark_covariance.tobytes() == expected.tobytes()


@pytest.mark.parametrize("rows", [1, 7, 100_000])
def test_any_cutting_of_a_log_gives_the_same_bytes(room, tmp_path, rows):
    """With everything on: scan matching, RANSAC, tentative landmarks."""
    settings = ["tracker.kind=scan_to_map", "sensors.lidar.extractors.walls.kind=ransac"]
    maps = []
    for size in (rows, 64):
        course = Run(load("imp", settings))
        for cut in Played.of(room, tmp_path).batches(size):
            course.feed(cut)
        course.flush()
        maps.append(course.map().save(tmp_path / f"{size}.imp").read_bytes())
    assert maps[0] == maps[1]


def test_problems_of_one_kind_in_several_parts_are_added():
    reading, tracking = Problems(), Problems()
    reading.add("scan", "first", 3)
    tracking.add("scan", "second", 4)
    assert dropped([reading, tracking])["scan"].count == 7
    assert dropped([reading, tracking])["scan"].example == "first"
