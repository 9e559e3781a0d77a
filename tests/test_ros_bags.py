"""Bags as users of slam_toolbox have them, each mapped by `imp run BAG` alone."""

import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from tests.sources.ros_recipes import BAGS
from tests.sources.ros_robots import Recipe, Types, drive, write

import impslam
from impslam.config_from_log import choices
from impslam.errors import SourceError
from impslam.geometry.se2 import between
from impslam.open_log import open_log
from impslam.run import map_log
from impslam.simulation.world import load_world


@pytest.fixture(scope="module")
def room():
    """A room, and some metres of a way in it."""
    return load_world("room")


@pytest.mark.parametrize("name", BAGS)
def test_a_bag_is_mapped_as_it_is(name, room, tmp_path):
    recipe, said = BAGS[name]
    entries, truth = drive(room, recipe)
    log = write(tmp_path / "bag", recipe, entries)
    assert said in choices(*open_log(log))
    assert worst(impslam.run(log).path(), truth) < 0.01


def worst(path, truth):
    """Return the largest distance from the truth in m; both begin at their first scan."""
    assert len(path) == len(truth)
    np.testing.assert_allclose(path[:, 0], truth[:, 0], atol=1e-6)
    found, true = (
        between(np.broadcast_to(p[0, 1:4], (len(p), 3)), p[:, 1:4]) for p in (path, truth)
    )
    return np.hypot(*(found - true)[:, :2].T).max()


def test_without_the_mount_a_bag_is_mapped_wrongly(room, tmp_path):
    """What the tests above rest on."""
    recipe = BAGS["backward"][0]
    entries, truth = drive(room, recipe)
    log = write(tmp_path / "bag", recipe, entries)
    assert worst(impslam.run(log, settings=["sensors.lidar.mount=[0,0,0]"]).path(), truth) > 0.1


def test_a_second_lidar_is_added_by_what_the_line_says(room, tmp_path):
    """The error is the mean of three drives, because that of one varies from 0.5 to 1.0 cm."""
    recipe = BAGS["two lidars"][0]
    entries, truth = drive(room, recipe)
    log = write(tmp_path / "bag", recipe, entries)
    said = "--set sensors.NAME.kind=lidar2d --set sensors.NAME.stream=/rear/scan"
    where = "([-0.150 m, 0.000 m, 180.0 deg], /tf_static: base_footprint -> rear)"
    assert f"/rear/scan {where} is another lidar, added by {said}" in choices(*open_log(log))
    settings = ["sensors.rear.kind=lidar2d", "sensors.rear.stream=/rear/scan"]
    assert "/rear/scan (mount [-0.150 m, 0.000 m, 180.0 deg]" in choices(
        *open_log(log, None, settings)
    )
    errors = []
    for seed in range(3):
        entries, truth = drive(room, recipe, seed)
        both = impslam.run(write(tmp_path / f"bag{seed}", recipe, entries), settings=settings)
        assert len(both.path()) == 2 * len(truth)
        errors.append(worst(both.path()[::2], truth))
    assert np.mean(errors) < 0.01


def test_a_folder_of_several_pieces_is_one_log(room, tmp_path):
    recipe = Recipe()
    entries, truth = drive(room, recipe)
    middle = len(entries) // 2
    log = write(tmp_path / "bag", recipe, entries[:middle])
    rest = write(tmp_path / "rest", recipe, entries[middle:])
    shutil.move(rest / "rest.mcap", log / "rest.mcap")
    text = (log / "metadata.yaml").read_text()
    (log / "metadata.yaml").write_text(text.replace("- bag.mcap", "- bag.mcap\n  - rest.mcap"))
    assert worst(impslam.run(log).path(), truth) < 0.01


PLUGINS = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]


def unclosed(room, recipe, folder):
    """Return a folder with pieces 9 and 10 of a bag alone, the entries of the second, and the truth."""
    entries, truth = drive(room, recipe)
    middle = len(entries) // 2
    (log := folder / "bag").mkdir()
    for k, part in ((9, entries[:middle]), (10, entries[middle:])):
        (file,) = write(folder / str(k), recipe, part).glob(f"{k}.*")
        file.rename(log / f"bag_{file.name}")
    return log, entries[middle:], truth


@pytest.mark.parametrize("plugin", PLUGINS)
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_compressed_folder_without_metadata_is_one_log(room, tmp_path, plugin, mode):
    """Of a file whose compression was interrupted, the original is read."""
    log, second, truth = unclosed(room, Recipe(plugin=plugin, compression=mode), tmp_path)
    if mode is CompressionMode.FILE:
        rest = write(tmp_path / "rest", Recipe(plugin=plugin), second)
        (whole,) = rest.glob("rest.*")
        (packed,) = log.glob("bag_10.*")
        packed.write_bytes(packed.read_bytes()[:1000])
        whole.rename(packed.with_suffix(""))
    config, source = open_log(log)
    assert worst(map_log(config, source).path(), truth) < 0.01
    assert source.problems.counts == {"cut file": 1}


@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_folder_that_its_recorder_did_not_close_is_one_log(room, tmp_path, plugin):
    """Pieces 9 and 10, of which the name of the later one comes first by alphabet."""
    log, _, truth = unclosed(room, Recipe(plugin=plugin), tmp_path)
    config, source = open_log(log)
    assert worst(map_log(config, source).path(), truth) < 0.01
    assert source.problems.counts == {"cut file": 1}
    said = source.problems.examples["cut file"]
    assert "has no metadata.yaml" in said
    assert "ros2 bag reindex" in said
    (piece,) = log.glob("bag_9.*")
    piece.rename(piece.with_stem("other_9"))
    with pytest.raises(SourceError, match=r"it contains 2 logs, bag_10\..*, other_9\."):
        open_log(log)


def test_why_all_odometry_was_dropped_is_said(room, tmp_path):
    recipe = Recipe(odometry={"/odom": "base_footprint"}, tf_odometry=None)
    entries = [entry for entry in drive(room, recipe)[0] if entry[0] < 1.0]
    for _, topic, message in entries:
        if topic == "/odom":
            message.pose.pose.orientation = Types(ros1=False).quaternion([0, 0, 0])
            message.pose.pose.orientation.w = 0.0
    said = r"no OdometryPose .*; \d+ x malformed odometry message: .*: /odom: .*zero quaternion"
    with pytest.raises(SourceError, match=said):
        impslam.run(write(tmp_path / "bag", recipe, entries))
