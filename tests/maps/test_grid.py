"""The occupancy grid: what one beam does, to the cell, and what never happens."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.maps import grid as module
from impslam.maps.files import FREE as FREE_PIXEL
from impslam.maps.files import OCCUPIED as OCCUPIED_PIXEL
from impslam.maps.files import UNKNOWN as UNKNOWN_PIXEL
from impslam.maps.files import map_image
from impslam.maps.grid import BALANCED, DRAWN, OccupancyGrid, PlacedScans

HIT, MISS, CLAMP = DRAWN
OCCUPIED, FREE = np.log(0.65 / 0.35), np.log(0.196 / 0.804)


def placed(pose, points, origin=(0.0, 0.0)):
    points = np.array(points, np.float32).reshape(-1, 2)
    return np.array(pose, float), np.array(origin, float), points


def draw(grid, *scans):
    """Draw scans one after the other, as a live map does; each is (pose, origin, points)."""
    for k in range(1, len(scans) + 1):
        poses, origins, points = zip(*scans[:k], strict=True)
        starts = np.cumsum([0, *map(len, points)])
        grid.draw(PlacedScans(np.array(poses), np.array(origins), starts, np.concatenate(points)))


def value(grid, x, y):
    column, row = np.floor(np.array([x, y]) / grid.resolution).astype(int) - grid.corner
    return float(grid.logodds[row, column])


def test_a_beam_frees_the_cells_before_its_end_and_fills_the_end():
    grid = OccupancyGrid(0.1)
    draw(grid, placed([0.05, 0.05, 0.0], [[1.0, 0.0]]))
    assert value(grid, 1.05, 0.05) == pytest.approx(HIT)
    for x in np.arange(0.05, 1.0, 0.1):
        assert value(grid, x, 0.05) == pytest.approx(MISS)
    assert np.count_nonzero(grid.logodds) == 11
    assert value(grid, 1.15, 0.05) == 0.0


def test_beams_are_traced_from_the_laser():
    grid = OccupancyGrid(0.1)
    draw(grid, placed([0.05, 0.05, 0.0], [[1.0, 0.0]], origin=[0.5, 0.0]))
    assert value(grid, 0.35, 0.05) == 0.0
    assert value(grid, 0.65, 0.05) == pytest.approx(MISS)


def test_the_pose_turns_and_moves_the_scan():
    grid = OccupancyGrid(0.1)
    draw(grid, placed([2.05, -3.05, np.pi / 2], [[1.0, 0.0]]))
    assert value(grid, 2.05, -2.05) == pytest.approx(HIT)


def test_a_scan_without_beams_does_nothing():
    grid = OccupancyGrid()
    draw(grid, placed([0, 0, 0], []), placed([1, 0, 0], []))
    assert grid.logodds.size == 0
    assert grid.refused == 0


def test_a_cell_changes_once_a_scan_and_an_end_outweighs_what_passes():
    grid = OccupancyGrid(0.1)
    grazing = [[1.0, 0.0], [1.5, 0.001], [1.5, -0.001], [1.5, 0.0]]
    draw(grid, placed([0.05, 0.05, 0.0], grazing))
    assert value(grid, 1.05, 0.05) == pytest.approx(HIT)
    assert value(grid, 0.25, 0.05) == pytest.approx(MISS)


eighths = st.integers(-24, 24).map(lambda n: n / 8 + 1 / 64)


@settings(max_examples=200, deadline=None)
@given(st.tuples(eighths, eighths), st.tuples(eighths, eighths))
def test_the_cells_of_any_beam_are_a_chain_from_its_start_to_its_end(start, end):
    grid = OccupancyGrid(0.25)
    draw(grid, placed([0, 0, 0], [end], start))
    first, last = (np.floor(np.array(p) / 0.25).astype(int) for p in (start, end))
    assert np.count_nonzero(grid.logodds) == np.abs(last - first).max() + 1
    rows, columns = np.nonzero(grid.logodds)
    centres = (np.c_[columns, rows] + grid.corner + 0.5) * 0.25
    direction = np.subtract(end, start)
    if np.hypot(*direction) > 1e-6:
        normal = np.array([-direction[1], direction[0]]) / np.hypot(*direction)
        assert np.abs((centres - start) @ normal).max() <= 0.25 * (np.sqrt(0.5) + 0.5)
    assert value(grid, *end) == pytest.approx(HIT)


def test_growing_in_every_direction_loses_nothing():
    grid = OccupancyGrid()
    ends = 30.0 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, -1]]) + 0.01
    scans = [placed([0.001 + 0.02 * i, 0.001, 0.0], [end]) for i, end in enumerate(ends)]
    for k in range(1, len(scans) + 1):
        draw(grid, *scans[:k])
        for j in range(k):
            assert value(grid, ends[j][0] + 0.001 + 0.02 * j, ends[j][1] + 0.001) > 0.0


def test_what_is_drawn_at_once_is_what_is_drawn_scan_by_scan(rng):
    scans = [
        placed([*rng.uniform(-3, 3, 2), rng.uniform(-3, 3)], rng.uniform(-5, 5, (40, 2)))
        for _ in range(20)
    ]
    single, whole = OccupancyGrid(), OccupancyGrid()
    draw(single, *scans)
    poses, origins, points = zip(*scans, strict=True)
    starts = np.cumsum([0, *map(len, points)])
    whole.draw(PlacedScans(np.array(poses), np.array(origins), starts, np.concatenate(points)))
    a, b = map_image(single), map_image(whole)
    np.testing.assert_array_equal(a.pixels, b.pixels)
    np.testing.assert_allclose(a.origin, b.origin)


def test_scans_that_moved_are_drawn_again():
    before, after = OccupancyGrid(0.1), OccupancyGrid(0.1)
    first, second = placed([0.05, 0.05, 0.0], [[1.0, 0.0]]), placed([1.05, 0.05, 0.0], [[1.0, 0.0]])
    moved = placed([0.05, 0.55, 0.0], [[1.0, 0.0]])
    draw(before, first, second)
    draw(before, moved, second)
    draw(after, moved, second)
    np.testing.assert_array_equal(map_image(before).pixels, map_image(after).pixels)
    assert value(before, 0.55, 0.05) == 0.0


def test_log_odds_are_bounded():
    grid = OccupancyGrid()
    draw(grid, *(placed([0.0, 0.011 * (i % 2), 0.0], [[1.0, 0.0]]) for i in range(100)))
    assert abs(grid.logodds).max() == pytest.approx(CLAMP)


def seen(hits, passes, model=DRAWN):
    """Return the log-odds of a cell that is hit and passed through, in turn and evenly spread."""
    grid, scans = OccupancyGrid(0.1, model), []
    ends = np.arange(hits + passes) * hits // (hits + passes)
    for i, ends_here in enumerate(np.diff(np.append(ends, hits)) > 0):
        scans.append(placed([0.05, 0.02 * (i % 2), 0.0], [[1.0 if ends_here else 2.0, 0.03]]))
    draw(grid, *scans)
    return value(grid, 1.05, 0.05)


@pytest.mark.parametrize(("hits", "passes"), [(1, 1), (10, 15), (10, 19)])
def test_a_cell_that_more_than_a_third_of_the_scans_hit_is_occupied(hits, passes):
    assert seen(hits, passes) > OCCUPIED


def test_a_cell_that_fewer_hit_is_not():
    assert seen(10, 40) < OCCUPIED


def test_two_passes_make_a_cell_free():
    assert seen(0, 2) < FREE < seen(0, 1)


def pixel(grid, x, y):
    image = map_image(grid)
    column, row = np.floor((np.array([x, y]) - image.origin) / image.resolution).astype(int)
    return image.pixels[::-1][row, column]


def test_a_single_scan_shows_the_free_space_it_saw():
    """The scan of a robot that stands is the only one there will be."""
    grid = OccupancyGrid(0.1)
    first = placed([0.05, 0.05, 0.0], [[1.0, 0.0], [1.0, 1.0]])
    draw(grid, first)
    assert pixel(grid, 0.55, 0.05) == FREE_PIXEL
    assert pixel(grid, 1.05, 0.05) == OCCUPIED_PIXEL
    assert pixel(grid, 1.05, 0.55) == UNKNOWN_PIXEL
    other = placed([0.05, 0.05, 0.0], [[-1.0, 0.0]], origin=[-0.3, 0.0])  # another lidar
    draw(grid, first, other)
    assert pixel(grid, 0.55, 0.55) == pixel(grid, -0.55, 0.05) == FREE_PIXEL
    draw(grid, first, placed([0.15, 0.05, 0.0], [[0.9, 0.0]]))
    assert pixel(grid, 0.55, 0.05) == FREE_PIXEL
    assert pixel(grid, 0.55, 0.55) == UNKNOWN_PIXEL


def test_six_passes_clear_any_cell_and_one_stray_beam_does_not_fill_a_free_one():
    scan = placed([0.05, 0.0, 0.0], [[1.0, 0.03]]), placed([0.05, 0.02, 0.0], [[1.0, 0.03]])
    past = placed([0.05, 0.0, 0.0], [[2.0, 0.03]]), placed([0.05, 0.02, 0.0], [[2.0, 0.03]])
    grid = OccupancyGrid(0.1)
    draw(grid, *scan * 20, *past * 3)
    assert value(grid, 1.05, 0.05) < OCCUPIED
    draw(grid := OccupancyGrid(0.1), *past * 20, scan[0])
    assert value(grid, 1.05, 0.05) < FREE


def test_a_wall_on_the_border_of_two_cells_has_no_gap():
    rng, grid, scans = np.random.default_rng(2), OccupancyGrid(0.05), []
    y = np.arange(-1.0, 1.0, 0.01)
    for k in range(60):
        x = 0.02 * (k % 2)
        points = np.column_stack([1.0 - x + 0.02 * rng.standard_normal(len(y)), y])
        scans.append(placed([x, 0.0, 0.0], points))
    draw(grid, *scans)
    rows = np.floor(np.arange(-0.95, 0.95, 0.05) / 0.05).astype(int) - grid.corner[1]
    columns = np.array([19, 20]) - grid.corner[0]  # either side of x = 1 m
    assert (grid.logodds[np.ix_(rows, columns)] > OCCUPIED).any(axis=1).all()


def test_balanced_log_odds_count_hits_against_passes():
    assert seen(3, 0, BALANCED) == pytest.approx(3 * BALANCED.hit)
    assert seen(4, 4, BALANCED) == pytest.approx(0.0, abs=1e-6)


def test_only_a_few_scans_of_a_stationary_robot_are_drawn():
    grid = OccupancyGrid()
    draw(grid, *(placed([0, 0, 0], [[1.0, 0.0]]) for _ in range(50)))
    assert grid.logodds.min() == pytest.approx(max(module.STATIONARY_SCANS * MISS, -CLAMP))
    assert (grid.logodds < np.log(0.196 / 0.804)).any()


@pytest.mark.parametrize("pose", [[1e6, 0, 0], [np.nan, 0, 0], [0, np.inf, 0], [1e300, 0, 0]])
def test_a_diverged_pose_is_rejected_and_counted(pose):
    grid, plain = OccupancyGrid(), OccupancyGrid()
    first = placed([0, 0, 0], [[1.0, 0.0]])
    last = placed([0.1, 0.0, 0.0], [[1.0, 0.0]])
    draw(grid, first, placed(pose, [[1.0, 0.0], [2.0, 0.0]]), last)
    draw(plain, first, last)
    assert grid.refused == 2
    np.testing.assert_array_equal(grid.logodds, plain.logodds)


def test_its_memory_is_flat_in_the_length_of_a_log(rng):
    angles = np.linspace(-np.pi / 2, np.pi / 2, 180)
    points = np.c_[np.cos(angles), np.sin(angles)] * rng.uniform(2.0, 8.0, (180, 1))
    poses = np.c_[rng.uniform(-15, 15, (1500, 2)), rng.uniform(-3, 3, 1500)]
    starts = 180 * np.arange(1501)
    grid = OccupancyGrid()
    grid.draw(
        PlacedScans(poses, np.zeros((1500, 2)), starts, np.tile(points, (1500, 1)).astype("f4"))
    )
    assert grid.logodds.size < (46 / 0.05 + 4 * module.MARGIN) ** 2
