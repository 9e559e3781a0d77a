"""The live view: what is shown is what is there, at any time, in bounded memory."""

import threading
import time
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.observers.runs import Scripted, make_landmarks, make_outcome, make_results
from tests.rings import GRAPH, ring

from impslam.columns import single_row
from impslam.geometry.se2 import compose, inverse, transform
from impslam.health import MISALIGNED
from impslam.maps.files import FREE, OCCUPIED, UNKNOWN, map_image
from impslam.observers import live_view as module
from impslam.observers.base import Observer
from impslam.observers.health import HealthMonitor
from impslam.observers.live_view import LiveView
from impslam.observers.thin_path import ThinPath
from impslam.observers.true_pose import TruthInMap
from impslam.run import Run
from impslam.types import LaserScan, TruePose


def begun(landmarks=make_landmarks):
    view = LiveView()
    run = Scripted(view, landmarks=landmarks)
    view.begin(run)
    return view, run


# --------------------------------------------------------------------------- snapshot


def test_before_the_first_scan_there_is_nothing():
    shown = LiveView().snapshot()
    assert (shown.scans, shown.landmarks, shown.grid, shown.run) == (0, (), None, 0)
    assert np.isnan(shown.stamp)
    assert shown.path.shape == shown.points.shape == (0, 2)


def test_a_snapshot_is_that_of_the_newest_scan():
    view, run = begun()
    versions = [view.snapshot().version]
    for i, result in enumerate(make_results(20)):
        view.truth(TruePose(result.stamp, np.full(3, float(i))))
        run.step(result)
        view._worker.join()
        shown = view.snapshot()
        assert (shown.stamp, shown.scans) == (result.stamp, i + 1)
        for name in ("pose", "covariance", "odometry"):
            np.testing.assert_allclose(getattr(shown, name), getattr(result, name), atol=1e-12)
        np.testing.assert_allclose(shown.path[-1], result.pose[:2], atol=1e-6)
        np.testing.assert_array_equal(shown.truth, np.full(3, i))
        versions.append(shown.version)
    assert sorted(set(versions)) == versions
    assert [mark.id for mark in shown.landmarks] == [7, 8]


def test_a_snapshot_does_not_change():
    view, run = begun()
    results = list(make_results(40))
    for result in results[:10]:
        run.step(result)
    shown = view.snapshot()
    path, points = shown.path.copy(), shown.points.copy()
    for result in results[10:]:
        run.step(result)
    np.testing.assert_array_equal(shown.path, path)
    np.testing.assert_array_equal(shown.points, points)
    assert shown.scans == 10


def test_points_are_the_end_points_of_valid_beams_in_map():
    view, run = begun()
    result = list(make_results(3))[2]
    pose = np.array([1.0, -2.0, 0.7])
    valid = np.arange(len(result.scan.valid)) % 3 == 0
    seen = replace(result, pose=pose, scan=replace(result.scan, valid=valid))
    expected = transform(pose, result.scan.points[valid])
    for keyframe in (True, False):
        run.step(seen, keyframe=keyframe)
        assert view.snapshot().points.dtype == np.float32
        np.testing.assert_allclose(view.snapshot().points, expected, atol=1e-5)
    run.step(replace(result, scan=None))
    assert view.snapshot().points.shape == (0, 2)


def test_the_arrival_time_is_that_of_the_same_scan():
    view, run = begun()
    results = list(make_results(6))
    for i, result in enumerate(results):
        view.expect(result.stamp, 100.0 + i)
    run.step(results[0])
    assert view.snapshot().arrived == 100.0
    run.step(results[3])  # two were refused
    assert view.snapshot().arrived == 103.0
    run.step(results[5])
    assert view.snapshot().arrived == 105.0
    run.step(results[5])  # nobody told
    assert np.isnan(view.snapshot().arrived)


def test_a_new_map_begins_empty_and_keeps_counting():
    view, run = begun()
    for result in make_results(5):
        run.step(result)
    before = view.snapshot()
    view.begin(Scripted())
    after = view.snapshot()
    assert (after.scans, after.landmarks, after.grid, after.truth) == (0, (), None, None)
    assert after.version > before.version
    assert after.run == before.run + 1


