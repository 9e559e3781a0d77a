"""What the lidar reads: exact on the walls without faults, of the stated statistics with them."""

import math

import numpy as np
import pytest

from impslam.geometry.se2 import compose, transform
from impslam.simulation.drive import drive
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.robot import Lidar, SimulatedRobot
from impslam.simulation.scene import Scene, distance_to_segments
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world, parse_world
from impslam.types import LaserScan

FACING = """
[robot]
waypoints = [[0.5, 0.0]]
limit = 30.0
rest = 29.0
[[walls]]
name = "ahead"
start = [{x}, -9.0]
end = [{x}, 9.0]
"""


def standing(distance: float, seed: int = 0, text: str = "", **faults: float) -> LidarSimulator:
    """A lidar that stands this far from a wall that it faces."""
    world = parse_world(FACING.format(x=distance) + text, "w.toml")
    lidar = Lidar.perfect(**{"mount": (0.0, 0.0, 0.0), **faults})
    return LidarSimulator(lidar, Scene(world), drive(world.robot), np.random.default_rng(seed))


def gaps_to_world(name: str, robot: SimulatedRobot, every: int) -> np.ndarray:
    """Distance of each beam's end from the world, placed by the true pose at its own time."""
    world = load_world(name)
    scene, way = Scene(world), drive(world.robot)
    scans = [m for m in simulate(world, robot, 1) if isinstance(m, LaserScan)][::every]
    assert len(scans) >= 10
    gaps = []
    for scan in scans:
        begin = scan.stamp - robot.start_time
        poses = way.at(begin + scan.time_offsets)
        for i in np.flatnonzero(scan.ranges > 0.0)[::7]:
            laser = compose(poses[i], np.array(robot.lidar.mount))
            beam = scan.ranges[i] * np.array([[math.cos(scan.angles[i]), math.sin(scan.angles[i])]])
            point = transform(laser, beam)[0]
            straight = distance_to_segments(point, scene.segments).min()
            rings = np.abs(np.hypot(*(scene.circles[:, :2] - point).T) - scene.circles[:, 2])
            gaps.append(min(straight, rings.min()))
    return np.array(gaps)


def test_noiseless_beams_end_on_the_world_though_the_robot_moves_during_the_scan():
    assert gaps_to_world("room", SimulatedRobot.perfect(), 7).max() < 1e-9


def test_beams_of_an_inclined_clockwise_lidar_end_on_the_world():
    lidar = Lidar.perfect(mount=(-0.1, 0.05, 2.0), angle_min=2.0, angle_step=-0.01, beams=400)
    robot = SimulatedRobot(lidar=lidar, encoders=None, imu=None)
    assert gaps_to_world("arena", robot, 60).max() < 1e-9


def test_motion_during_the_scan_matters():
    """Placed by the pose at the stamp alone, beams miss the walls by centimetres."""
    world, robot = load_world("arena"), SimulatedRobot.perfect()
    way = drive(world.robot)
    turning = np.abs(way.twists[::10, 1]).argmax() * 0.1
    scans = [m for m in simulate(world, robot) if isinstance(m, LaserScan)]
    scan = min(scans, key=lambda scan: abs(scan.stamp - robot.start_time - turning))
    laser = compose(way.at(np.array([scan.stamp - robot.start_time]))[0], np.array([0.15, 0, 0]))
    seen = scan.ranges > 0
    directions = np.column_stack([np.cos(scan.angles), np.sin(scan.angles)])
    points = transform(laser, scan.ranges[seen, None] * directions[seen])
    segments = Scene(world).segments
    off = [distance_to_segments(point, segments).min() for point in points]
    assert np.percentile(off, 90) > 0.01


def test_beams_are_those_of_the_urg_04lx():
    lidar = Lidar()
    simulator = standing(2.0)
    assert len(simulator.angles) == 682
    assert simulator.angles[0] == pytest.approx(-2.0862, abs=1e-4)
    assert simulator.angles[-1] == pytest.approx(2.0924, abs=1e-4)
    assert simulator.angles[340] == pytest.approx(0.0, abs=1e-12)
    assert simulator.duration == pytest.approx(681 * 97.66e-6)
    assert (lidar.range_min, lidar.range_max, lidar.no_return) == (0.02, 5.6, 0.0)


