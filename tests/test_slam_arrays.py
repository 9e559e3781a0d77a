"""SLAM on arrays: the same map however they are cut, and one line for each wrong argument."""

import math
from itertools import pairwise

import numpy as np
import pytest

import impslam
from impslam.config import load
from impslam.errors import ConfigError, ImpError, ShapeError
from impslam.odometry.synchroniser import MAX_WAIT

ANGLES = np.radians(np.arange(-180, 180))
STAMPS = 0.1 * np.arange(60)
HEADINGS = 0.02 * np.arange(60)
POSES = np.column_stack([np.zeros((60, 2)), HEADINGS])
TWO = """
[sensors.front]
kind = "lidar2d"
stream = "front"
extractors.walls.kind = "split_merge"
[sensors.rear]
kind = "lidar2d"
stream = "rear"
mount = [-0.3, 0.0, 3.141592653589793]
extractors.walls.kind = "split_merge"
"""


def square(angles, headings, x=0.0):
    """Return the ranges (m, n) in a square room of 4 m, of a lidar at x m ahead of its centre."""
    facing = angles + np.asarray(headings)[:, None]
    at = x * np.stack([np.cos(headings), np.sin(headings)])[..., None]
    c, s = np.cos(facing), np.sin(facing)
    with np.errstate(divide="ignore"):
        return np.minimum((2.0 - at[0] * np.sign(c)) / abs(c), (2.0 - at[1] * np.sign(s)) / abs(s))


RANGES = square(ANGLES, HEADINGS)


def cut(sizes):
    """Return the bytes of the map of a turn on the spot that is given in pieces."""
    slam, begin = impslam.Slam("default"), 0
    for size in sizes:
        part = slice(begin, begin + size)
        slam.add_odometry(STAMPS[part], POSES[part])
        slam.add_scans(STAMPS[part], RANGES[part], ANGLES, range_max=10.0)
        begin += size
    assert begin == 60
    return slam.finish()


def same(one, two, tmp_path):
    files = [known.save(tmp_path / f"{k}.imp").read_bytes() for k, known in enumerate([one, two])]
    return files[0] == files[1]


@pytest.mark.parametrize("sizes", [[1] * 60, [7] * 8 + [4], [1, 59], [59, 1]])
def test_any_cutting_gives_the_same_map_to_the_byte(sizes, tmp_path):
    assert same(cut(sizes), cut([60]), tmp_path)


def test_scalars_and_lists_are_arrays(tmp_path):
    slam = impslam.Slam("default")
    for k in range(60):
        slam.add_odometry(float(STAMPS[k]), POSES[k].tolist())
        slam.add_scans(float(STAMPS[k]), RANGES[k].tolist(), ANGLES.tolist(), range_max=10)
    assert same(slam.finish(), cut([60]), tmp_path)


def test_the_map_is_that_of_the_room():
    known = cut([60])
    np.testing.assert_allclose(known.path(), np.column_stack([STAMPS, POSES]), atol=1e-3)
    feet = np.array([mark.position for mark in known.landmarks if mark.kind == "wall"])
    for foot in [(2, 0), (-2, 0), (0, 2), (0, -2)]:
        assert np.abs(feet - foot).max(axis=1).min() < 1e-3  # normals near corners are rounded
    count = len(known.keyframes)
    assert repr(known) == f"<Map: 60 scans, {count} keyframes, {len(known.landmarks)} landmarks>"


@pytest.mark.parametrize("kind", ["encoders", "velocity"])
def test_wheels_and_velocities_tell_the_same_turn(kind):
    base = "imp" if kind == "encoders" else "default"
    slam = impslam.Slam(base, [] if kind == "encoders" else [f"odometry.kind={kind}"])
    if kind == "encoders":
        made = load("imp").make_robot().odometry
        way = HEADINGS * made.track / 2.0 / made.wheel_radius
        slam.add_wheels(STAMPS, -way, way)
    else:
        slam.add_velocities(STAMPS, np.zeros(60), np.full(60, 0.2))
    slam.add_scans(STAMPS, RANGES, ANGLES, range_max=10.0)
    known = slam.finish()
    assert len(known.path()) == 60
    np.testing.assert_allclose(known.odometry()[:, 3], HEADINGS, atol=1e-9)


