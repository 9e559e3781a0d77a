"""Frames of ROS logs that are wrong: each said in one line, and nothing false used."""

import dataclasses
import math

import numpy as np
import pytest
from tests.sources.ros_robots import URDF, Laser, Recipe, Types, drive, write

from impslam import columns
from impslam.cli import main
from impslam.config_from_log import choices
from impslam.errors import SourceError
from impslam.open_log import open_log
from impslam.simulation.world import load_world
from impslam.sources.rosbag import RosBag
from impslam.types import LaserScan, OdometryPose

T = Types(ros1=False)
STAMP = Recipe().start


@pytest.fixture(scope="module")
def entries():
    """A second of a drive with odometry in /tf, without static transforms."""
    found, _ = drive(load_world("room"), Recipe(static=()))
    return [entry for entry in found if entry[0] < 1.0]


def bag(path, entries, *static):
    """Write the drive with these messages in /tf_static, at these times."""
    more = [(time, "/tf_static", message) for time, message in static]
    return write(path / "bag", Recipe(), sorted([*more, *entries], key=lambda entry: entry[0]))


def links(*ways):
    return 0.0, T.links(STAMP, ways)


def moving(*messages):
    """Return messages of /tf, at these times."""
    return [(time, "/tf", message) for time, message in messages]


def read(log):
    """Return what is read of a log with the mounts that TF gives, and what is wrong with it."""
    config, source = open_log(log)
    with source:
        found = list(columns.messages(source.batches()))
    return found, source.problems, choices(config, source)


ZERO = [0, 0, 0]


@pytest.mark.parametrize(
    ("ways", "said"),
    [
        ([], "there is no transform to laser"),
        ([URDF[0], ("mast", "laser", ZERO, ZERO)], "laser leads up to mast, not to base_footprint"),
        (
            [("mast", "laser", ZERO, ZERO), ("laser", "mast", ZERO, ZERO)],
            "form a loop: laser -> mast",
        ),
    ],
)
def test_an_unknown_mount_is_reported(entries, tmp_path, ways, said):
    found, problems, line = read(bag(tmp_path, entries, *([links(*ways)] if ways else [])))
    assert "mount unknown, assumed to be at base_link" in line
    assert said in line
    assert "set sensors.lidar.mount" in line
    assert sum(isinstance(m, LaserScan) for m in found) == 10
    assert problems.counts == {"unknown mount": 1}


def test_a_transform_that_is_published_too_late_is_not_denied(entries, tmp_path):
    late = moving((40.0, T.links(STAMP, URDF)))
    line = read(bag(tmp_path, [*entries, *late]))[2]
    assert "there is no transform to laser in the first 30 s of /tf; set sensors" in line


@pytest.mark.parametrize(
    ("values", "said"), [((0, 0, 0, 2.0), "length 2"), ((0, 0, math.nan, 1), "not finite")]
)
def test_an_invalid_transform_is_left_out(entries, tmp_path, values, said):
    message = T.links(STAMP, URDF)
    message.transforms[1].transform.rotation = T.new(
        "geometry_msgs/msg/Quaternion", *map(float, values)
    )
    line = read(bag(tmp_path, entries, (0.0, message)))[2]
    assert "the transform base_link -> laser is not valid: " in line
    assert said in line


def test_scans_are_dropped_while_the_mount_differs(entries, tmp_path):
    moved = ("base_link", "laser", [0.1, 0.15, 0.1], ZERO)
    changes = moving(links(*URDF), (0.35, T.links(STAMP, [moved])), (0.65, T.links(STAMP, URDF)))
    found, problems, line = read(bag(tmp_path, [*entries, *changes]))
    assert "mount [0.100 m, 0.050 m, 0.0 deg]" in line
    stamps = [m.stamp - STAMP for m in found if isinstance(m, LaserScan)]
    np.testing.assert_allclose(stamps, [0.0, 0.1, 0.2, 0.3, 0.7, 0.8, 0.9], atol=1e-6)
    assert problems.counts == {"scan on a moved mount": 3}
    assert (
        "moves the laser of /scan on the robot by 0.100 m and 0.0 degrees"
        in problems.examples["scan on a moved mount"]
    )


def test_a_mount_in_the_config_is_not_watched(entries, tmp_path):
    moved = ("base_link", "laser", [0.1, 0.15, 0.1], ZERO)
    changes = moving(links(*URDF), (0.35, T.links(STAMP, [moved])))
    log = bag(tmp_path, [*entries, *changes])
    config, source = open_log(log, None, ["sensors.lidar.mount=[0.1, 0.1, 0.0]"])
    with source:
        found = list(columns.messages(source.batches()))
    assert sum(isinstance(m, LaserScan) for m in found) == 10
    assert not source.problems.counts
    said = (
        "mount [0.100 m, 0.100 m, 0.0 deg] from the config; not [0.100 m, 0.050 m, 0.0 deg], /tf: "
    )
    assert said in choices(config, source)


