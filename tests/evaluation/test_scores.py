"""Scores of whole runs: frames, what covariances are compared with, and pictures of them."""

import numpy as np
import pytest

from impslam.errors import ImpError
from impslam.evaluation.comparison_plot import COLOURS, draw_comparison
from impslam.evaluation.landmarks import transform_landmarks, true_wall
from impslam.evaluation.relations import relation_errors
from impslam.evaluation.run_files import RecordedRun, read_run
from impslam.evaluation.scores import score_kinds, score_path
from impslam.evaluation.tum import PATH_COLUMNS, write_tum
from impslam.geometry.se2 import compose
from impslam.types import Landmark, TrueLandmark

FRAME = np.array([30.0, -8.0, 2.0])
P = np.array([[0.04, 0.01, 0.002], [0.01, 0.02, -0.001], [0.002, -0.001, 0.0005]])


def way(n=400):
    t = 0.1 * np.arange(n)
    return np.c_[t, 0.3 * t, np.sin(0.2 * t), 0.1 * t]


def in_frame(rows, T=FRAME):
    return np.c_[rows[:, 0], compose(T, rows[:, 1:])]


def noisy(rng, n=4000):
    """A run whose first pose is exact and whose errors afterwards have covariance P."""
    truth = way(n)
    errors = rng.multivariate_normal(np.zeros(3), P, n)
    errors[0] = 0.0
    return RecordedRun(truth + np.c_[np.zeros(n), errors], np.tile(P, (n, 1, 1))), truth


def positions(rows):
    return np.c_[rows[:, :3], np.full(len(rows), np.nan)]


def test_errors_as_its_covariance_says_have_the_mean_and_share_of_chi_square(rng):
    run, truth = noisy(rng)
    sure = score_path(run, truth, "fit", 1.0).consistency
    assert sure.dof == 3
    assert sure.mean == pytest.approx(3.0, abs=5 * (6 / 4000) ** 0.5)
    assert sure.within == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize("align", ["fit", "start"])
def test_normalised_errors_count_from_the_start_in_any_frame_of_the_truth(rng, align):
    run, truth = noisy(rng)
    here = score_path(run, truth, align, 1.0).consistency
    there = score_path(run, in_frame(truth), align, 1.0).consistency
    assert there.mean == pytest.approx(here.mean, rel=1e-6)
    assert there.within == here.within


def test_normalised_errors_are_not_those_of_the_best_fit():
    """A path turned about its start by 3 sigma is 9 off, though it fits perfectly."""
    truth = way()
    turned = in_frame(truth, np.array([0.0, 0.0, 0.03]))
    turned[0] = truth[0]
    P_turn = np.diag([1e6, 1e6, 1e-4])
    score = score_path(RecordedRun(turned, np.tile(P_turn, (400, 1, 1))), truth, "fit", 1.0)
    assert score.consistency.mean == pytest.approx(9.0, rel=1e-4)
    assert score.aligned.rmse < 1e-3


def test_where_headings_are_lost_two_degrees_of_freedom_remain(rng):
    run, truth = noisy(rng)
    truth[100:200, 3] = np.nan
    sure = score_path(run, truth, "fit", 1.0).consistency
    assert sure.dof == 2
    assert sure.mean == pytest.approx(2.0, abs=5 * (4 / 4000) ** 0.5)
    assert sure.within == pytest.approx(0.95, abs=0.02)


def test_positions_give_no_start_but_a_truth_in_map_needs_none(rng):
    run, truth = noisy(rng)
    score = score_path(run, positions(in_frame(truth)), "fit", 1.0)
    assert score.consistency is None
    assert score.heading.count == 0
    assert score.rpe_metres.count == 0
    assert 0.1 < score.aligned.rmse < 0.4
    with pytest.raises(ImpError, match="no heading at the start of the run"):
        score_path(run, positions(truth), "start", 1.0)
    sure = score_path(run, positions(truth), "none", 1.0).consistency
    assert (sure.dof, round(sure.mean, 1)) == (2, 2.0)