def test_readers_see_whole_snapshots_only():
    """The path's end is the pose, whoever looks whenever."""
    view, run = begun()
    torn, seen, stop = [], set(), threading.Event()

    def look():
        while not stop.is_set():
            shown = view.snapshot()
            seen.add(shown.version)
            if shown.scans and abs(shown.path[-1] - shown.pose[:2]).max() > 1e-5:
                torn.append(shown)

    threads = [threading.Thread(target=look) for _ in range(2)]
    for thread in threads:
        thread.start()
    for result in make_results(300):
        run.step(result)
    stop.set()
    for thread in threads:
        thread.join()
    assert not torn
    assert len(seen) > 1


def test_a_truth_in_its_own_frame_is_shown_in_map():
    """The simulator's world begins elsewhere, and its poses are of other times than the scans."""
    view, run = begun()
    results, T_truth_map = list(make_results(20)), np.array([3.0, -2.0, 0.7])
    for before, result in pairwise(results):
        for at in (before, result):
            view.truth(TruePose(at.stamp, compose(T_truth_map, at.pose)))
        run.step(result)
        np.testing.assert_allclose(view.snapshot().truth, result.pose, atol=1e-9)


def test_a_truth_between_two_scans_is_interpolated_to_align_its_frame():
    frame, T_truth_map = TruthInMap(), np.array([3.0, -2.0, 0.7])
    frame.align(0.0, np.zeros(3))
    assert frame.pose is None
    for stamp in (0.0, 1.0):
        frame.add(TruePose(stamp, compose(T_truth_map, np.array([stamp, 0.0, 0.0]))))
    frame.align(2.0, np.zeros(3))  # the truth does not reach there
    assert frame.pose is None
    frame.align(0.25, np.array([0.25, 0.0, 0.0]))
    np.testing.assert_allclose(frame.pose, [1.0, 0.0, 0.0], atol=1e-12)


def test_a_truth_without_headings_is_not_transformed():
    frame = TruthInMap()
    frame.add(TruePose(0.0, np.array([5.0, 5.0, np.nan])))
    frame.align(0.0, np.zeros(3))
    np.testing.assert_array_equal(frame.pose, [5.0, 5.0, np.nan])


# --------------------------------------------------------------------------- landmarks


def test_landmarks_are_read_at_a_bounded_rate_and_only_when_they_may_have_changed(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    reads = []

    def read():
        reads.append(clock[0])
        return make_landmarks()

    view, run = begun(read)
    results = list(make_results(101))
    for i, result in enumerate(results):  # 8 Hz, the last half between keyframes
        clock[0] = 1.0 + 0.125 * i
        run.step(result, keyframe=i < 50)
        view._worker.join()
    assert reads == [1.0 + 0.25 * i for i in range(26)]  # the last keyframe too, once it is due


def test_a_map_that_is_slow_to_read_is_read_less_often(monkeypatch):
    clock, reads = [0.0], []
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])

    def read():
        clock[0] += 0.05  # 2500 landmarks
        reads.append(clock[0])
        return make_landmarks()

    view, run = begun(read)
    for i, result in enumerate(make_results(100)):
        clock[0] = max(clock[0], 1.0 + 0.1 * i)
        run.step(result)
        view._worker.join()
    assert 9 <= len(reads) <= 11  # a twentieth of 10 s


def test_background_reading_takes_a_tenth_of_the_time(monkeypatch):
    clock, reads = [0.0], []
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    view, run = begun()

    def read():
        clock[0] += 0.1  # a building
        reads.append(clock[0])
        return make_landmarks()

    run.draft_landmarks = lambda: read
    for i, result in enumerate(make_results(100)):
        clock[0] = max(clock[0], 1.0 + 0.1 * i)
        run.step(result)
        view._worker.join()
    assert 8 <= len(reads) <= 10
    assert len(view.snapshot().landmarks) == 2


def test_scans_do_not_wait_for_landmarks_or_for_the_grid(monkeypatch):
    view, run = begun()
    gate = threading.Event()
    run.draft_landmarks = lambda: lambda: gate.wait(10.0) and make_landmarks()
    results = list(make_results(50))
    begin = time.monotonic()
    for result in results:
        run.step(result)
    assert time.monotonic() - begin < 5.0
    assert view.snapshot().scans == 50
    assert view.snapshot().landmarks == ()
    gate.set()
    view._worker.join()
    run.step(results[-1])
    assert len(view.snapshot().landmarks) == 2


