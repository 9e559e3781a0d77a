"""The lidar: mounts, validity, and de-skewing that is exact for constant twists."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from pydantic import ValidationError
from tests.odometry_steps import stacked

from impslam.columns import Sweeps, single_row
from impslam.extractors.base import Extractor
from impslam.geometry.se2 import compose, exp, inverse, transform
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation import robot as simulated
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.scene import Scene, distance_to_segments
from impslam.simulation.world import load_world
from impslam.types import LaserScan, Observation, Scan

STILL = np.zeros(3)


def sweep(ranges, angles=None, rate=0.0, **limits):
    ranges = np.asarray(ranges, dtype=float)
    n = len(ranges)
    angles = np.linspace(-2.0, 2.0, n) if angles is None else np.asarray(angles, dtype=float)
    return LaserScan(10.0, angles, ranges, rate * np.arange(n), **limits)


def observe(lidar, message, twist=STILL):
    return lidar.scan(message, np.asarray(twist, dtype=float))


@pytest.mark.parametrize("upside_down", [False, True])
def test_mount_carries_points_into_base_link(upside_down):
    mount = (0.2, -0.1, 0.7)
    scan = observe(Lidar2D(mount=mount, upside_down=upside_down), sweep([1.0, 2.0, 3.0]))
    sign = -1.0 if upside_down else 1.0
    angles = sign * np.linspace(-2, 2, 3)
    in_laser = np.array([1.0, 2.0, 3.0])[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    np.testing.assert_allclose(scan.points, transform(np.array(mount), in_laser), atol=1e-12)
    np.testing.assert_allclose(scan.origins, np.tile(mount[:2], (3, 1)))


@pytest.mark.parametrize("mount", [(145.0, 0.0, 0.0), (0.0, -1e5, 0.0)])
def test_a_mount_in_millimetres_or_in_a_map_is_refused(mount):
    with pytest.raises(ValidationError, match="within 20 m of base_link"):
        Lidar2D(mount=mount)


def test_a_laser_upside_down_is_one_that_scans_the_other_way():
    angles, rng = np.linspace(-1.0, 2.0, 40), np.random.default_rng(5)
    ranges, mount = rng.uniform(0.5, 4.0, 40), (0.2, -0.1, 0.7)
    twist = np.array([0.4, 0.0, 1.0])
    turned = Lidar2D(mount=mount, upside_down=True, angle_min=-0.5)
    upright = Lidar2D(mount=mount, angle_max=0.5)
    one = observe(turned, sweep(ranges, angles, rate=1e-3), twist)
    other = observe(upright, sweep(ranges, -angles, rate=1e-3), twist)
    for field in fields(Scan):
        if field.init and (value := getattr(one, field.name)) is not None:
            np.testing.assert_array_equal(value, getattr(other, field.name), err_msg=field.name)


@pytest.mark.parametrize("last_beam_first", [False, True])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    "twist", [[0.5, 0.0, 1.2], [2.8, 0.1, -2.0], [1.0, 0.0, 0.0], [0, 0, 1e-5]]
)
def test_deskew_puts_a_moving_robots_points_where_they_are(twist, direction, last_beam_first):
    """A world of points, each seen at its own time from its own place."""
    rng, twist = np.random.default_rng(1), np.array(twist)
    mount, world = np.array([0.145, 0.02, -0.3]), rng.uniform(-5, 5, (200, 2))
    offsets = 97.66e-6 * np.arange(200)
    middle = 0.5 * offsets[-1]
    angles, ranges = np.empty(200), np.empty(200)
    for i, (point, t) in enumerate(zip(world, offsets, strict=True)):
        seen = transform(inverse(compose(exp((t - middle) * twist), mount)), point[None])[0]
        angles[i], ranges[i] = math.atan2(seen[1], seen[0]), math.hypot(*seen)
    order = slice(None, None, direction)
    given = (offsets[-1] - offsets if last_beam_first else offsets)[order]
    message = LaserScan(0.0, angles[order], ranges[order], given)
    lidar = Lidar2D(mount=tuple(mount), last_beam_first=last_beam_first)
    scan = observe(lidar, message, twist)
    np.testing.assert_allclose(scan.points, world[order], atol=1e-9)
    if np.abs(twist).max() > 0.1:
        for wrong in ({"deskew": False}, {"last_beam_first": not last_beam_first}):
            skewed = observe(lidar.model_copy(update=wrong), message, twist)
            assert np.abs(skewed.points - world[order]).max() > 1e-3


def test_without_deskewing_no_times_of_beams_are_passed_on():
    """Trackers that know the motion better would de-skew by them."""
    message = LaserScan(0.0, np.linspace(-1.0, 1.0, 20), np.full(20, 2.0), 1e-3 * np.arange(20))
    columns = single_row("", message, 0)[""]
    assert Lidar2D().sweeps(columns, np.zeros((1, 3))).after is not None
    assert Lidar2D(deskew=False).sweeps(columns, np.zeros((1, 3))).after is None


class Circle:
    """A drive on a circle."""

    twist = np.array([0.3, 0.0, 1.5])

    def at(self, times):
        return compose(np.array([1.0, 1.0, 0.4]), exp(times[:, None] * self.twist))


@pytest.mark.parametrize("last_beam_first", [False, True])
def test_beams_of_a_turning_drive_end_on_the_walls(last_beam_first):
    """Whichever end of a message was measured first; in the other order, they do not."""
    scene, perfect, path = Scene(load_world("room")), simulated.Lidar.perfect(), Circle()
    simulator = LidarSimulator(perfect, scene, path, np.random.default_rng(0))
    order = slice(None, None, -1 if last_beam_first else 1)
    lidar = Lidar2D(mount=perfect.mount, last_beam_first=last_beam_first)
    other = lidar.model_copy(update={"last_beam_first": not last_beam_first})
    for begin in np.arange(0.0, 4.0, 0.5):
        angles, ranges = simulator.angles[order], simulator.ranges(begin)[order]
        message = LaserScan(begin, angles, ranges, simulator.time_offsets, *simulator.limits)
        middle = path.at(np.array([begin + 0.5 * simulator.duration]))[0]
        right, wrong = (
            distances(observe(one, message, path.twist), middle, scene) for one in (lidar, other)
        )
        assert right.max() < 1e-9
        assert np.median(wrong) > 1e-3


@pytest.mark.parametrize("last_beam_first", [False, True])
def test_a_given_sweep_time_stands_for_that_of_the_messages(last_beam_first):
    twist, told = np.array([0.5, 0.0, 1.2]), sweep(np.linspace(1.0, 3.0, 40), rate=2e-3)
    silent = replace(told, time_offsets=np.zeros(40))
    lidar = Lidar2D(last_beam_first=last_beam_first, latency=0.01)
    given = lidar.model_copy(update={"sweep_time": 39 * 2e-3})
    expected, found = observe(lidar, told, twist), observe(given, silent, twist)
    np.testing.assert_allclose(found.points, expected.points, atol=1e-12)
    np.testing.assert_allclose(given.spans(stacked([silent])), lidar.spans(stacked([told])))


def distances(scan, pose, scene):
    """Return the distances of some of the points of a scan from the world."""
    return np.array(
        [
            min(
                distance_to_segments(point, scene.segments).min(),
                np.abs(np.hypot(*(scene.circles[:, :2] - point).T) - scene.circles[:, 2]).min(),
            )
            for point in transform(pose, scan.points[scan.valid][::20])
        ]
    )


def test_origins_and_directions_lead_to_the_points():
    scan = observe(
        Lidar2D(mount=(0.1, 0, 0.2)), sweep(np.full(50, 2.0), rate=1e-3), np.array([1, 0, 1.0])
    )
    ray = np.stack([np.cos(scan.directions), np.sin(scan.directions)], 1)
    np.testing.assert_allclose(scan.origins + 2.0 * ray, scan.points, atol=1e-12)


def test_invalid_are_zero_nan_inf_negative_codes_and_beyond_limits():
    ranges = [0.0, math.nan, math.inf, -math.inf, -1.0, 0.019, 0.02, 5.599, 5.6, 5.7, 3.0]
    scan = observe(Lidar2D(range_min=0.02, range_max=5.6), sweep(ranges))
    assert scan.valid.tolist() == [False] * 6 + [True, True, False, False, True]
    assert np.isfinite(scan.points).all()


def test_limits_are_the_tighter_of_message_and_config():
    ranges = [0.05, 0.15, 3.0, 4.0]
    lidar = Lidar2D(range_min=0.1)
    assert observe(lidar, sweep(ranges, range_min=0.2, range_max=3.5)).valid.tolist() == [
        False,
        False,
        True,
        False,
    ]
    assert observe(lidar, sweep(ranges)).valid.tolist() == [False, True, True, True]


@pytest.mark.parametrize("limits", [(0.15, 0.0), (0.0, 0.0), (0.5, 0.5), (math.nan, 0.0)])
def test_limits_of_a_message_that_no_range_can_keep_are_unset(limits):
    message = sweep([0.1, 3.0, 13.0], range_min=limits[0], range_max=limits[1])
    assert observe(Lidar2D(), message).valid.tolist() == [True] * 3
    assert observe(Lidar2D(range_max=12.0), message).valid.tolist() == [True, True, False]


def test_the_robots_own_body_is_cut_out():
    lidar = Lidar2D(angle_min=-1.0, angle_max=1.0)
    angles = np.array([-1.5, -0.5, 0.5, 1.5])
    assert observe(lidar, sweep(np.ones(4), angles)).valid.tolist() == [False, True, True, False]
    turned = np.array([0.0, 0.5, 2 * math.pi - 0.5, math.pi])
    assert observe(lidar, sweep(np.ones(4), turned)).valid.tolist() == [True, True, True, False]
    backward = Lidar2D(angle_min=1.0, angle_max=-1.0)
    assert observe(backward, sweep(np.ones(4), angles)).valid.tolist() == [True, False, False, True]


def test_noise_grows_with_range():
    scan = observe(Lidar2D(sigma=0.01, sigma_per_m=0.005), sweep([1.0, 4.0]))
    np.testing.assert_allclose(scan.sigmas, [0.015, 0.03])


def test_scan_lengths_may_change_and_empty_scans_are_not_usable():
    lidar = Lidar2D()
    assert len(observe(lidar, sweep(np.ones(5))).ranges) == 5
    assert len(observe(lidar, sweep(np.ones(9))).ranges) == 9
    assert lidar.usable(stacked([sweep(np.ones(3))] * 2)).tolist() == [True, True]
    assert lidar.usable(stacked([sweep([])])).tolist() == [False]
    assert "has no beams; it is dropped" in lidar.fault(sweep([]))


def test_ranges_are_calibrated_where_they_are_valid():
    scan = observe(Lidar2D(range_scale=1.1, range_offset=-0.2), sweep([0.0, 2.0, 0.1]))
    np.testing.assert_allclose(scan.ranges, [0.0, 2.0, 0.0])
    assert scan.valid.tolist() == [False, True, False]  # no point is behind the laser


def test_angles_are_calibrated_before_their_limits():
    message = LaserScan(0.0, np.array([-1.0, 0.0, 1.0]), np.ones(3), np.zeros(3))
    scan = observe(Lidar2D(angle_scale=0.9, angle_max=0.95), message)
    np.testing.assert_allclose(scan.angles, [-0.9, 0.0, 0.9])
    np.testing.assert_allclose(scan.points[2], [math.cos(0.9), math.sin(0.9)])
    assert scan.valid.tolist() == [True, True, True]


def test_many_sweeps_are_to_the_byte_what_each_is_alone():
    rng = np.random.default_rng(3)
    messages = [sweep(rng.uniform(0.0, 6.0, 40), rate=1e-3, range_max=5.0) for _ in range(9)]
    twists = rng.normal(0.0, [0.5, 0.1, 1.0], (9, 3))
    lidar = Lidar2D(mount=(0.1, 0.2, 0.3), upside_down=True, sigma_per_m=0.01, angle_max=1.5)
    scans = lidar.sweeps(stacked(messages), twists)
    for k, message in enumerate(messages):
        one, other = scans.row(k), lidar.scan(message, twists[k])
        for name in ("ranges", "valid", "points", "directions", "origins", "sigmas"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_columns_of_any_memory_are_taken():
    """Readers hand out views that cannot be written, single precision, and strided ones."""
    ranges = np.linspace(1.0, 2.0, 12).reshape(2, 6).astype(np.float32)
    ranges.setflags(write=False)
    columns = stacked([sweep(row) for row in ranges])
    odd = replace(columns, values={**columns.values, "ranges": ranges[:, ::-1]})
    scans = Lidar2D().sweeps(odd, np.zeros((2, 3)))
    np.testing.assert_array_equal(scans.ranges, ranges[:, ::-1].astype(np.float64))


class Whole(Extractor):
    """Sees one thing, in the last half of the beams."""

    def extract(self, scan, rng):
        del rng
        beams = np.arange(len(scan.ranges) // 2, len(scan.ranges))
        return [Observation("point", np.zeros(2), np.eye(2), beams)]


@pytest.mark.parametrize(("last_beam_first", "way"), [(False, 1.0), (True, -1.0)])
def test_an_observation_has_the_time_of_its_beams(last_beam_first, way):
    lidar = Lidar2D(extractors={"all": Whole()}, last_beam_first=last_beam_first)
    columns = stacked([sweep(np.ones(4), rate=0.01)])
    empty = np.zeros((1, 3))
    scans = lidar.sweeps(columns, empty)
    sweeps = Sweeps("lidar", columns, np.zeros(1), empty, empty, np.zeros((1, 3, 3)), scans)
    (seen,) = lidar.observe(sweeps, 0, np.random.default_rng(0))
    assert seen.delay == pytest.approx(way * (0.025 - 0.015))


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ({"range_max": -3.0}, "at least 0"),
        ({"range_max": 0.0}, "above 0"),
        ({"range_min": -0.1}, "at least 0"),
        ({"range_min": 2.0, "range_max": 1.0}, "above range_min, 2"),
        ({"sweep_time": -0.1}, "at least 0"),
    ],
)
def test_limits_that_no_range_can_keep_are_refused(limits, told):
    with pytest.raises(ValidationError, match=told):
        Lidar2D(**limits)
    assert Lidar2D(range_min=math.nan, range_max=5.6).range_max == 5.6