def two_lidars(tmp_path):
    config = tmp_path / "two.toml"
    config.write_text('robot = "two"\n' + TWO + BACK_END)
    return config


BACK_END = """
[odometry]
kind = "odometry_pose"
[association]
kind = "mahalanobis"
[lifecycle]
kind = "tentative"
[filter]
kind = "ekf"
"""


AHEAD = np.radians(np.arange(-89, 90))
FRONT = square(AHEAD, HEADINGS)
REAR = square(AHEAD + math.pi, HEADINGS, x=-0.3)
"""Each lidar sees half of the room, and what the rear one sees lies behind."""


def test_two_lidars_are_told_apart_by_stream(tmp_path):
    slam = impslam.Slam(two_lidars(tmp_path))
    slam.add_odometry(STAMPS, POSES)
    for k in range(60):
        slam.add_scans(STAMPS[k], FRONT[k], AHEAD, stream="front")
        slam.add_scans(STAMPS[k], REAR[k], AHEAD, stream="rear")
    known = slam.finish()
    truth = np.column_stack([STAMPS, POSES]).repeat(2, axis=0)
    np.testing.assert_allclose(known.path(), truth, atol=1e-9)
    feet = np.array([mark.position for mark in known.landmarks])
    assert len(feet) == 4
    for foot in [(2, 0), (-2, 0), (0, 2), (0, -2)]:
        assert np.abs(feet - foot).max(axis=1).min() < 1e-3  # normals near corners are rounded


def test_all_of_one_lidar_before_the_other_is_refused(tmp_path):
    """The motion is used up by then: the rear lidar's scans would all be at one place."""
    slam = impslam.Slam(two_lidars(tmp_path))
    slam.add_odometry(STAMPS, POSES)
    slam.add_scans(STAMPS, FRONT, AHEAD, stream="front")
    with pytest.raises(ImpError, match=r"rear: 60 rows from 0.000 s on .* 5.900 s; .* in turns"):
        slam.add_scans(STAMPS, REAR, AHEAD, stream="rear")


def test_odometry_that_comes_after_its_scans_are_used_is_refused():
    slam = impslam.Slam("default")
    slam.add_scans(STAMPS, RANGES, ANGLES)
    with pytest.raises(
        ImpError, match=r"OdometryPose: 60 rows from 0.000 s on .* add rows in order"
    ):
        slam.add_odometry(STAMPS, POSES)


def test_a_scan_waits_for_as_many_rows_as_the_documentation_says():
    assert f"for the next {MAX_WAIT} rows of any stream" in " ".join(impslam.Slam.__doc__.split())
    for more in (MAX_WAIT - 1, MAX_WAIT):
        slam = impslam.Slam("default")
        slam.add_scans(STAMPS[: 1 + more], RANGES[: 1 + more], ANGLES)
        assert (len(slam.map().stamps) > 0) == (more == MAX_WAIT)
    with pytest.raises(ImpError, match=rf"waits for odometry for the next {MAX_WAIT} rows only"):
        slam.add_odometry(STAMPS - 1.0, POSES)


@pytest.mark.parametrize(
    ("odometry", "scans", "missing"), [(0, 60, 60), (0, 3, 3), (40, 60, 1), (55, 60, 0), (1, 1, 0)]
)
def test_scans_that_are_used_without_odometry_are_reported(odometry, scans, missing):
    slam = impslam.Slam("default")
    slam.add_odometry(STAMPS[:odometry], POSES[:odometry])
    slam.add_scans(STAMPS[:scans], RANGES[:scans], ANGLES)
    assert len(slam.finish().path()) == scans
    assert slam.problems == ({"odometry missing": missing} if missing else {})


def test_without_odometry_in_the_config_none_is_missing():
    slam = impslam.Slam("default", ["odometry.kind=lidar_only"])
    slam.add_scans(STAMPS, RANGES, ANGLES)
    slam.finish()
    assert slam.problems == {}