@pytest.mark.parametrize("frame", ["roof", "nowhere"])
def test_the_antenna_of_a_receiver_is_located_by_transforms(entries, tmp_path, frame):
    status = T.new("sensor_msgs/msg/NavSatStatus", 0, 1)
    header = T.header(STAMP + 0.5, frame)
    fix = T.new("sensor_msgs/msg/NavSatFix", header, status, 52.0, 13.0, 40.0, np.zeros(9), 0)
    roof = ("base_link", "roof", [-0.4, 0.2, 1.1], [0, 0, 1.0])
    log = bag(tmp_path, [*entries, (0.5, "/fix", fix)], links(*URDF, roof))
    asked = ["sensors.gps.kind=navsat", "estimator.kind=landmarks"]
    config, source = open_log(log, None, asked)
    antenna = config.make_models()["gps"].antenna
    if frame == "nowhere":
        assert antenna == (0.0, 0.0)
        assert "gps /fix (antenna assumed to be at base_link: there is no transform" in choices(
            config, source
        )
        return
    assert antenna == (-0.4, 0.2)
    assert "(antenna [-0.400 m, 0.200 m], /tf_static: base" in choices(config, source)
    config, source = open_log(log, None, [*asked, "landmarks.gps.antenna=[1.0, 0.0]"])
    assert config.make_models()["gps"].antenna == (1.0, 0.0)
    assert "(antenna [1.000 m, 0.000 m] from the config)" in choices(config, source)


def test_the_transforms_at_the_first_scan_count(entries, tmp_path):
    before = ("base_link", "laser", [0.5, 0.5, 0.1], ZERO)
    early = [(-1.0, T.links(STAMP, [URDF[0], before])), (-0.5, T.links(STAMP, URDF))]
    problems, line = read(bag(tmp_path, entries, *early))[1:]
    assert "mount [0.100 m, 0.050 m, 0.0 deg]" in line
    assert problems.counts == {"contradictory mounts": 1}


@pytest.mark.parametrize("pitch", [0.02, 0.5])
def test_a_tilted_laser_is_taken_as_level_or_refused(entries, tmp_path, pitch):
    log = bag(
        tmp_path, entries, links(URDF[0], ("base_link", "laser", [0.1, 0.05, 0.1], [0, pitch, 0]))
    )
    if pitch < 0.1:
        assert "tilted by 1.1 deg and treated as level" in read(log)[2]
        return
    with pytest.raises(
        SourceError, match=r"is tilted by 28.6 degrees .* --topic scan=TOPIC"
    ) as error:
        open_log(log)
    assert "--set 'sensors.lidar.mount=[0.100,0.050,0.0000]'" in str(error.value)
    config, source = open_log(log, None, ["sensors.lidar.mount=[0.1,0.05,0.0]"])
    assert "tilted by 28.6 deg and treated as level" in choices(config, source)


def test_a_frame_with_two_parents_is_reported(entries, tmp_path):
    other = ("mast", "laser", [1, 1, 1], ZERO)
    problems, line = read(bag(tmp_path, entries, links(*URDF), links(other)))[1:]
    assert problems.counts == {"frame with two parents": 1}
    assert "mount [0.100 m, 0.050 m" in line


REVERSED = ("laser", "base_link", [-0.1, -0.05, -0.1], ZERO)


@pytest.mark.parametrize("late", [0.0, 0.5])
@pytest.mark.parametrize("topic", ["/tf", "/tf_static"])
def test_a_mount_that_is_published_in_reverse_is_inverted(entries, tmp_path, topic, late):
    """In ROS, base_link would have two parents; `late` is after the first scan."""
    reverse = late, topic, T.links(STAMP, [REVERSED])
    log = bag(tmp_path, [*entries, reverse], links(URDF[0]))
    scans, problems, line = read(log)
    assert sum(isinstance(m, LaserScan) for m in scans) == 10
    assert problems.counts == {"reversed transform": 1}
    assert (
        "laser is published as the parent of base_link" in problems.examples["reversed transform"]
    )
    assert "mount [0.100 m, 0.050 m, 0.0 deg]" in line