# --------------------------------------------------------------------------- a loop that closes


def test_path_landmarks_and_grid_move_when_a_loop_closes(monkeypatch):
    monkeypatch.setattr(module, "GRID_INTERVAL", 0.0)
    monkeypatch.setattr(module, "LANDMARK_INTERVAL", 0.0)
    view = LiveView()
    run = Run(GRAPH, [view])
    view.begin(run)
    shown = view.snapshot()
    for order, message in enumerate(ring()):
        run.feed(single_row(type(message).__name__, message, order))
        if run.estimator.counts()["loops closed"]:
            break
        if isinstance(message, LaserScan) and view.snapshot().scans:
            view._worker.join()
            early, shown = run._builder.map(), view.snapshot()
    known, after = run.map(), view.snapshot()
    moved = np.hypot(*(known.path()[: len(early.stamps)] - early.path())[:, 1:3].T)
    assert moved.max() > 1.0
    # The path moves at once, and as a whole; landmarks and grid as soon as they are made.
    assert distances(known.path()[:, 1:3], after.path.astype(float)).max() < 0.05
    assert distances(known.path()[:, 1:3], shown.path.astype(float)).max() > 0.5
    np.testing.assert_allclose(after.path[-1], after.pose[:2], atol=1e-6)
    view._worker.join()
    view._landmarks_due = view._grid_due = 0.0
    view._start_update()
    view._worker.join()
    assert same_marks(view._current_landmarks(), known.landmarks)
    assert not same_marks(shown.landmarks, known.landmarks)
    image = map_image(known.grid())
    np.testing.assert_array_equal(decoded(view._current_picture())[1], image.pixels)
    assert view._current_picture().png != shown.grid.png


def same_marks(some, others):
    return [(m.id, *m.position) for m in some] == [(m.id, *m.position) for m in others]


def test_the_last_snapshot_is_of_the_refined_map():
    view = LiveView()
    run = Run(GRAPH, [view])
    view.begin(run)
    run.play(ring())
    before, refined = view.snapshot(), run.refined()
    view.finish(refined, make_outcome())
    shown = view.snapshot()
    np.testing.assert_array_equal(shown.pose, refined.path()[-1, 1:])
    np.testing.assert_allclose(shown.path[-1], shown.pose[:2], atol=1e-6)
    assert distances(refined.path()[:, 1:3], shown.path.astype(float)).max() < 0.1
    in_base = transform(inverse(before.pose), before.points.astype(float))
    np.testing.assert_allclose(shown.points, transform(shown.pose, in_base), atol=1e-5)
    assert same_marks(shown.landmarks, refined.landmarks)


def test_a_long_path_moves_in_a_millisecond_and_stays_thin():
    path = ThinPath(limit=4000)
    turn = np.linspace(0.0, 60.0, 60_000)
    keyframes = np.column_stack([np.cos(turn), np.sin(turn), turn])[::10]
    T = np.array([0.02, -0.01, 0.0])
    for k, (x, y, _) in enumerate(compose(keyframes, T)):
        path.add(x * 5, y * 5)  # thinned, and not moved
        path.add(x, y, (k, 0.02, -0.01))
    frame = np.array([3.0, -2.0, 1.0])
    before = path.points.copy()
    begin = time.process_time()
    path.move(compose(frame, keyframes))
    assert time.process_time() - begin < 0.05
    after = path.points
    fixed = np.hypot(*before.T) > 2.0
    np.testing.assert_array_equal(after[fixed], before[fixed])
    expected = transform(frame, before[~fixed].astype(float))
    np.testing.assert_allclose(after[~fixed], expected, atol=1e-5)
    assert fixed.any()
    assert not fixed.all()


def test_at_the_end_the_whole_map_is_shown():
    view, run = begun(tuple)
    for result in make_results(5):
        run.step(result)
    run.landmarks = make_landmarks
    known = run.map()
    view.finish(known, make_outcome())
    shown = view.snapshot()
    assert shown.finished
    assert shown.landmarks == known.landmarks
    np.testing.assert_array_equal(decoded(shown.grid)[1], map_image(known.grid()).pixels)