@pytest.mark.parametrize("distance", [0.5, 2.0, 5.0])
def test_range_noise_grows_with_range(distance):
    simulator = standing(distance, sigma=0.004, sigma_rate=0.002)
    read = np.array([simulator.ranges(k / 10)[340] for k in range(280)])
    expected = 0.004 + 0.002 * distance
    assert read.std() == pytest.approx(expected, rel=0.15)
    assert read.mean() == pytest.approx(distance, abs=4 * expected / math.sqrt(280))


def test_bias_is_shared_by_all_beams_and_scans_of_a_run():
    errors = []
    for seed in range(200):
        simulator = standing(2.0, seed, bias_sigma=0.01)
        first, later = (simulator.ranges(t)[300:380] for t in (0.0, 3.0))
        exact = 2.0 / np.cos(simulator.angles[300:380])
        np.testing.assert_allclose(first - exact, (later - exact)[0], atol=1e-9)
        errors.append(first[0] - exact[0])
    assert np.std(errors) == pytest.approx(0.01, rel=0.2)


def test_ranges_are_multiples_of_the_resolution():
    read = standing(2.0, sigma=0.003, resolution=0.001).ranges(0.0) * 1000
    np.testing.assert_allclose(read, np.round(read), atol=1e-9)


def test_limits_read_as_no_return():
    assert standing(5.61).ranges(0.0)[340] == 0.0
    assert standing(5.59).ranges(0.0)[340] == pytest.approx(5.59)
    assert standing(0.019).ranges(0.0)[340] == 0.0
    assert standing(0.021).ranges(0.0)[340] == pytest.approx(0.021)
    assert math.isnan(standing(9.0, no_return=math.nan).ranges(0.0)[340])


def test_grazing_beams_are_lost():
    simulator = standing(0.3, grazing=math.radians(80))
    read = simulator.ranges(0.0)
    lost = np.abs(simulator.angles) > math.radians(80)
    assert (read[lost] == 0.0).all()
    assert (read[~lost] > 0.0).all()


def test_dropout_rate():
    simulator = standing(1.0, dropout=0.1)
    ahead = np.abs(simulator.angles) < 1.2
    lost = np.array([simulator.ranges(k / 10)[ahead] == 0.0 for k in range(100)])
    assert lost.mean() == pytest.approx(0.1, rel=0.1)


POST = "[[boxes]]\ncentre = [1.5, 0.5]\nsize = [0.4, 1.0]\n"


def test_wide_beams_mix_at_edges_only_and_between_both_surfaces():
    sharp = standing(3.0, text=POST).ranges(0.0)
    wide = standing(3.0, text=POST, divergence=0.02).ranges(0.0)
    changed = np.flatnonzero(np.abs(wide - sharp) > 0.02)
    assert 1 <= len(changed) <= 8
    for i in changed:
        around = sharp[i - 4 : i + 5]
        assert around.min() - 0.01 < wide[i] < around.max() + 0.01
    unchanged = np.abs(np.diff(sharp, prepend=sharp[0])) < 0.01
    unchanged &= np.abs(np.diff(sharp, append=sharp[-1])) < 0.01
    np.testing.assert_array_equal(wide[unchanged], sharp[unchanged])


def test_door_and_person_appear_at_their_time():
    text = """
[[doors]]
wall = "ahead"
at = 8.5
width = 1.0
recess = 0.1
open = [[10.0, 20.0]]
room = [4.0, 2.0]
[[people]]
waypoints = [[1.0, 5.0], [1.0, -5.0]]
start = 22.0
speed = 1.0
leg_spacing = 0.0
"""
    simulator = standing(2.0, text=text)
    ahead = {t: simulator.ranges(t)[340] for t in (5.0, 15.0, 21.0 + 2.0)}
    assert ahead[5.0] == pytest.approx(2.1)
    assert ahead[15.0] == pytest.approx(4.1)
    assert ahead[23.0] == pytest.approx(2.1)
    passing = np.array([simulator.ranges(t)[340] for t in np.arange(24.0, 29.0, 0.05)])
    assert 0.93 < passing.min() < 1.0
    assert 24.0 + 0.05 * passing.argmin() == pytest.approx(27.0, abs=0.7)
