"""The picture of a map shows things where they are."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.maps.drawn import mapped
from tests.recognition.plans import OFFICE, way

from impslam.evaluation.colours import INK, PATH, POINT, SEEN, TRUTH, UNSEEN, WALL
from impslam.maps.files import FREE, OCCUPIED, UNKNOWN, MapImage
from impslam.observers.canvas import Canvas, colour
from impslam.observers.map_picture import PictureContent, bounds, drawn_path, map_png, pieces
from impslam.observers.summary import length
from impslam.types import Landmark

NOTHING = np.zeros((0, 2))


def at(canvas: Canvas, x: float, y: float) -> tuple[int, ...]:
    column, row = np.round(canvas.to_pixels(np.array([x, y]))).astype(int)
    return tuple(canvas.pixels[row, column].tolist())


@pytest.mark.parametrize("size", [40, 401, 1440])
def test_a_grid_lies_on_the_map_at_any_scale(size: int) -> None:
    cells = np.full((60, 80), UNKNOWN, np.uint8)
    cells[:15, 20:40] = OCCUPIED  # the upper quarter: y from 2.25 to 3, x from 0 to 1
    canvas = Canvas((-2.0, 6.0, -1.0, 4.0), size, UNSEEN)
    greys = np.zeros((256, 3), np.uint8)
    greys[UNKNOWN], greys[OCCUPIED] = colour(UNSEEN), colour(SEEN)
    canvas.paste(greys[cells], -1.0, 3.0, 0.05)
    inside = [(0.3, 2.5), (0.7, 2.5), (0.5, 2.8)]
    outside = [(-0.3, 2.6), (1.3, 2.6), (0.5, 1.9), (0.5, 3.4), (5.0, 0.0)]
    assert {at(canvas, *p) for p in inside} == {colour(SEEN)}
    assert {at(canvas, *p) for p in outside} == {colour(UNSEEN)}


def test_lines_dashes_and_fills_are_where_they_should_be() -> None:
    canvas = Canvas((0.0, 10.0, 0.0, 10.0), 1000, UNSEEN)
    canvas.line(np.array([[1.0, 1.0], [1.0, 9.0]]), PATH, 4)
    canvas.fill(np.array([[4.0, 4.0], [6.0, 4.0], [6.0, 6.0], [4.0, 6.0]]), POINT)
    canvas.dashes(np.array([[0.0, 8.0], [10.0, 8.0]]), TRUTH, 3, 20.0, 20.0)
    assert at(canvas, 1.0, 5.0) == colour(PATH)
    assert at(canvas, 1.2, 5.0) == colour(UNSEEN)
    assert at(canvas, 5.0, 5.9) == colour(POINT)
    assert at(canvas, 5.0, 6.1) == colour(UNSEEN)
    row = canvas.pixels[round(canvas.to_pixels(np.array([0.0, 8.0]))[1])]
    assert 0.45 < np.mean((row == colour(TRUTH)).all(axis=1)) < 0.65  # ends are round


def scene(path: np.ndarray, **more: object) -> PictureContent:
    image = MapImage(np.full((40, 60), FREE, np.uint8), 0.1, np.array([-1.0, -1.0]))
    covariance = np.diag([1e-2, 1e-4])
    ends = np.array([[0.0, 2.5], [4.0, 2.5]])
    marks = (
        Landmark(3, "cylinder", np.ones(2), {"radius": 0.2}, covariance, None, 5, 0.0, 1.0),
        Landmark(4, "wall", np.array([0.0, 2.5]), {}, covariance, ends, 5, 0.0, 1.0),
    )
    return PictureContent(
        **{"image": image, "path": path, "odometry": path, "truth": path} | more, landmarks=marks
    )


def picture(drawn: PictureContent) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(map_png(drawn), np.uint8), cv2.IMREAD_COLOR)


def test_the_picture_shows_paths_walls_points_and_ends() -> None:
    path = np.column_stack([np.linspace(0.0, 4.0, 50), np.zeros(50)])
    pixels = picture(scene(path, truth=NOTHING))
    for code in (PATH, POINT, TRUTH, INK, WALL):
        assert (pixels == colour(code)).all(axis=2).sum() > 20, code


def test_the_picture_includes_ellipses_and_odometry_unless_too_large() -> None:
    """The map is 6 m by 4 m from (-1, -1)."""
    path = np.column_stack([np.linspace(0.0, 4.0, 50), np.zeros(50)])
    drawn = scene(path, odometry=np.array([[0.0, 0.0], [0.0, 7.0]]))
    wide = replace(
        drawn.landmarks[0], covariance=np.diag([4.0, 1e-4])
    )  # 6 m to both sides of x = 1
    left, right, bottom, top = bounds(replace(drawn, landmarks=(wide,)))
    assert (left < -4.9, right > 6.9, bottom < -1.0, top > 7.0) == (True,) * 4
    far = replace(drawn.landmarks[0], covariance=np.diag([400.0, 1e-4]))
    assert bounds(replace(drawn, landmarks=(far,)))[0] > -2.0
    away = np.array([[0.0, 0.0], [0.0, 70.0]])
    assert bounds(scene(path, odometry=away))[3] < 4.0


def test_odd_paths_can_be_drawn() -> None:
    nowhere = np.full((3, 2), np.nan)
    far = np.array([[0.0, 0.0], [1e12, -1e12]])
    for path, odometry, truth in ((NOTHING, NOTHING, nowhere), (np.zeros((1, 2)), far, far[:1])):
        assert picture(scene(path, odometry=odometry, truth=truth)).shape[2] == 3


def test_the_picture_of_a_run_is_the_same_each_time() -> None:
    path = np.column_stack([np.linspace(0.0, 4.0, 9000), np.zeros(9000)])
    assert map_png(scene(path)) == map_png(scene(path))


def test_paths_of_two_drives_are_drawn_apart():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [np.nan, np.nan], [1.0, 1.0], [0.0, 1.0]])
    assert [piece.tolist() for piece in pieces(path)] == [path[:2].tolist(), path[3:].tolist()]
    assert list(pieces(path[2:3])) == []


def test_the_path_is_interrupted_between_drives_and_ends_where_the_robot_was_lost():
    known = mapped(OFFICE, way(-6.0, 0.0, 6.0, 0.0, 6))
    sessions = np.repeat([0, 1, 2], 2)
    rows = replace(known.keyframes, sessions=sessions, placed=sessions < 2)
    path = drawn_path(replace(known, keyframes=rows))
    assert np.isnan(path).any(axis=1).tolist() == [False] * 4 + [True] + [False] * 4


def test_the_gap_between_two_drives_does_not_count_as_distance():
    known = mapped(OFFICE, way(-6.0, 0.0, 6.0, 0.0, 6))
    path, anchors = known.path(), known.anchors
    steps = np.hypot(*np.diff(path[:, 1:3], axis=0).T)
    assert length(known, path) == pytest.approx(steps.sum())
    rows = replace(known.keyframes, sessions=np.repeat([0, 1], 3))
    joined, second = replace(known, keyframes=rows), int(np.searchsorted(anchors, 3))
    assert length(joined, path) == pytest.approx(steps.sum() - steps[second - 1])
    assert length(joined, path, second) == pytest.approx(steps[second:].sum())


def test_stray_beams_do_not_make_the_map_small() -> None:
    """A hall of 8 m by 6 m, and beams through a window that end up to 60 m away."""
    pixels = np.full((700, 700), UNKNOWN, np.uint8)
    pixels[600:660, 20:100] = FREE
    for walls in ((slice(600, 660), [20, 21, 98, 99]), ([600, 601, 658, 659], slice(20, 100))):
        pixels[walls] = OCCUPIED
    pixels[[40, 90], [600, 300]] = OCCUPIED
    pixels = np.kron(pixels, np.ones((2, 2), np.uint8))
    image = MapImage(pixels, 0.05, np.zeros(2))
    path = np.array([[4.0, 7.0], [8.0, 7.0]])
    left, right, bottom, top = bounds(
        replace(scene(path, odometry=path), image=image, landmarks=())
    )
    assert 1.5 < left <= 2.0
    assert 10.0 <= right < 10.5
    assert 3.5 < bottom <= 4.0
    assert 10.0 <= top < 10.5
