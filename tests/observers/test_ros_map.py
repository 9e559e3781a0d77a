"""What a run has learned, as ROS sees it: read back with rosbags."""

from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from tests.observers import runs

from impslam.errors import ImpError
from impslam.geometry.se2 import compose
from impslam.health import BLIND, Health
from impslam.maps.files import FREE, OCCUPIED, map_image
from impslam.observers.ros_map import RosMap, write_ros_map

SCANS = 50


def made_up():
    known = runs.play([], SCANS)
    reasons = np.zeros(SCANS, np.int8)
    reasons[20:30] = BLIND
    health = Health(known.stamps, reasons, np.zeros(SCANS))
    return replace(known, landmarks=runs.make_landmarks()), runs.make_outcome(SCANS, health=health)


def read(path):
    """Return by topic the (time in ns, message) of a file, and which topics are latched."""
    topics = {}
    with AnyReader([path]) as reader:
        latched = {
            c.topic
            for c in reader.connections
            for qos in c.ext.offered_qos_profiles
            if qos.durability is QosDurability.TRANSIENT_LOCAL
        }
        for connection, clock, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            topics.setdefault(connection.topic, []).append((clock, message))
    return topics, latched


def stamp_of(header):
    return header.stamp.sec + 1e-9 * header.stamp.nanosec


def pose_of(position, turn):
    assert (turn.x, turn.y) == (0.0, 0.0)
    return np.array([position.x, position.y, 2.0 * np.arctan2(turn.z, turn.w)])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    known, outcome = made_up()
    path = tmp_path_factory.mktemp("ros") / "run.mcap"
    RosMap(path).finish(known, outcome)
    return known, *read(path)


def test_the_final_map_path_and_landmarks_come_first_and_are_latched(written):
    _, topics, latched = written
    assert set(topics) == {"/map", "/path", "/landmarks", "/tf", "/health"}
    assert latched == {"/map", "/path", "/landmarks"}
    first = min(clock for clock, _ in topics["/tf"])
    assert [(len(topics[name]), topics[name][0][0]) for name in sorted(latched)] == [(1, first)] * 3


def test_frames_compose_to_the_poses_of_the_map_at_rising_stamps(written):
    known, topics, _ = written
    clocks = [clock for clock, _ in topics["/tf"]]
    assert np.diff(clocks).min() > 0
    assert len(clocks) == SCANS
    for (_, message), row in zip(topics["/tf"], known.path(), strict=True):
        moves = [(t.header.frame_id, t.child_frame_id) for t in message.transforms]
        assert moves == [("map", "odom"), ("odom", "base_link")]
        parts = [pose_of(t.transform.translation, t.transform.rotation) for t in message.transforms]
        np.testing.assert_allclose(compose(*parts)[:2], row[1:3], atol=1e-9)
        assert stamp_of(message.transforms[0].header) == pytest.approx(row[0], abs=1e-6)


def test_grid_and_path_match_the_map(written):
    known, topics, _ = written
    (_, grid), (_, path) = topics["/map"][0], topics["/path"][0]
    image = map_image(known.grid(0.05))
    cells = grid.data.reshape(grid.info.height, grid.info.width)[::-1]
    assert np.array_equal(cells == 0, image.pixels == FREE)
    assert np.array_equal(cells == 100, image.pixels == OCCUPIED)
    assert (cells == -1).any()
    corner = [grid.info.origin.position.x, grid.info.origin.position.y]
    np.testing.assert_allclose(corner, image.origin)
    assert (grid.header.frame_id, path.header.frame_id) == ("map", "map")
    poses = [pose_of(row.pose.position, row.pose.orientation) for row in path.poses]
    np.testing.assert_allclose(np.array(poses)[:, :2], known.path()[:, 1:3])