def test_a_refresh_shows_the_current_map():
    marks = []
    view, run = begun(lambda: tuple(marks))
    for result in make_results(3):
        run.step(result)
    marks.extend(make_landmarks())
    view.refresh()
    assert len(view.snapshot().landmarks) == 2
    assert not view.snapshot().finished


# --------------------------------------------------------------------------- the grid


def decoded(picture):
    """Return a picture as opacity and greys of a trinary map."""
    image = cv2.imdecode(np.frombuffer(picture.png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == (*picture.size[::-1], 4)
    clear = image[..., 3] == 0
    greys = np.where(clear, UNKNOWN, np.where(image[..., 0] == 255, FREE, OCCUPIED))
    return image[..., 3], greys


def test_the_grid_is_a_picture_with_its_origin():
    view, run = begun()
    for result in make_results(30):
        run.step(result)
    view.refresh()
    shown = view.snapshot().grid
    image = map_image(run.map().grid())
    opacity, greys = decoded(shown)
    np.testing.assert_array_equal(greys, image.pixels)
    assert set(np.unique(opacity)) == {0, 255}
    assert shown.resolution == 0.05
    np.testing.assert_array_equal(shown.origin, image.origin)
    # The wall to the right stands at x = 3 m, and row 0 is at the top: y = 4 m is a wall as well.
    column = int((3.02 - shown.origin[0]) / 0.05)
    assert (greys[:, column] == OCCUPIED).sum() > 20
    row = shown.size[1] - 1 - int((4.02 - shown.origin[1]) / 0.05)
    assert row < 5
    assert (greys[row] == OCCUPIED).sum() > 20


def test_the_grid_is_painted_once_a_second_and_new_versions_are_new_pictures(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    view, run = begun()
    versions, pictures = [], {}
    results = list(make_results(50))
    for i in range(80):
        clock[0] += 0.1
        result = results[min(i, 49)]  # it stands in the end
        run.step(result)
        view._worker.join()
        grid = view.snapshot().grid
        if grid is not None:
            versions.append(grid.version)
            assert pictures.setdefault(grid.version, grid.png) == grid.png
    assert versions == sorted(versions)
    assert 3 <= len(pictures) <= 6  # five seconds, and none while it stands
    assert len(set(pictures.values())) == len(pictures)


def test_a_late_picture_of_the_previous_map_is_not_shown(monkeypatch):
    paint, gate = module.paint, threading.Event()

    def late(grid, version):
        gate.wait(10.0)
        return paint(grid, version)

    view, run = begun()
    monkeypatch.setattr(module, "paint", late)
    for result in make_results(3):
        run.step(result)
    other = Scripted(view)
    view.begin(other)
    gate.set()
    view._worker.join()
    gate.clear()  # the new map's first picture is late as well
    other.step(replace(next(make_results(1)), scan=None))
    assert view.snapshot().grid is None
    gate.set()
    view._worker.join()
    other.step(replace(next(make_results(1)), scan=None))
    assert view.snapshot().grid.size == (1, 1)  # nothing is known of it


# --------------------------------------------------------------------------- health


def test_the_health_is_that_of_the_run():
    """Also if the whole log has a fault, of which only the run knows."""
    view, run = begun()
    run.newest_health = lambda: (MISALIGNED, "turned by 5.0 deg")
    run.step(next(make_results(1)))
    assert (view.snapshot().state, view.snapshot().why) == ("DEGRADED", "turned by 5.0 deg")


class Words(Observer):
    """What `HealthMonitor` reports after each scan."""

    def __init__(self):
        self.said, self._monitor = [], HealthMonitor()

    def follow(self, track, path):
        self._monitor.follow(track, path)
        self.said.append(self._monitor.newest[1])

    def revise(self, keyframe, revision, path):
        self._monitor.revise(keyframe, revision, path)
        self.said.append(self._monitor.newest[1])


def said(*results, keyframe=True):
    words = Words()
    run = Scripted(words)
    for i, result in enumerate(results):
        run.step(result, keyframe=keyframe or i == 0)
    return words.said


def still(sigma, matched=True, seen=True):
    result = list(make_results(2))[1]
    scan = result.scan if seen else replace(result.scan, valid=np.zeros(90, bool))
    matches = result.matches if matched else ()
    return replace(result, covariance=np.diag([sigma**2, 0, 0]), matches=matches, scan=scan)


def test_a_robot_that_recognises_landmarks_is_not_lost_however_far_it_went():
    assert set(said(*(still(0.1 * np.sqrt(i)) for i in range(500)))) == {""}


@pytest.mark.parametrize("keyframe", [True, False])
def test_a_robot_that_recognises_nothing_is_reported_once_uncertain(keyframe):
    drive = [
        replace(still(np.hypot(3.0, 0.01 * i), matched=False), pose=np.array([0.1 * i, 0, 0]))
        for i in range(1, 40)
    ]
    reasons = said(still(3.0), *drive, keyframe=keyframe)[1:]
    assert reasons[24] == ""
    assert "no known feature was seen for" in reasons[25]
    assert "for 2.7 m" in reasons[26]
    assert said(still(3.0), *drive, still(3.01))[-1] == ""


def test_a_stationary_robot_without_landmarks_is_not_lost():
    assert set(said(*(still(0.1, matched=False) for _ in range(100)))) == {""}


def test_a_blind_lidar_and_a_non_finite_estimate_are_reported():
    assert "the lidar sees nothing" in said(still(0.1, matched=False, seen=False))[0]
    assert "not finite" in said(still(np.nan))[0]


# --------------------------------------------------------------------------- the path


def distances(points, polyline):
    """Return how far points (n, 2) are from a polyline (m, 2)."""
    a, b = polyline[:-1, None], polyline[1:, None]
    d = b - a
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.clip(((points - a) * d).sum(-1) / (d * d).sum(-1), 0.0, 1.0)
    t = np.nan_to_num(t)
    return np.linalg.norm(points - (a + t[..., None] * d), axis=-1).min(axis=0)


@pytest.mark.parametrize("laps", [1, 30])
def test_a_long_path_stays_near_and_small(laps):
    turn = np.linspace(0.0, 2 * np.pi * laps, 3000 * laps)
    truth = np.c_[(2 + 0.1 * np.sin(7.1 * turn)) * np.cos(turn), 2 * np.sin(turn)]
    path, most = ThinPath(limit=400), 0
    for x, y in truth:
        path.add(x, y)
        most = max(most, len(path.points))
    kept = path.points.astype(np.float64)
    assert most <= 401
    assert distances(truth[::7], kept).max() < 3 * path.tolerance
    assert path.tolerance < (0.02 if laps == 1 else 0.7)
    np.testing.assert_allclose(kept[0], truth[0], atol=1e-6)
    np.testing.assert_allclose(kept[-1], truth[-1], atol=1e-6)


def test_a_straight_path_is_a_few_points_however_long():
    path = ThinPath(limit=1000)
    for x in np.arange(0.0, 500.0, 0.02):
        path.add(x, 1.0)
    assert path.tolerance == 0.01
    path._thin()
    assert len(path.points) < 40  # one a thousand, where two parts join


def test_a_stationary_robot_adds_no_points():
    path = ThinPath(limit=50)
    for i in range(10_000):
        path.add(1.0 + 0.004 * np.sin(i), 2.0)
    assert len(path.points) == 2  # where it stands, and where it is


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*(st.one_of(st.integers(-3, 3), st.floats(-50, 50)),) * 2), max_size=120))
def test_any_path_is_kept_within_three_tolerances(points):
    """Also one that comes back to the same spot, where cv2 sees a closed curve."""
    path = ThinPath(limit=20)
    for x, y in points:
        path.add(x, y)
    kept = path.points.astype(np.float64)
    assert len(kept) <= 21
    if points:
        assert len(kept) >= 1
        polyline = np.vstack([kept[:1], kept])
        assert distances(np.array(points, float), polyline).max() < 3 * path.tolerance + 1e-4
        np.testing.assert_allclose(kept[-1], points[-1], rtol=1e-6, atol=1e-6)


def test_a_non_finite_pose_is_left_out_of_the_path():
    path = ThinPath()
    for x in (0.0, np.nan, 1.0, np.inf):
        path.add(x, 0.0)
    np.testing.assert_array_equal(path.points, [[0, 0], [1, 0], [1, 0]])


def test_a_non_finite_result_does_not_break_the_view():
    view, run = begun()
    run.step(
        replace(next(make_results(1)), pose=np.full(3, np.nan), covariance=np.full((3, 3), np.nan))
    )
    assert "not finite" in view.snapshot().why