def test_a_reversed_mount_that_moves_is_noticed(entries, tmp_path):
    other = ("laser", "base_link", [-0.3, -0.05, -0.1], ZERO)
    moves = [(t, "/tf", T.links(STAMP, [way])) for t, way in ((0.01, REVERSED), (0.45, other))]
    _, problems, _ = read(bag(tmp_path, [*entries, *moves], links(URDF[0])))
    assert problems.counts["scan on a moved mount"] > 0


@pytest.mark.parametrize("name", ["bag_0.mcap", "bag_1.mcap"])
def test_a_later_piece_of_a_split_bag_names_the_first(entries, tmp_path, name):
    (file,) = bag(tmp_path, entries).glob("*.mcap")
    line = read(file.rename(tmp_path / name))[2]
    said = "there is no transform to laser (of a split bag, the first piece has it"
    assert (said in line) == ("1" in name)


@pytest.mark.parametrize(("frame", "child"), [("base", "base"), ("robot1/base_link", "")])
def test_without_transforms_a_scan_in_the_frame_of_the_robot_has_no_mount(tmp_path, frame, child):
    recipe = Recipe((Laser(frame=frame),), (), tf_odometry=None, odometry={"/odom": child})
    found, _ = drive(load_world("room"), recipe)
    log = write(tmp_path / "bag", recipe, [entry for entry in found if entry[0] < 1.0])
    _, problems, line = read(log)
    assert f"mount [0.000 m, 0.000 m, 0.0 deg], {frame} -> {frame}" in line
    assert not problems.counts


def test_odometry_in_transforms_is_read_alike_at_once_and_one_by_one(entries, tmp_path):
    log = bag(tmp_path, entries, links(*URDF))
    with RosBag(path=log) as source:
        whole = [m for m in columns.messages(source.batches()) if isinstance(m, OdometryPose)]
    with RosBag(path=log) as source:
        single = [m for m in columns.messages(source.batches(1)) if isinstance(m, OdometryPose)]
    assert [(m.stamp, m.pose.tolist()) for m in whole] == [
        (m.stamp, m.pose.tolist()) for m in single
    ]
    assert len(whole) == 50


def test_invalid_odometry_transforms_are_dropped_and_counted(entries, tmp_path):
    spoilt = [e for e in entries if e[1] == "/tf"]
    for k, value in ((10, math.nan), (20, 3.0), (30, 1.0)):
        time = spoilt[k][0]
        odd = T.transform(STAMP + time, "odom", "base_footprint", ZERO, ZERO)
        odd.transform.rotation.z = value
        entries = [(*e[:2], T.tf(odd)) if e[0] == time and e[1] == "/tf" else e for e in entries]
    found, problems, _ = read(bag(tmp_path, entries, links(*URDF)))
    assert sum(isinstance(m, OdometryPose) for m in found) == 47
    assert problems.counts == {"malformed odometry message": 3}


def test_inspect_and_run_say_the_same(entries, tmp_path, capsys):
    log = bag(tmp_path, entries, links(*URDF))
    main(["inspect", str(log)])
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("reads: ")]
    assert said == [
        "reads: scan /scan (mount [0.100 m, 0.050 m, 0.0 deg], /tf_static: base_footprint -> laser); "
        "odometry /tf"
    ]


def test_static_transforms_among_odometry_are_watched_and_read_once(tmp_path):
    recipe = Recipe(republished=True)
    found, _ = drive(load_world("room"), recipe)
    log = write(tmp_path / "bag", recipe, [entry for entry in found if entry[0] < 1.0])
    messages, problems, line = read(log)
    assert "/tf: base_footprint -> laser" in line
    assert sum(isinstance(m, OdometryPose) for m in messages) == 50
    assert not problems.counts


def test_transforms_out_of_order_are_counted(entries, tmp_path):
    times = [k for k, entry in enumerate(entries) if entry[1] == "/tf"]
    entries = list(entries)
    a, b = times[20], times[21]
    (s, topic, one), (t, _, two) = entries[a], entries[b]
    entries[a], entries[b] = (s, topic, two), (t, topic, one)
    problems = read(bag(tmp_path, entries, links(*URDF)))[1]
    assert problems.counts == {"backward stamp": 1}


def test_odometry_of_another_body_is_not_base(tmp_path):
    """A tracking camera that is not related to the robot but through odom."""
    recipe = Recipe(
        odometry={"/camera/odom": "camera_pose"}, tf_odometry=("odom", "base_footprint")
    )
    found, _ = drive(load_world("room"), recipe)
    camera = ("odom", "camera_pose", [0.3, 0.4, 0.5], [0, 0, 1])
    entries = [(0.0, "/tf", T.links(STAMP, [camera])), *(e for e in found if e[0] < 1.0)]
    line = read(write(tmp_path / "bag", recipe, entries))[2]
    assert "(mount [0.100 m, 0.050 m, 0.0 deg], /tf_static: base_footprint -> laser)" in line