def test_a_clock_that_is_set_back_is_none_of_that(tmp_path):
    slam = impslam.Slam(two_lidars(tmp_path))
    for shift in (100.0, 0.0):
        for part in (slice(0, 5), slice(5, 10)):
            stamps = STAMPS[part] + shift
            slam.add_odometry(stamps, POSES[part])
            for k, stamp in enumerate(stamps):
                slam.add_scans([stamp], FRONT[part][k : k + 1], AHEAD, stream="front")
                slam.add_scans([stamp], REAR[part][k : k + 1], AHEAD, stream="rear")
    assert len(slam.finish().path()) == 40
    assert slam.problems["clock step"] == 3


@pytest.mark.parametrize("stream", ["", "raer"])
def test_scans_that_no_sensor_reads_are_refused(tmp_path, stream):
    slam = impslam.Slam(two_lidars(tmp_path))
    with pytest.raises(ConfigError, match=r"sensors\.rear\.stream = 'rear'") as error:
        slam.add_scans(STAMPS, RANGES, ANGLES, stream=stream)
    assert "\n" not in str(error.value)


def test_a_second_stream_without_a_sensor_is_refused():
    slam = impslam.Slam("default")
    slam.add_odometry(STAMPS, POSES)
    slam.add_scans(STAMPS[:1], RANGES[:1], ANGLES, stream="front")
    with pytest.raises(ConfigError, match=r"'rear'; there is sensors\.lidar\.stream = 'front'"):
        slam.add_scans(STAMPS[:1], RANGES[:1], ANGLES, stream="rear")


def test_what_the_caller_does_with_its_arrays_later_changes_nothing(tmp_path):
    """One buffer for all scans, as a driver has it; scans wait for odometry meanwhile."""
    slam, ranges, pose = impslam.Slam("default"), np.empty(360), np.empty(3)
    angles = ANGLES.copy()
    for k in range(0, 60, 10):
        for i in range(k, k + 10):
            ranges[:], angles[:] = RANGES[i], ANGLES
            slam.add_scans(STAMPS[i], ranges, angles, range_max=10.0)
            ranges[:], angles[:] = 1.0, 0.0
        for i in range(k, k + 10):
            pose[:] = POSES[i]
            slam.add_odometry(STAMPS[i], pose)
            pose[:] = 9.0
    assert same(slam.finish(), cut([60]), tmp_path)


def test_pose_and_map_at_any_time():
    slam = impslam.Slam("default", ["start=[1.0, 2.0, 0.5]"])
    np.testing.assert_array_equal(slam.pose, [1.0, 2.0, 0.5])
    np.testing.assert_array_equal(slam.covariance, np.zeros((3, 3)))
    assert slam.map().path().shape == (0, 4)
    slam.add_odometry(STAMPS[:30], POSES[:30])
    slam.add_scans(STAMPS[:30], RANGES[:30], ANGLES)
    early, rows = slam.map(), slam.map().path().copy()
    pose = slam.pose
    assert pose[2] > 0.9
    assert np.linalg.eigvalsh(slam.covariance)[0] > 0.0
    slam.add_odometry(STAMPS[30:], POSES[30:])
    slam.add_scans(STAMPS[30:], RANGES[30:], ANGLES)
    np.testing.assert_array_equal(early.path(), rows)
    assert slam.pose[2] > pose[2]
    pose[:] = 0.0
    assert slam.pose[2] > 1.5
    assert len(slam.finish().path()) == 60


def test_progress_is_told_and_never_falls():
    told = []
    slam = impslam.Slam("default", progress=told.append)
    for k in range(0, 60, 20):
        slam.add_odometry(STAMPS[k : k + 20], POSES[k : k + 20])
        assert told == sorted(told)
        slam.add_scans(STAMPS[k : k + 20], RANGES[k : k + 20], ANGLES)
    slam.finish()
    assert told[-1] == 60
    assert all(a < b for a, b in pairwise(told))


