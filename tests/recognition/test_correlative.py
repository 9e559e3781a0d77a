"""Branch and bound finds what trying every pose finds."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.geometry.angles import wrap
from impslam.recognition.correlative import HEADING_SEPARATION, SEPARATION, Window, search
from impslam.recognition.pyramid import BLUR, CELL, SECTOR, GridMemory, build

STEP = 0.1  # rad: coarse, for every pose is tried


def points_of(rng, n, extent):
    return np.column_stack([rng.uniform(-extent, extent, (n, 2)), np.zeros((n, 3))]).astype("f4")


def surfaces_of(rng, n, extent):
    """Return points with random normals, a third of which have no weight."""
    facing, weights = rng.uniform(-math.pi, math.pi, n), rng.choice([0.0, 0.5, 1.0], n)
    points = points_of(rng, n, extent)
    points[:, 2:] = np.column_stack([np.cos(facing), np.sin(facing), weights])
    return points


def likelihoods(pyramid, points, heading, row, column):
    """Return those of points in some cells, by the directions of their normals at a heading."""
    facing = np.arctan2(points[:, 3], points[:, 2]) + heading
    side = np.floor(facing / SECTOR + 0.5).astype(int) % 4
    on_side, on_any = pyramid.facing[side, row, column], pyramid.levels[0, row, column]
    return np.where(points[:, 4] > 0.0, on_side, on_any).astype(int)


def every(pyramid, points, guess, window, exclude=None):
    """Yield the score and pose of every cell of the window."""
    ground, n = pyramid.levels[0], math.ceil(window.heading / STEP - 1e-9)
    height, width = ground.shape
    shifts = [np.arange(-m, m + 1) for m in (round(window.x / CELL), round(window.y / CELL))]
    for heading in guess[2] + np.arange(-n, n + 1) * STEP:
        c, s = math.cos(heading), math.sin(heading)
        x, y = points[:, 0].astype(float), points[:, 1].astype(float)
        column = np.floor((guess[0] - pyramid.corner[0] + c * x - s * y) / CELL).astype(int)
        row = np.floor((guess[1] - pyramid.corner[1] + s * x + c * y) / CELL).astype(int)
        for u in shifts[0]:
            for v in shifts[1]:
                pose = np.array([guess[0] + u * CELL, guess[1] + v * CELL, heading])
                if exclude is not None and (
                    math.dist(pose[:2], exclude[:2]) < SEPARATION
                    and abs(heading - exclude[2]) < HEADING_SEPARATION
                ):
                    continue
                inside = (column + u >= 0) & (column + u < width)
                inside &= (row + v >= 0) & (row + v < height)
                some = points[inside], heading, row[inside] + v, column[inside] + u
                sums = likelihoods(pyramid, *some).sum()
                yield sums / (255 * len(points)), np.array([*pose[:2], wrap(pose[2])])


def assert_best(pyramid, points, guess, window, exclude=None):
    scored = list(every(pyramid, points, guess, window, exclude))
    best = max((score for score, _ in scored), default=0.0)
    peak = search(pyramid, points, guess, window, exclude=exclude, turn=STEP)
    assert peak.score == best
    at_peak = [score for score, pose in scored if np.allclose(pose, peak.pose, atol=1e-9)]
    assert at_peak == [best] or best == 0.0


@pytest.mark.parametrize("made", [points_of, surfaces_of])
@pytest.mark.parametrize("level", range(5))
@given(
    seed=st.integers(0, 2**32 - 1),
    far=st.floats(0.0, 3.0),
    size=st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(0, 2)),
)
def test_search_equals_trying_every_pose(made, level, seed, far, size):
    rng = np.random.default_rng(seed)
    pyramid = build(made(rng, 30, 1.5), level)
    points = made(rng, 12, 1.2)
    guess = np.array([*rng.uniform(-far, far, 2), rng.uniform(-3.0, 3.0)])
    window = Window(size[0] * CELL, size[1] * CELL, size[2] * STEP)
    assert_best(pyramid, points, guess, window)
    assert_best(pyramid, points, guess, window, guess + np.array([0.13, -0.21, STEP]))


def test_a_level_holds_the_greatest_of_its_blocks(rng):
    pyramid = build(points_of(rng, 20, 1.0), 3)
    ground = pyramid.levels[0]
    assert ground.max() == 255
    for level, above in enumerate(pyramid.levels):
        for row, column in np.ndindex(ground.shape):
            block = ground[row : row + 2**level, column : column + 2**level]
            assert above[row, column] == block.max()


def test_likelihood_is_gaussian_around_a_point():
    pyramid = build(np.array([[0.05, 0.05, 0, 0, 0]], "f4"), 0)
    row, column = np.floor((0.05 - pyramid.corner[::-1]) / CELL).astype(int)
    for dr, dc in ((0, 0), (0, 1), (2, -1), (2, 2)):
        likelihood = math.exp(-(dr**2 + dc**2) * CELL**2 / (2.0 * BLUR**2))
        assert pyramid.levels[0][row + dr, column + dc] == pytest.approx(255 * likelihood, abs=0.51)


def test_the_back_of_a_wall_is_not_its_front():
    wall = np.zeros((40, 5), "f4")
    wall[:, 0], wall[:, 3:] = np.linspace(-2.0, 2.0, 40), 1.0
    front, window = build(wall, 2), Window(0.3, 0.3, 0.1)
    back = wall * np.array([1, 1, 1, -1, 1], "f4")
    assert search(front, wall, np.zeros(3), window).score == 1.0
    assert search(front, back, np.zeros(3), window).score == 0.0
    back[:, 4] = 0.0  # seen obliquely: its side is not known well
    assert search(front, back, np.zeros(3), window).score == 1.0


def test_normals_of_one_surface_may_differ_by_45_degrees():
    for facing in np.radians(np.arange(0.5, 360.0, 5.0)):
        a, b = facing, facing + math.radians(44.0)
        one, other = (np.array([[0.05, 0.05, math.cos(n), math.sin(n), 1.0]], "f4") for n in (a, b))
        assert search(build(other, 0), one, np.zeros(3), Window(0.0, 0.0, 0.0)).score == 1.0


def test_a_score_must_exceed_the_least(rng):
    points = points_of(rng, 40, 2.0)
    pyramid, guess, window = build(points, 2), np.zeros(3), Window(0.5, 0.5, 0.1)
    best = search(pyramid, points, guess, window).score
    assert best == 1.0
    assert search(pyramid, points, guess, window, 0.999).score == best
    assert search(pyramid, points, guess, window, 1.0).score == 0.0


def test_all_around(rng):
    points = points_of(rng, 60, 3.0)
    pyramid = build(points, 4)
    for heading in rng.uniform(-math.pi, math.pi, 5):
        guess = np.array([1.3, -2.1, heading])
        peak = search(pyramid, points, guess, Window(3.0, 3.0, math.pi), 0.5)
        np.testing.assert_allclose(peak.pose, 0.0, atol=0.1)


def test_memory_is_used_again_and_leaves_no_trace(rng):
    memory = GridMemory()
    first = build(points_of(rng, 50, 4.0), 4, memory).levels
    points = points_of(rng, 20, 1.0)
    again = build(points, 3, memory).levels
    assert np.shares_memory(first, again)
    np.testing.assert_array_equal(again, build(points, 3).levels)