def test_the_robot_at_rest_at_its_start_is_not_counted():
    rows = way(100)
    rows[:40, 1:] = 0.0
    covariances = np.tile(1e-12 * np.eye(3), (100, 1, 1))
    truth = rows + [0, 1e-5, 0, 0] * (np.arange(100) == 20)[:, None]
    sure = score_path(RecordedRun(rows, covariances), truth, "fit", 1.0).consistency
    assert sure.count == 60
    assert sure.mean == pytest.approx(0.0, abs=1e-3)


def test_alignments():
    truth, run = in_frame(way()), RecordedRun(way())
    run.path[0, 1] += 0.5  # the first pose is off
    assert score_path(run, truth, "none", 1.0).aligned.rmse > 20.0
    assert score_path(run, truth, "fit", 1.0).aligned.rmse < 0.05
    at_start = score_path(run, truth, "start", 1.0)
    assert at_start.aligned.max == pytest.approx(0.5)
    assert at_start.consistency is None
    assert score_path(run, truth, "fit", 1e4).rpe_metres is None


def point(i, x, y, covariance=None):
    P_ = 0.01 * np.eye(2) if covariance is None else covariance
    return Landmark(i, "cylinder", np.array([x, y]), {"radius": 0.1}, P_, None, 5, 0.0, 1.0)


def true_point(name, x, y):
    return TrueLandmark(name, "cylinder", np.array([x, y], float), {"radius": 0.1})


def test_landmarks_are_compared_in_the_frame_of_the_path():
    known = [true_point("a", 1, 2), true_point("b", 3, -1), true_point("gone", 9, 9)]
    north = np.array([[0.0, 4.0], [5.0, 4.0]])
    wall = true_wall("north", north)
    map_wall = Landmark(
        9, "wall", wall.position, dict(wall.parameters), np.eye(2), north, 5, 0.0, 1.0
    )
    found = [point(1, 1.1, 2), point(2, 3, -1), point(3, 1.2, 2), point(4, -5, -5), map_wall]
    path = score_path(RecordedRun(way()), in_frame(way()), "fit", 1.0)
    cylinders, walls = score_kinds(found, transform_landmarks(FRAME, [*known, wall]), path)
    assert (cylinders.true, cylinders.missing, cylinders.false, cylinders.doubles) == (3, 1, 1, 1)
    assert cylinders.distance.max == pytest.approx(0.1)
    assert cylinders.distance.rmse == pytest.approx(0.1 / 2**0.5)
    assert cylinders.nees == pytest.approx(0.5)  # (0.1^2 / 0.01 + 0) / 2
    assert (walls.true, walls.missing) == (1, 0)
    assert walls.distance.max < 1e-9
    assert walls.nees < 1e-9
    assert score_kinds(found, known, None)[0].distance.max == pytest.approx(0.1)


def test_landmarks_as_their_covariance_says_have_a_mean_of_two(rng):
    covariance = P[:2, :2]
    places = rng.uniform(-500, 500, (500, 2))
    errors = rng.multivariate_normal(np.zeros(2), covariance, 500)
    found = [point(i, *place, covariance) for i, place in enumerate(places + errors)]
    (score,) = score_kinds(
        found, [true_point(str(i), *p) for i, p in enumerate(places)], None, gate=2.0
    )
    assert score.nees == pytest.approx(2.0, abs=5 * (4 / 500) ** 0.5)


def test_landmarks_have_no_normalised_errors_without_a_true_start():
    path = score_path(RecordedRun(way()), positions(way()), "fit", 1.0)
    (score,) = score_kinds([point(1, 1.0, 2.0)], [true_point("a", 1, 2)], path)
    assert score.distance.count == 1
    assert np.isnan(score.nees)


def write_run(folder, rows):
    folder.mkdir()
    write_tum(folder / "trajectory.tum", rows)
    cells = "\n".join(",".join(f"{v:.9f}" for v in [*row, 1, 2, 3, 4, 5, 6]) for row in rows)
    (folder / "trajectory.csv").write_text(f"{PATH_COLUMNS}\n{cells}\n")


def test_a_run_is_read_with_what_it_has(tmp_path):
    write_run(tmp_path / "run", way(5))
    run = read_run(tmp_path / "run")
    np.testing.assert_allclose(run.path, way(5), atol=1e-8)
    np.testing.assert_array_equal(run.covariances[4], [[1, 2, 3], [2, 4, 5], [3, 5, 6]])
    assert run.landmarks is run.truth is run.true_landmarks is None
    bare = read_run(tmp_path / "run" / "trajectory.tum")
    assert bare.covariances is None


