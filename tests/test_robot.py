"""The robot: any cutting of a log gives the same bytes, and they are those of the plain reference."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.sensing import Reference

from impslam.columns import batches, single_row
from impslam.component import build
from impslam.errors import ConfigError
from impslam.geometry.se2 import compose, exp
from impslam.odometry.synchroniser import MAX_WAIT
from impslam.robot import Robot
from impslam.sensors.lidar2d import Lidar2D
from impslam.sensors.range_bearing import RangeBearing
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import (
    Detections,
    Image,
    LaserScan,
    OdometryPose,
    Steering,
    Velocity,
    WheelAngles,
)

ODOMETRY = {
    "encoders": {"wheel_radius": 0.0635, "track": 0.4},
    "odometry_pose": {"drift": (0.01, 0.02, 0.03)},
    "velocity": {"latency": 0.05},
    "ackermann": {"wheelbase": 0.5, "axle": (0.3, 0.1), "encoder_offset": 0.1},
}
SENSORS = {
    "front": {"kind": "lidar2d", "stream": "front", "mount": (0.2, 0.0, 0.0), "period": 0.1},
    "rear": {
        "kind": "lidar2d",
        "stream": "rear",
        "mount": (-0.2, 0.1, 3.0),
        "upside_down": True,
        "latency": 0.04,
    },
    "camera": {"kind": "range_bearing", "latency": 0.3},
}


def felt(kind, t, pose, speeds, travelled):
    """Return what an odometry says at a time."""
    if kind == "encoders":
        return WheelAngles(t, *(travelled / 0.0635))
    if kind == "odometry_pose":
        return OdometryPose(t, pose)
    return (Velocity if kind == "velocity" else Steering)(t, *speeds)


def spoil(message, fault):
    """Return a message that cannot be used."""
    changed = {
        WheelAngles: {"left": math.nan} if fault else {"right": 1e7},
        OdometryPose: {"pose": np.full(3, math.nan if fault else 500.0)},
        Velocity: {"speed": math.nan if fault else 99.0},
        Steering: {"speed": math.nan if fault else 99.0},
    }
    return replace(message, **changed[type(message)])


class Recording:
    """A log of 20 s with all that goes wrong: (stream, message) in the order of arrival."""

    def __init__(self, kind, seed=0):
        self.rng, self.log, self.late, self.kind = np.random.default_rng(seed), [], [], kind
        pose, travelled, t = np.zeros(3), np.zeros(2), 100.0
        for i in range(1500):
            dt = float(self.rng.uniform(0.004, 0.02))
            v, w = 0.5 + 0.3 * math.sin(0.01 * i), 0.6 * math.cos(0.013 * i)
            t, pose = t + dt, compose(pose, exp(np.array([v * dt, 0.0, w * dt])))
            travelled = travelled + dt * np.array([v - 0.2 * w, v + 0.2 * w])
            clock = t - 30.0 * (i > 500) + 75.0 * (i > 900)
            if not 1200 < i < 1300:  # odometry is silent, longer than a sweep waits
                self.feel(i, felt(kind, self.jittered(clock), pose, (v, 0.3 * w), travelled))
            for name, every in (("front", 9), ("rear", 7), ("camera", 31)):
                if i % every == 0:
                    self.see(i, name, self.jittered(clock))
            self.arrive(i)

    def jittered(self, stamp):
        return stamp + float(self.rng.normal(0.0, 0.01)) * (self.rng.random() < 0.3)

    def feel(self, i, message):
        if self.rng.random() < 0.01:
            message = spoil(message, i % 2)
        self.log.append(("wheels", message))

    def see(self, i, name, stamp):
        together = self.rng.random() < 0.2 and self.log
        stamp = self.log[-1][1].stamp if together else stamp
        self.late.append((i + int(self.rng.integers(0, 30)), name, self.seen(name, stamp)))

    def seen(self, name, stamp):
        if name == "camera":
            ranges = self.rng.uniform(0.5, 4.0, 2)
            ranges[:] = math.nan if self.rng.random() < 0.2 else ranges
            return Detections(
                stamp, ranges, self.rng.normal(0.0, 0.3, 2), np.arange(2), np.full(2, math.nan)
            )
        n = 0 if self.rng.random() < 0.05 else 12
        ranges = self.rng.uniform(0.1, 5.0, n) * (self.rng.random() > 0.05)
        return LaserScan(stamp, np.linspace(-2.0, 2.0, n), ranges, 5e-3 * np.arange(n), 0.1, 4.5)

    def arrive(self, i):
        """Append what has come by now, and rows that nobody reads."""
        for _, name, message in [late for late in self.late if late[0] <= i]:
            self.log.append((name, message))
        self.late = [late for late in self.late if late[0] > i]
        if self.rng.random() < 0.1:
            others = 40 if self.rng.random() < 0.02 else 1
            self.log += [("eye", Image(0.0, "jpeg", b""))] * others


def make(kind, sensors=SENSORS):
    odometry = build("odometry", {"kind": kind, **ODOMETRY[kind]})
    return Robot("r", odometry, {name: build("sensor", table) for name, table in sensors.items()})


def sensed(robot, log, size):
    """Return all that a robot gives of a log, row by row."""
    found = []
    for part in batches(log, size):
        found += robot.sense(part)
    found += robot.flush()
    return [
        (sweeps.sensor, motions.take(slice(k, k + 1)), sweeps.take(slice(k, k + 1)))
        for motions, sweeps in found
        for k in range(len(sweeps))
    ]


def plain_bytes(row):
    name, motions, sweeps = row
    arrays = [
        *motions,
        sweeps.middles,
        sweeps.twists,
        sweeps.T_middle_stamp,
        sweeps.stamp_covariance,
    ]
    arrays += [sweeps.columns.order, *sweeps.columns.values.values()]
    if sweeps.scans is not None:
        s = sweeps.scans
        arrays += [s.ranges, s.valid, s.points, s.directions, s.origins, s.sigmas, s.laser]
    return name, [a.tobytes() for a in arrays]


@pytest.fixture(scope="module", params=sorted(ODOMETRY))
def recording(request):
    return Recording(request.param)


def test_any_cutting_gives_the_same_bytes(recording):
    robots = {size: make(recording.kind) for size in (1, 5, 512, 10**6)}
    found = {size: sensed(robot, recording.log, size) for size, robot in robots.items()}
    one, whole = map(plain_bytes, found[1]), found.pop(10**6)
    expected = [plain_bytes(row) for row in whole]
    assert list(one) == expected
    for size, robot in robots.items():
        if size in found:
            assert [plain_bytes(row) for row in found[size]] == expected
        assert robot.problems == robots[1].problems
        assert robot.counts == robots[1].counts
        assert robot.elapsed == robots[1].elapsed
        assert robot.ahead().d_pose.tobytes() == robots[1].ahead().d_pose.tobytes()
    assert robots[1].problems.counts.keys() == {
        "odometry", "scan", "scan without valid beams", "clock step", "unusable stamp"
    }  # fmt: skip


def test_it_is_what_the_reference_gives(recording):
    robot = make(recording.kind)
    robot.wait_for_rows_only()
    found = sensed(robot, recording.log, 512)
    sensors = {name: build("sensor", table) for name, table in SENSORS.items()}
    reference = Reference(robot.odometry, "wheels", {n: (n, s) for n, s in sensors.items()})
    for order, (stream, message) in enumerate(recording.log):
        reference.feed(stream, message, order)
    reference.flush()
    assert len(found) == len(reference.used) > 300
    for (name, motions, sweeps), row in zip(found, reference.used, strict=True):
        assert (name, sweeps.columns.order[0]) == (row.sensor, row.order)
        motion = motions.row(0)
        assert motion.stamp == sweeps.middles[0] == row.motion.stamp
        assert motion.duration == pytest.approx(row.motion.duration, abs=1e-12)
        for a, b in (
            (motion.d_pose, row.motion.d_pose),
            (motion.covariance, row.motion.covariance),
            (sweeps.twists[0], row.twist),
            (sweeps.T_middle_stamp[0], row.T_middle_stamp),
            (sweeps.stamp_covariance[0], row.stamp_covariance),
        ):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


# --------------------------------------------------------------------------- two lidars


def test_two_lidars_see_one_world_from_two_mounts():
    """Points of both, carried by the exact wheels to the start, lie on the walls of the room."""
    log = two_lidars()
    robot = Robot(
        "two",
        build("odometry", {"kind": "encoders", **ODOMETRY["encoders"]}),
        {"front": Lidar2D(stream="front", mount=(0.1, 0.0, 0.0)),
         "rear": Lidar2D(stream="rear", mount=(-0.15, 0.05, math.pi), upside_down=True)},
    )  # fmt: skip
    pose, seen = np.array(load_world("room").robot.start), {"front": 0, "rear": 0}
    walls = [(wall.start, wall.end) for wall in load_world("room").walls]
    for name, motions, sweeps in sensed(robot, log, 64):
        pose = compose(pose, motions.d_pose[0])
        scan = sweeps.scan(0)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        points = scan.points[scan.valid] @ np.array([[c, s], [-s, c]]) + pose[:2]
        away = np.min([distances(points, *map(np.array, wall)) for wall in walls], axis=0)
        assert np.median(away) < 1e-9
        seen[name] += 1
    assert min(seen.values()) > 50


def distances(points, a, b):
    along = (b - a) / np.hypot(*(b - a))
    return np.abs((points - a) @ np.array([-along[1], along[0]]))


def two_lidars():
    """Return a noiseless drive in a room without cylinders, with a lidar at each end."""
    world = load_world("room").model_copy(update={"cylinders": ()})
    log = []
    for stream, mount in (("front", (0.1, 0.0, 0.0)), ("rear", (-0.15, 0.05, math.pi))):
        lidar = Lidar.perfect(beam_time=0.0, mount=mount)
        robot = SimulatedRobot(encoders=WheelEncoders.perfect(), lidar=lidar, imu=None)
        messages = list(simulate(world, robot))
        log += [(stream, m) for m in messages if isinstance(m, LaserScan)]
    log = [(s, replace(m, angles=-m.angles) if s == "rear" else m) for s, m in log]
    log += [("wheels", m) for m in messages if isinstance(m, WheelAngles)]
    return sorted(log, key=lambda pair: pair[1].stamp)


# --------------------------------------------------------------------------- streams


def scan(stamp, reach=2.0):
    return LaserScan(stamp, np.linspace(-1.0, 1.0, 5), np.full(5, reach), np.zeros(5))


def lidars(**streams):
    odometry = build("odometry", {"kind": "encoders", **ODOMETRY["encoders"]})
    return Robot("r", odometry, {n: Lidar2D(stream=stream) for n, stream in streams.items()})


@pytest.mark.parametrize("stream", ["", "scan"])
def test_two_sensors_on_one_stream_are_refused_in_one_line(stream):
    with pytest.raises(ConfigError, match=r"sensors\.a and sensors\.b both read") as error:
        lidars(a=stream, b=stream)
    assert "\n" not in str(error.value)
    lidars(a="", b="scan")


def test_a_stream_that_is_not_there_is_named_with_its_near_miss():
    robot = lidars(a="frnt")
    assert robot.streams.wanted == ("frnt",)
    with pytest.raises(
        ConfigError, match=r"sensors\.a\.stream = 'frnt': no such.*'front'"
    ) as error:
        robot.streams.check({"front": True, "odom": True})
    assert "\n" not in str(error.value)
    lidars(a="front", b="").streams.check({"front": True})


def test_a_stream_of_another_kind_is_refused():
    with pytest.raises(ConfigError, match=r"sensors\.a\.stream = 'odom': it contains WheelAngles"):
        lidars(a="odom").sense(single_row("odom", WheelAngles(0.0, 0.0, 0.0), 0))


@pytest.mark.parametrize("size", [1, 10])
@pytest.mark.parametrize(("defaults", "expected"), [({}, "one"), ({LaserScan: "two"}, "two")])
def test_without_a_name_it_is_the_default_or_the_first_that_no_other_names(
    size, defaults, expected
):
    robot = lidars(a="", b="other")
    robot.streams.choose(defaults)
    log = [(name, scan(float(k))) for k in range(3) for name in ("other", "one", "two")]
    found = sensed(robot, log, size)
    read = {(name, sweeps.columns.stream) for name, _, sweeps in found}
    assert read == {("a", expected), ("b", "other")}


# --------------------------------------------------------------------------- waiting, looking ahead


def test_sweeps_come_in_runs_of_one_sensor_in_the_order_of_the_log():
    log = [(name, scan(float(k))) for k, name in enumerate("aabaabbbba")]
    robot = lidars(a="a", b="b")
    (part,) = batches(log)
    found = [*robot.sense(part), *robot.flush()]
    assert [(s.sensor, len(s)) for _, s in found] == [
        ("a", 2),
        ("b", 1),
        ("a", 2),
        ("b", 4),
        ("a", 1),
    ]
    assert [m.stamps.tolist() for m, _ in found] == [s.middles.tolist() for _, s in found]
    assert np.concatenate([s.columns.order for _, s in found]).tolist() == list(range(10))


def test_a_sweep_waits_no_longer_than_its_patience_for_rows_that_nobody_reads():
    robot = lidars(a="")
    robot.wait_for_rows_only()
    assert not list(robot.sense(single_row("scan", scan(1.0), 0)))
    for order in range(1, MAX_WAIT):
        assert not list(robot.sense(single_row("eye", Image(1.0, "jpeg", b""), order)))
        assert robot.pending == 1
    ((_, sweeps),) = robot.sense(single_row("eye", Image(1.0, "jpeg", b""), MAX_WAIT))
    assert sweeps.columns.stamps.tolist() == [1.0]
    assert robot.pending == 0


def test_a_flush_is_not_the_end():
    """A live robot uses sweeps whose odometry does not come; then it goes on."""
    robot = lidars(a="")
    robot.sense(single_row("scan", scan(1.0), 0))
    assert [s.middles.tolist() for _, s in robot.flush()] == [[1.0]]
    robot.sense(single_row("wheels", WheelAngles(1.0, 0.0, 0.0), 1))
    robot.sense(single_row("scan", scan(1.5), 2))
    ((motions, _),) = robot.sense(single_row("wheels", WheelAngles(2.0, 10.0, 10.0), 3))
    np.testing.assert_allclose(motions.d_pose, [[0.3175, 0.0, 0.0]])
    np.testing.assert_allclose(robot.ahead().d_pose, [0.3175, 0.0, 0.0])
    np.testing.assert_allclose(robot.ahead().d_pose, [0.3175, 0.0, 0.0])
    assert robot.ahead().stamp == 2.0


def test_ahead_is_stamped_by_the_odometrys_own_clock():
    robot = lidars(a="")
    for order, stamp in enumerate((1000.0, 1000.1, 400.0, 400.1)):
        robot.sense(single_row("wheels", WheelAngles(stamp, 10.0 * order, 10.0 * order), order))
    assert robot.ahead().stamp == pytest.approx(400.1)
    assert robot.problems.counts == {"clock step": 1}
    assert "(wheels); motion is kept in file order" in robot.problems.examples["clock step"]


def test_scans_without_a_valid_beam_are_counted_and_used():
    robot = lidars(a="")
    log = [("scan", scan(float(k), reach=0.0 if k in {2, 3} else 1.0)) for k in range(5)]
    assert len(sensed(robot, log, 10)) == 5
    assert robot.problems.counts == {"scan without valid beams": 2}
    example = robot.problems.examples["scan without valid beams"]
    assert example.startswith("the scan at 2.000 s has no valid range; the pose is dead-reckoned")


def test_a_robot_has_seen_something_with_one_valid_beam_or_another_sensor():
    robot = lidars(a="")
    sensed(robot, [("scan", scan(float(k), reach=0.0)) for k in range(5)], 2)
    assert not robot.has_seen
    sensed(robot, [("scan", scan(5.0))], 2)
    assert robot.has_seen
    robot = Robot("r", lidars().odometry, {"camera": RangeBearing()})
    one = np.ones(1)
    sensed(robot, [("camera", Detections(0.0, one, one, np.array([1]), one))], 2)
    assert robot.has_seen


def test_detections_are_looked_at_where_they_are_asked_for():
    robot = Robot("r", lidars().odometry, {"camera": RangeBearing()})
    nan = np.full(1, math.nan)
    log = [
        ("camera", Detections(float(k), np.full(1, r), np.zeros(1), np.array([k]), nan))
        for k, r in enumerate((1.0, math.nan, 3.0))
    ]
    found = sensed(robot, log, 10)
    assert [sweeps.columns["labels"].tolist() for _, _, sweeps in found] == [[[0]], [[2]]]
    assert robot.problems.counts == {"scan": 1}
    (seen,) = robot.observe(found[1][2], 0, np.random.default_rng(0))
    assert (seen.label, seen.z.tolist()) == (2, [3.0, 0.0])