def test_landmarks_are_markers_with_numbers_of_their_own(written):
    _, topics, _ = written
    markers = topics["/landmarks"][0][1].markers
    assert len({(m.ns, m.id) for m in markers}) == len(markers) == 5
    wall = next(m for m in markers if m.ns == "wall")
    assert [(p.x, p.y) for p in wall.points] == [(3.0, -2.0), (3.0, 4.0)]
    column = next(m for m in markers if m.ns == "cylinder")
    assert column.scale.x == pytest.approx(0.2)
    around = next(m for m in markers if m.ns == "3 sigma")
    assert max(p.y for p in around.points) - 0.997 == pytest.approx(3.0 * np.sqrt(4e-5), rel=0.01)


def test_health_has_level_and_reason(written):
    _, topics, _ = written
    states = [message.status[0] for _, message in topics["/health"]]
    assert [s.level for s in states] == [0] * 20 + [1] * 10 + [0] * 20
    assert "the lidar sees nothing" in states[25].message


@pytest.mark.parametrize(("same_log", "first"), [(False, 20), (True, 0)])
def test_of_a_continued_map_the_drive_of_the_newest_log_is_written(tmp_path, same_log, first):
    """The first 20 scans are of a day before, or of a run of the same log that was stopped."""
    known, outcome = made_up()
    if not same_log:
        stamps, sessions = known.stamps.copy(), known.keyframes.sessions.copy()
        stamps[:20] -= 86400.0
        sessions[int(known.anchors[20]) :] = 1
        keyframes = replace(known.keyframes, sessions=sessions)
        known = replace(known, stamps=stamps, keyframes=keyframes)
    health = Health(*(column[20:] for column in outcome.health[:3]))
    write_ros_map(tmp_path / "run.mcap", known, replace(outcome, health=health))
    topics, _ = read(tmp_path / "run.mcap")
    assert len(topics["/tf"]) == len(topics["/health"]) == SCANS - first
    stamps = [stamp_of(message.transforms[0].header) for _, message in topics["/tf"]]
    np.testing.assert_allclose(stamps, known.stamps[first:], atol=1e-6)
    assert min(clock for rows in topics.values() for clock, _ in rows) == topics["/tf"][0][0]
    assert len(topics["/path"][0][1].poses) == SCANS


def test_of_a_drive_that_is_not_located_in_a_continued_map_only_the_map_is_written(tmp_path):
    known, outcome = made_up()
    keyframes, later = known.keyframes, int(known.anchors[20])
    sessions, placed = keyframes.sessions.copy(), keyframes.placed.copy()
    sessions[later:], placed[later:] = 1, False
    known = replace(known, keyframes=replace(keyframes, sessions=sessions, placed=placed))
    health = Health(*(column[20:] for column in outcome.health[:3]))
    write_ros_map(tmp_path / "run.mcap", known, replace(outcome, health=health))
    topics, latched = read(tmp_path / "run.mcap")
    assert set(topics) == latched == {"/map", "/path", "/landmarks"}
    assert len(topics["/path"][0][1].poses) == 20


def test_stamps_that_run_backwards_or_repeat_are_put_in_order(tmp_path):
    known, outcome = made_up()
    stamps = known.stamps.copy()
    stamps[10], stamps[31] = stamps[5] + 0.01, stamps[30]
    known = replace(known, stamps=stamps)
    write_ros_map(tmp_path / "run.mcap", known, outcome)
    topics, _ = read(tmp_path / "run.mcap")
    clocks = np.array([clock for clock, _ in topics["/tf"]])
    assert len(clocks) == SCANS - 1
    assert np.diff(clocks).min() > 0
    at = topics["/tf"][6][1].transforms
    moved = compose(*(pose_of(t.transform.translation, t.transform.rotation) for t in at))
    np.testing.assert_allclose(moved[:2], known.path()[10, 1:3], atol=1e-9)


def test_stamps_before_1970_are_refused_and_leave_no_file(tmp_path):
    known, outcome = made_up()
    early = replace(known, stamps=known.stamps - 2e9)
    with pytest.raises(ImpError, match="does not fit ROS"):
        write_ros_map(tmp_path / "run.mcap", early, outcome)
    assert list(tmp_path.iterdir()) == []