def test_rows_that_cannot_be_used_are_counted():
    slam = impslam.Slam("default")
    poses = POSES.copy()
    poses[5] = math.nan
    slam.add_odometry(STAMPS, poses)
    slam.add_scans(STAMPS, np.zeros_like(RANGES), ANGLES)
    slam.finish()
    assert slam.problems["odometry"] == 1
    assert slam.problems["scan without valid beams"] == 60


def test_nothing_is_nothing():
    slam = impslam.Slam("default")
    slam.add_odometry([], [])
    slam.add_odometry(np.empty(0), np.empty((0, 3)))
    slam.add_scans([], [], ANGLES)
    slam.add_scans([], np.empty((0, 360)), ANGLES)
    known = slam.finish()
    assert known.path().shape == known.live_path().shape == known.odometry().shape == (0, 4)
    assert known.landmarks == ()
    assert known.grid().logodds.size == 0


GOOD = {"stamps": 0.0, "poses": [0.0, 0.0, 0.0]}
BAD_ODOMETRY = [
    ({"stamps": "abc"}, "stamps: 'abc' is of type <U3; give numbers"),
    ({"stamps": "1.0"}, "stamps"),
    ({"stamps": None}, "stamps: None is of type object; give numbers, NaN for missing ones"),
    ({"stamps": [1.0, None]}, "stamps"),
    ({"stamps": np.array(["2026-01-01"], "M8[s]")}, "stamps"),
    ({"stamps": [[0.0]]}, "stamps has shape (1, 1); expected (any,)"),
    ({"stamps": math.nan}, "stamps[0] is nan; give finite numbers"),
    ({"stamps": [0.0, math.inf]}, "stamps[1] is inf; give finite numbers"),
    ({"poses": None}, "poses: None is of type object"),
    ({"poses": [0.0, 0.0]}, "poses has shape (1, 2); expected (1, 3)"),
    ({"poses": 1.0}, "poses has shape (); expected (1, 3)"),
    ({"poses": [[0.0, 0.0, 0.0]] * 2}, "poses has shape (2, 3); expected (1, 3)"),
    ({"stamps": [0.0, 1.0]}, "poses has shape (3,); expected (2, 3)"),
    ({"stamps": []}, "poses has shape (3,); expected (0, 3)"),
    ({"stamps": [0.0, 1.0], "poses": [[0.0] * 3, [0.0]]}, "poses: rows of different lengths"),
    ({"poses": ["a", "b", "c"]}, "poses"),
    ({"poses": [1j, 0, 0]}, "poses"),
]


@pytest.mark.parametrize(("wrong", "said"), BAD_ODOMETRY)
def test_wrong_odometry_is_refused_in_one_line(wrong, said):
    refuses(lambda slam: slam.add_odometry(**{**GOOD, **wrong}), said)


BAD_SCANS = [
    ({"ranges": RANGES[0][:5]}, "ranges has shape (1, 5); expected (1, 360)"),
    ({"ranges": RANGES}, "ranges has shape (60, 360); expected (1, 360)"),
    ({"ranges": [None] * 360}, "NaN for missing ones"),
    ({"ranges": "far"}, "ranges: 'far'"),
    ({"angles": ANGLES[None]}, "angles has shape (1, 360); expected (any,)"),
    ({"angles": None}, "angles: None"),
    ({"angles": np.full(360, math.nan)}, "angles[0] is nan; give finite numbers"),
    ({"time_offsets": [0.0, 0.1]}, "time_offsets has shape (2,); expected (360,)"),
    ({"time_offsets": np.full(360, math.inf)}, "time_offsets[0] is inf"),
    ({"time_offsets": "a"}, "time_offsets: 'a'"),
    ({"range_min": None}, "range_min: None"),
    ({"range_max": "far"}, "range_max: 'far'"),
    ({"range_max": [1.0, 2.0]}, "range_max has shape (2,); expected ()"),
]


@pytest.mark.parametrize(
    ("low", "high"), [(5.0, 1.0), (2.0, 2.0), (math.nan, -3.0), (-1.0, math.nan)]
)
def test_limits_that_no_range_can_keep_are_refused(low, high):
    with pytest.raises(ConfigError, match=r"range_min = .*: no range is between them"):
        impslam.Slam().add_scans(0.0, RANGES[0], ANGLES, range_min=low, range_max=high)