@pytest.mark.parametrize("in_tf", [True, False])
def test_scans_and_odometry_are_of_the_same_robot(tmp_path, in_tf):
    """The second robot's scans are more, the first one's odometry."""
    world, found = load_world("room"), []
    for name in ("one", "two"):
        recipe = Recipe(
            lasers=[Laser(topic=f"/{name}/scan", frame=f"{name}/laser")],
            static=[(f"{name}/{a}", f"{name}/{b}", *where) for a, b, *where in URDF],
            tf_odometry=(f"{name}/odom", f"{name}/base_footprint") if in_tf else None,
            odometry={} if in_tf else {f"/{name}/odom": f"{name}/base_footprint"},
        )
        end = {"one": {"/one/scan": 0.5}, "two": {"/two/odom": 0.5}}[name]
        found += [e for e in drive(world, recipe)[0] if e[0] < end.get(e[1], 1.0)]
    log = write(tmp_path / "bag", Recipe(), sorted(found, key=lambda entry: entry[0]))
    config, source = open_log(log)
    line = choices(config, source)
    assert "scan /two/scan (mount [0.100 m, 0.050 m" in line
    assert "/tf_static: two/base_footprint -> two/laser" in line
    assert "is the lidar of another robot, which --topic scan=/one/scan maps instead" in line
    assert "another lidar" not in line
    with source:
        notes = [s.note for s in source.streams() if s.note.startswith("odometry")]
        used = source.defaults()[OdometryPose]
    assert notes == ["odometry: two/odom -> two/base_footprint" if in_tf else "odometry"]
    assert used == ("/tf" if in_tf else "/two/odom")


@pytest.mark.parametrize("in_tf", [True, False])
def test_robots_with_equal_frames_have_transforms_in_their_own_namespace(tmp_path, in_tf):
    """Nav2 remaps /tf and /tf_static into the namespace of each robot, and leaves the frames alone."""
    world, found, rear = load_world("room"), [], ("base_link", "laser", [-0.3, 0, 0], ZERO)
    for name, where, ways in (("one", "tf_static", URDF), ("two", "tf", (URDF[0], rear))):
        odometry = {} if in_tf else {"/odom": "base_footprint"}
        recipe = Recipe(static=(), odometry=odometry)
        entries = [(0.0, f"/{where}", T.links(STAMP, ways)), *drive(world, recipe)[0]]
        found += [(t, f"/{name}{topic}", one) for t, topic, one in entries if t < 1.0]
    found += [(0.55, "/two/tf", T.links(STAMP, URDF))]
    found.sort(key=lambda entry: entry[0])
    log = write(tmp_path / "bag", Recipe(), found)
    messages, problems, line = read(log)
    assert "(mount [0.100 m, 0.050 m, 0.0 deg], /one/tf_static: one/base_footprint -> " in line
    assert "/two/scan ([-0.300 m, 0.000 m, 0.0 deg], /two/tf: two/base_footprint" in line
    assert "is the lidar of another robot, which --topic scan=/two/scan maps instead" in line
    assert line.endswith("odometry /one/tf" if in_tf else "odometry /one/odom")
    assert problems.counts == {}
    assert sum(isinstance(one, LaserScan) for one in messages) == 10
    with RosBag(path=log, topics={"scan": "/two/scan"}) as source:
        source.watch_mounts(["/two/scan"])
        list(source.batches())
        assert source.problems.counts == {"scan on a moved mount": 4}


