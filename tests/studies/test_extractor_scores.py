"""Judging: constructed scans with known answers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from impslam.studies.corridor_truth import MAX_WALL_TURN
from impslam.studies.extractor_scores import (
    MAX_DISTANCE,
    Counts,
    Detection,
    known_association,
    score_scan,
)
from impslam.studies.extractor_stats import ExtractorScore, mean, rms, typical_ratio
from impslam.studies.labelled_scans import LabelledScan, Seen
from impslam.types import Observation, Scan

N = 100
ORIGIN, SIGMA = np.zeros(2), 0.005


def labelled(*seen):
    """Return an exact scan of a wall at x = 2 (beams 0-49) and a cylinder (60-79), and the truth."""
    directions = np.linspace(-0.6, 0.6, N)
    ranges = np.full(N, 5.0)
    ranges[:50] = 2.0 / np.cos(directions[:50])
    centre = 1.5 * np.array([math.cos(directions[70]), math.sin(directions[70])])
    across = 1.5 * np.sin(directions[60:80] - directions[70])
    ranges[60:80] = 1.5 * np.cos(directions[60:80] - directions[70]) - np.sqrt(0.2**2 - across**2)
    points = ranges[:, None] * np.column_stack((np.cos(directions), np.sin(directions)))
    scan = Scan(
        0.0, directions, ranges, np.ones(N, bool), points, directions, np.zeros((N, 2)),
        np.full(N, SIGMA), 0.0, 10.0, np.zeros(3),
    )  # fmt: skip
    wall = Seen("wall", "wall", np.array([2.0, 0.0]), math.nan, points[[0, 49]], np.arange(50))
    post = Seen("cylinder", "cylinder", centre, 0.2, points[[60, 79]], np.arange(60, 80), True)
    return LabelledScan(
        scan, (wall, post, *seen), np.zeros((N, 2)), directions, np.full(N, SIGMA), 0.0
    )


def wall(rho, alpha, beams):
    return Observation("wall", np.array([rho, alpha]), np.eye(2) * 1e-4, np.asarray(beams))


def post(truth, shift, beams=range(60, 80), radius=0.2):
    centre = truth.seen[1].z + shift
    return Observation(
        "cylinder", centre, np.eye(2) * 1e-4, np.asarray(beams), None, {"radius": radius}
    )


def test_the_truth_is_found():
    truth = labelled()
    counts, (found,) = score_scan(truth, "wall", [wall(2.01, 0.02, range(5, 50))])
    assert counts == Counts(visible=1, found=1, again=0, other=0, false=0)
    np.testing.assert_allclose(found.error, [0.01, 0.02])
    assert found.beams == 50
    assert found.used == 0.9
    all_ = found.error @ np.linalg.solve(found.bound, found.error)
    assert 0.6 * all_ < found.own_excess < all_  # 45 of 50 beams, the outermost left out


def test_nothing_seen_nothing_found():
    counts, found = score_scan(labelled(), "wall", [])
    assert counts == Counts(1, 0, 0, 0, 0)
    assert found == []


@pytest.mark.parametrize(
    "observed",
    [
        wall(2.0 + 1.5 * MAX_DISTANCE, 0.0, range(50)),  # too far off
        wall(2.0, 1.2 * MAX_WALL_TURN, range(50)),  # turned too far
        wall(2.0, 0.0, range(25, 85)),  # most of its beams are of something else
        wall(2.0, 0.0, range(50, 60)),  # all of them are
        wall(2.0, math.pi, range(50)),  # the wall's other side
    ],
)
def test_what_is_not_there_is_false(observed):
    assert score_scan(labelled(), "wall", [observed])[0] == Counts(1, 0, 0, 0, 1)


def test_a_wall_is_found_once_by_the_observation_of_most_beams():
    some = [wall(2.05, 0.0, range(10)), wall(2.02, 0.0, range(10, 50)), wall(1.9, 0.5, range(10))]
    counts, (found,) = score_scan(labelled(), "wall", some)
    assert counts == Counts(visible=1, found=1, again=1, other=0, false=1)
    assert found.error[0] == pytest.approx(0.02)


def test_doors_and_what_is_hardly_seen_are_other():
    line = np.array([3.0, 0.0])
    door = Seen(
        "door", "wall", line, math.nan, np.array([[3.0, 0.1], [3.0, 0.9]]), np.arange(50, 60)
    )
    stub = replace(door, thing="wall", beams=np.arange(80, 89))
    truth = labelled(door, stub)
    some = [wall(3.01, 0.0, range(50, 60)), wall(3.01, 0.0, range(80, 89))]
    assert score_scan(truth, "wall", some)[0] == Counts(
        visible=1, found=0, again=0, other=2, false=0
    )


def test_beams_may_be_left_out():
    """A plug-in need not tell them: then the place decides."""
    counts, (found,) = score_scan(labelled(), "wall", [wall(2.01, 0.0, np.empty(0, np.int64))])
    assert counts.found == 1
    assert found.used == 0.0
    assert math.isnan(found.own_excess)


def test_normals_are_compared_as_angles():
    """By +-pi."""
    truth = labelled()
    behind = replace(truth.seen[0], z=np.array([2.0, math.pi]), ends=-truth.seen[0].ends)
    turned = replace(truth, seen=(behind,), directions=truth.directions + math.pi)
    _, (found,) = score_scan(turned, "wall", [wall(2.0, -math.pi + 0.01, range(50))])
    np.testing.assert_allclose(found.error, [0.0, 0.01], atol=1e-12)


def test_cylinders_have_centre_and_radius():
    truth = labelled()
    sight = truth.seen[1].z / 1.5
    counts, (found,) = score_scan(truth, "cylinder", [post(truth, 0.02 * sight, radius=0.23)])
    assert counts == Counts(1, 1, 0, 0, 0, whole=1, whole_found=1)
    assert found.radial == pytest.approx(0.02)
    assert found.radius_error == pytest.approx(0.03)
    assert 0.0 < found.radius_bound < 0.01
    assert score_scan(truth, "cylinder", [post(truth, 0.11 * sight)])[0].false == 1


def test_a_radius_that_is_known_is_not_measured():
    truth = labelled()
    (free,) = score_scan(truth, "cylinder", [post(truth, np.zeros(2))])[1]
    (found,) = score_scan(truth, "cylinder", [post(truth, np.zeros(2))], radius=0.2)[1]
    assert math.isnan(found.radius_error)
    assert (np.diag(found.bound) < np.diag(free.bound)).all()
    counts, left_out = score_scan(truth, "cylinder", [post(truth, np.zeros(2))], radius=0.15)
    assert counts.found == 1
    assert left_out == []


def test_known_association_is_exact_without_noise():
    truth = labelled()
    for kind in ("wall", "cylinder"):
        counts, (found,) = score_scan(truth, kind, known_association(truth, kind))
        assert counts[:5] == (1, 1, 0, 0, 0)
        np.testing.assert_allclose(found.error, 0.0, atol=1e-8)
        np.testing.assert_allclose(found.R, found.bound, rtol=0.05)


def entry(error, bound=1.0, R=1.0):
    return Detection(
        np.asarray(error, float), R * np.eye(2), bound * np.eye(2), 0.0, 0.1, 0.04, 10, 1.0, 2.0
    )


def test_scores_add_up():
    one = ExtractorScore.of([(Counts(2, 1, 1, 0, 3), [entry([1.0, 0.0])])])
    two = ExtractorScore.of([(Counts(4, 4, 0, 2, 0), [entry([0.0, 2.0]), entry([0.0, 0.0])])])
    both = one + two
    assert both.true_positives[0] == pytest.approx(5 / 6)
    assert both.rate("false")[0] == 1.5
    assert both.rate("false")[1] == pytest.approx(np.std([3, 0], ddof=1) / math.sqrt(2))
    assert both.metrics()["ratio_0"].value == pytest.approx(math.sqrt(1 / 3))
    assert both.metrics()["ratio_1"].value == pytest.approx(math.sqrt(4 / 3))
    assert both.metrics()["radius_ratio"].value == pytest.approx(0.5)
    np.testing.assert_allclose(both.nees, [1.0, 4.0, 0.0])


def test_ratios_of_an_efficient_estimator_are_one():
    rng = np.random.default_rng(0)
    L = np.linalg.cholesky([[4.0, 1.0], [1.0, 0.5]])
    score = ExtractorScore.of(
        [
            (Counts(1, 1, 0, 0, 0), [replace(entry(L @ z), bound=L @ L.T, R=4 * L @ L.T)])
            for z in rng.standard_normal((4000, 2))
        ]
    )
    for ratio, error in (score.metrics()[name] for name in ("ratio_0", "ratio_1", "ratio")):
        assert ratio == pytest.approx(1.0, abs=0.05)
        assert abs(ratio - 1.0) < 4.0 * error < 0.06
    assert typical_ratio(score.excess) == pytest.approx(1.0, abs=0.05)
    assert mean(score.nees)[0] == pytest.approx(0.5, abs=0.05)


def test_nothing_found_has_no_errors():
    empty = ExtractorScore.of([(Counts(1, 0, 0, 0, 0), [])])
    assert math.isnan(rms(empty.errors[:, 0])[0])
    assert math.isnan(typical_ratio(empty.excess))
    assert empty.true_positives == (0.0, 0.0)
    assert math.isnan(empty.whole_found[0])