def test_files_that_do_not_belong_together_are_one_line(tmp_path):
    write_run(tmp_path / "run", way(5))
    write_tum(tmp_path / "run" / "trajectory.tum", way(6))
    with pytest.raises(ImpError, match="other stamps"):
        read_run(tmp_path / "run")
    (tmp_path / "run" / "trajectory.csv").write_text("stamp,x\n")
    with pytest.raises(ImpError, match="does not begin with 'stamp,x,y,theta"):
        read_run(tmp_path / "run")


def picture(paths, runs=None, relations=None):
    runs = runs or {name: way() for name in paths}
    return draw_comparison(runs, paths, relations or {}, "fitted to the truth")


def test_the_picture_shows_the_truth_and_each_run_with_its_errors(tmp_path):
    truth = np.delete(way(), np.arange(100, 150), axis=0)
    off = way() + np.array([0, 0.5, 0, 0]) * np.sin(way()[:, :1])
    scores = {
        "good": score_path(RecordedRun(way()), truth, "fit", 1.0),
        "x" * 50 + "end": score_path(RecordedRun(off), truth, "fit", 1.0),
    }
    figure = picture(scores)
    _, errors = figure.axes
    assert [line.get_color() for line in errors.lines] == list(COLOURS[:2])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[:2] == ["truth", "good"]
    assert len(labels[2]) <= 30
    assert labels[2].endswith("end")
    drawn = errors.lines[1].get_ydata()
    assert np.isnan(drawn).sum() == 1  # the hole in the truth is not bridged
    assert np.nanmax(drawn) == pytest.approx(scores["x" * 50 + "end"].aligned.max)
    figure.savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_poses_far_apart_in_time_are_joined_if_none_between_them_lacks_the_truth():
    scores = {"sparse": score_path(RecordedRun(way()[::20]), way(), "fit", 1.0)}
    _, errors = picture(scores, {"sparse": way()[::20]}).axes
    assert np.isfinite(errors.lines[0].get_ydata()).all()


def test_relations_are_drawn_as_shares(tmp_path):
    rows, late = way(), way() + np.array([1e6, 0, 0, 0])
    relations = np.array([[0.0, 1.0, *way()[10, 1:]], [0.0, 2.0, *(way()[20, 1:] + [0.5, 0, 0])]])
    errors = {"a": relation_errors(rows, relations)}
    figure = picture({}, {"a": rows, "b": in_frame(rows), "late": late}, errors)
    paths, shares = figure.axes
    np.testing.assert_allclose(paths.lines[1].get_xdata(), rows[:, 1], atol=1e-9)
    x, y = shares.lines[0].get_data()
    np.testing.assert_allclose(x[1:], [1e-3, 0.5], rtol=1e-6)
    np.testing.assert_allclose(y, [0, 0.5, 1.0])
    figure.savefig(tmp_path / "a.png")


def test_a_robot_that_stood_still_without_any_error_can_be_drawn(tmp_path):
    rows = np.c_[np.arange(5.0), np.zeros((5, 3))]
    figure = picture({"a": score_path(RecordedRun(rows), rows, "fit", 1.0)}, {"a": rows})
    np.testing.assert_array_equal(figure.axes[1].lines[0].get_ydata(), np.zeros(5))
    figure.savefig(tmp_path / "a.png")
    errors = {"a": relation_errors(rows, np.array([[0.0, 1.0, 0, 0, 0]]))}
    figure = picture({}, {"a": rows}, errors)
    share = figure.axes[1].lines[0].get_ydata()
    assert share[-1] == 1.0, "all relations have at most the smallest error on the axis"
    figure.savefig(tmp_path / "b.png")


def test_the_alignment_of_a_run_is_returned():
    path = score_path(RecordedRun(way()), in_frame(way()), "fit", 1.0)
    np.testing.assert_allclose(path.T_truth_map, FRAME, atol=1e-6)
    np.testing.assert_allclose(path.T_truth_start, FRAME, atol=1e-9)
    np.testing.assert_allclose(compose(path.T_truth_start, way()[0, 1:]), path.pairs.truth[0])