def test_scans_without_a_frame_are_reported(entries, tmp_path):
    for entry in entries:
        if entry[1] == "/scan":
            entry[2].header.frame_id = ""
    try:
        assert "its messages have no frame" in read(bag(tmp_path, entries, links(*URDF)))[2]
    finally:
        for entry in entries:
            if entry[1] == "/scan":
                entry[2].header.frame_id = "laser"


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize(("chosen", "x"), [("", 0.1), ("rear_laser", -0.2), ("none", 0.1)])
def test_of_two_lasers_on_one_topic_one_is_read(tmp_path, ros1, chosen, x):
    """Their scans are equally long, but the mount is that of one of them."""
    rear = ("base_link", "rear_laser", [-0.2, 0.0, 0.1], ZERO)
    recipe, types = Recipe(static=(*URDF, rear), ros1=ros1), Types(ros1=ros1)
    found, _ = drive(load_world("room"), recipe)
    found = [entry for entry in found if entry[0] < 1.0]
    others = [
        (t, topic, dataclasses.replace(m, header=types.header(STAMP + t + 0.05, "rear_laser")))
        for t, topic, m in found
        if topic == "/scan"
    ]
    log = write(tmp_path / "bag", recipe, sorted([*found, *others], key=lambda entry: entry[0]))
    _, source = open_log(log, None, [f"source.scan_frame={chosen}"] if chosen else [])
    with source:
        scans = [m for m in columns.messages(source.batches()) if isinstance(m, LaserScan)]
        assert source.mounts()["/scan"].pose[0] == pytest.approx(x)
    late = 0.05 if x < 0.0 else 0.0
    np.testing.assert_allclose(
        [m.stamp for m in scans], STAMP + late + 0.1 * np.arange(10), atol=1e-6
    )
    assert source.problems.counts == {"scan of another frame": 10}
    other = "laser" if x < 0.0 else "rear_laser"
    assert f"set source.scan_frame={other}" in source.problems.examples["scan of another frame"]


def test_a_second_topic_of_the_same_laser_is_not_another_lidar(entries, tmp_path):
    copies = [(t, "/stable", message) for t, topic, message in entries if topic == "/scan"][1:]
    line = read(bag(tmp_path, [*entries, *copies], links(*URDF)))[2]
    assert "is from the same laser as /scan; --topic scan=/stable reads it instead" in line
    assert "another lidar" not in line


def test_scans_in_the_robots_own_frame_are_not_another_lidar(entries, tmp_path):
    """They are merged from several lidars; with one of them, the map would use its beams twice."""
    merged = [
        (t, "/scan_merged", dataclasses.replace(m, header=T.header(STAMP + t, "base_link")))
        for t, topic, m in entries
        if topic == "/scan"
    ][1:]
    line = read(bag(tmp_path, [*entries, *merged], links(*URDF)))[2]
    own = "is in the robot's own frame, as merged scans are; --topic scan=/scan_merged reads it instead"
    assert own in line
    assert "another lidar" not in line


def test_a_scan_of_a_lidar_is_preferred_to_merged_scans(entries, tmp_path):
    merged = [
        (t, "/a", dataclasses.replace(m, header=T.header(STAMP + t, "base_link")))
        for t, topic, m in entries
        if topic == "/scan"
    ]
    line = read(bag(tmp_path, [*entries, *merged], links(*URDF)))[2]
    assert "scan /scan (mount [0.100 m, 0.050 m, 0.0 deg]" in line


def test_contradictory_static_transforms_are_reported_and_scans_used(entries, tmp_path):
    rival = ("base_link", "laser", [0.3, 0.05, 0.1], [0, 0, 0.5])
    log = bag(tmp_path, entries, links(*URDF), (0.35, T.links(STAMP, [rival])))
    found, problems, line = read(log)
    assert sum(isinstance(m, LaserScan) for m in found) == 10
    assert "mount [0.100 m, 0.050 m, 0.0 deg]" in line
    assert problems.counts == {"contradictory mounts": 1}
    said = problems.examples["contradictory mounts"]
    assert "the static transform base_link -> laser has different values" in said
    assert (
        "is used, the laser of /scan is at [0.100 m, 0.050 m, 0.0 deg], by another one at" in said
    )
    fix = said.partition("--set '")[2].partition("'")[0]
    config, source = open_log(log, None, [fix])
    assert "mount [0.300 m, 0.050 m, 28.6 deg] from the config" in choices(config, source)
    assert not source.problems.counts


def test_static_transforms_that_differ_in_height_do_not_contradict(entries, tmp_path):
    lower = ("base_link", "laser", [0.1, 0.05, 0.0], ZERO)
    found, problems, _ = read(bag(tmp_path, entries, links(*URDF), (0.35, T.links(STAMP, [lower]))))
    assert sum(isinstance(m, LaserScan) for m in found) == 10
    assert not problems.counts


@pytest.mark.parametrize("roll", [0, math.pi])
def test_of_contradictory_static_transforms_the_other_may_be_upside_down(entries, tmp_path, roll):
    used, other = (
        ("base_link", "laser", [x, 0.05, 0.1], [tilt, 0, 0])
        for x, tilt in ((0.1, roll), (0.2, math.pi))
    )
    ways = [links(URDF[0], used), (0.35, T.links(STAMP, [other]))]
    problems = read(bag(tmp_path, entries, *ways))[1]
    said = problems.examples["contradictory mounts"]
    assert "--set sensors.lidar.upside_down=true" in said
