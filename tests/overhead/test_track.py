"""End to end: a simulated robot is filmed from 5 m with distortion, blur and noise, and tracked."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from impslam.cli.track import _show
from impslam.errors import ImpError
from impslam.evaluation.consistency import nees, pose_errors
from impslam.overhead.boards import find_boards
from impslam.overhead.setup import Board, load_setup
from impslam.overhead.track import Tracked, track
from impslam.simulation.drive import drive
from impslam.simulation.overhead_files import write_film
from impslam.simulation.robot import OverheadCamera
from impslam.simulation.scene import Scene
from impslam.simulation.world import load_world

START, SEED = 1000.0, 3
DEVICE = OverheadCamera(width=1280, height=720, rate=5.0, hidden=((2.9, 4.9),))


def ignore(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Return the video, and the true path."""
    world, video = load_world("room"), tmp_path_factory.mktemp("film") / "film.mp4"
    way = drive(world.robot)
    write_film(video, DEVICE, Scene(world), way, START, SEED, ignore)
    return video, way


@pytest.fixture(scope="module")
def tracked(filmed) -> Tracked:
    return track(filmed[0], load_setup(filmed[0].with_suffix(".toml")), filmed[0].parent, ignore)


def test_poses_within_5_mm_and_half_a_degree(filmed, tracked) -> None:
    errors = pose_errors(tracked.found.poses.copy(), filmed[1].at(tracked.stamps - START))
    assert np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))) < 0.005
    assert np.degrees(np.sqrt(np.mean(errors[:, 2] ** 2))) < 0.5
    # The errors of one calibration are common to all pictures: the bound is that of one draw.
    assert 0.05 < nees(errors, tracked.found.covariances).mean() < 16.3


def test_ten_hidden_pictures_are_reported_without_poses(tracked) -> None:
    np.testing.assert_allclose(tracked.hidden, START + np.arange(3.0, 4.9, 0.2), atol=1e-3)
    assert len(tracked.hidden) == 10
    assert not np.isin(tracked.stamps, tracked.hidden).any()
    assert len(tracked.unfit) == 0


def test_cylinders_are_located(tracked) -> None:
    true = sorted(part.centre for part in load_world("room").cylinders)
    assert len(tracked.cylinders) == len(true)
    for cylinder, centre in zip(tracked.cylinders, true, strict=True):
        error = cylinder.centre - centre
        assert error @ np.linalg.solve(cylinder.covariance, error) < 13.8
        assert np.hypot(*error) < 0.005


def test_errors_for_unusable_videos_and_setups(filmed, tmp_path) -> None:
    video = filmed[0]
    setup = load_setup(video.with_suffix(".toml"))
    text, empty, single = (tmp_path / name for name in ("no.mp4", "empty", "single"))
    text.write_text("no video")
    empty.mkdir()
    single.mkdir()
    cv2.imwrite(str(single / "small.png"), np.full((60, 80), 255, np.uint8))
    bare = {"board": None}
    points = (*setup.floor.points[:3], setup.floor.points[3].model_copy(update={"marker": 99}))
    for path, changed, told in (
        (tmp_path / "absent.mp4", {}, "no such video"),
        (text, {}, "is not a readable video"),
        (
            video,
            {"board": setup.board.model_copy(update={"views": str(single)})},
            "in 0 of 1 pictures",
        ),
        (
            video,
            {"board": setup.board.model_copy(update={"views": str(empty)})},
            "contains no picture",
        ),
        (
            video,
            {**bare, "floor": setup.floor.model_copy(update={"points": points})},
            "3 of 4 are found",
        ),
        (
            video,
            {**bare, "marker": setup.marker.model_copy(update={"id": 5})},
            "in no picture",
        ),
    ):
        with pytest.raises(ImpError, match=told):
            track(path, setup.model_copy(update=changed), video.parent, ignore)


def test_a_board_in_pictures_of_another_size_than_the_video_is_refused(filmed, tmp_path) -> None:
    setup = load_setup(filmed[0].with_suffix(".toml"))
    for path in sorted((filmed[0].parent / setup.board.views).iterdir()):
        picture = cv2.imread(str(path))
        cv2.imwrite(str(tmp_path / path.name), cv2.resize(picture, None, fx=0.5, fy=0.5))
    board = setup.board.model_copy(update={"views": str(tmp_path)})
    with pytest.raises(ImpError, match="640 x 360 px, but the video has 1280 x 720 px"):
        track(filmed[0], setup.model_copy(update={"board": board}), filmed[0].parent, ignore)


def test_points_that_contradict_the_video_are_reported(filmed, tracked, capsys) -> None:
    setup = load_setup(filmed[0].with_suffix(".toml"))
    for point, expected in ((None, 0), (np.array([1.5, -2.0, 0.0]), 1)):
        _show(replace(tracked, calibration=replace(tracked.calibration, odd_point=point)), setup)
        assert capsys.readouterr().out.count("too small; most at x 1.5 m, y -2 m") == expected


def test_the_simulated_camera_rejects_points_outside_its_view(tmp_path) -> None:
    world = load_world("room")
    for changed, told in (
        ({"focal": 5000.0}, "whole path"),
        ({"marker_size": 0.02}, "make it 0.06 m"),
    ):
        device = DEVICE.model_copy(update=changed)
        with pytest.raises(ImpError, match=told):
            write_film(tmp_path / "x.mp4", device, Scene(world), drive(world.robot), 0.0, 0, ignore)


def test_charuco_boards_are_found() -> None:
    board = Board(kind="charuco", columns=7, rows=5, square=0.04, views="x")
    printed = cv2.aruco.CharucoBoard(
        (7, 5), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    )
    grey = cv2.copyMakeBorder(
        printed.generateImage((700, 500)), *[60] * 4, cv2.BORDER_CONSTANT, value=255
    )
    (view,) = find_boards([cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)], board)
    assert view.points.shape == (24, 3)
    np.testing.assert_allclose(np.ptp(view.pixels, axis=0), [500, 300], atol=1.0)


def test_setup_names_the_key(tmp_path) -> None:
    file = tmp_path / "setup.toml"
    for text, told in (
        ("", "floor is missing"),
        ("[floor]\npoints = []", "floor.points"),
        (
            "marker = {siez = 1}\n" + 4 * "[[floor.points]]\nx = 1.0\ny = 1.0\nmarker = 1\n",
            "marker.siez is not a parameter; did you mean 'size'",
        ),
        ("[[floor.points]]\nx = 1.0\ny = 2.0\n" * 4, "either pixel or marker"),
    ):
        file.write_text(text)
        with pytest.raises(ImpError, match=told):
            load_setup(file)