def test_angles_in_degrees_are_refused():
    with pytest.raises(ConfigError, match=r"angles: they span 57 turns; give them in rad"):
        impslam.Slam().add_scans(0.0, RANGES[0], np.degrees(ANGLES))


def test_masked_ranges_are_no_echo_and_other_masked_values_are_refused(tmp_path):
    hidden = np.ma.masked_array(RANGES, mask=RANGES > 2.2)
    maps = []
    for ranges in (hidden, hidden.filled(math.nan)):
        slam = impslam.Slam()
        slam.add_odometry(STAMPS, POSES)
        slam.add_scans(STAMPS, ranges, ANGLES)
        maps.append(slam.finish())
    assert same(*maps, tmp_path)
    poses = np.ma.masked_array(np.zeros(1), mask=[True])
    refuses(lambda slam: slam.add_odometry(poses, [0.0, 0.0, 0.0]), "stamps[0] is nan")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"known": 3}, "known = 3: expected a Map, or the path of its file"),
        ({"known": "a.imp", "hint": "a"}, "'a' is not a pose in a map"),
        ({"known": "a.imp", "hint": [1.0, None]}, "[1.0, None] is not a pose in a map"),
        ({"observers": 3}, "observers = 3: expected a list of Observer"),
        ({"observers": [3]}, "observers = [3]: expected a list of Observer"),
    ],
)
def test_wrong_options_are_refused_in_one_line(options, said):
    with pytest.raises(ConfigError) as error:
        impslam.Slam("default", **options)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("wrong", "said"), BAD_SCANS)
def test_wrong_scans_are_refused_in_one_line(wrong, said):
    good = {"stamps": 0.0, "ranges": RANGES[0], "angles": ANGLES}
    refuses(lambda slam: slam.add_scans(**{**good, **wrong}), said)


@pytest.mark.parametrize(
    ("config", "add", "said"),
    [
        ("default", lambda s: s.add_wheels(0, 1, 2), "does not use WheelAngles, but LaserScan"),
        ("default", lambda s: s.add_velocities(0, 1, 2), "does not use Velocity"),
        ("imp", lambda s: s.add_odometry(0, [0, 0, 0]), "does not use OdometryPose"),
        ("mrclam", lambda s: s.add_scans(0, RANGES[0], ANGLES), "does not use LaserScan"),
    ],
)
def test_what_the_config_has_no_use_for_is_refused(config, add, said):
    with pytest.raises(ConfigError, match=said) as error:
        add(impslam.Slam(config))
    assert "\n" not in str(error.value)


def refuses(add, said):
    """A wrong call says what is wrong, and leaves nothing behind."""
    slam = impslam.Slam("default")
    with pytest.raises(ShapeError) as error:
        add(slam)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 150
    slam.add_odometry(STAMPS[:2], POSES[:2])
    slam.add_scans(STAMPS[:2], RANGES[:2], ANGLES)
    assert len(slam.finish().path()) == 2
    assert slam.problems == {}


@pytest.mark.parametrize(
    ("config", "settings", "said"),
    [
        ("defualt", [], "did you mean 'default'?"),
        (None, [], "config = None: expected a preset's name or a file"),
        (3, [], "config = 3: expected a preset's name or a file"),
        ("default", "seed=1", "settings = 'seed=1': expected a list"),
        ("default", [1], "settings = [1]: expected a list"),
        ("default", ["seed"], "expected key=value"),
        ("default", ["sede=1"], "did you mean 'seed'?"),
        (load("default"), ["seed=1"], "settings apply to a preset or a file"),
    ],
)
def test_a_wrong_config_is_refused_in_one_line(config, settings, said):
    with pytest.raises(ConfigError) as error:
        impslam.Slam(config, settings)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("resolution", [0, -1, math.nan, math.inf, 1e-9, "fine", None])
def test_a_grid_of_no_size_is_refused(resolution):
    with pytest.raises(ConfigError, match=r"a cell's side is 0.001 to 10 m"):
        impslam.Slam("default").map().grid(resolution)
