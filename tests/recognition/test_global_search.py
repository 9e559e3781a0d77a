"""The search of a whole map finds what trying every place finds, and tells of beams what they show."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.recognition.halls import LASER, mapped, seen
from tests.recognition.plans import walls, way

from impslam.geometry.se2 import transform
from impslam.recognition.beams import Beams, explain
from impslam.recognition.global_search import COARSE_POINTS, HEADINGS, search_everywhere
from impslam.recognition.pyramid import CELL, FULL
from impslam.recognition.search_map import (
    CHANCE,
    DIRECTIONS,
    OTHER_DIRECTION,
    SECTOR,
    UNKNOWN,
    make_search_map,
)
from impslam.recognition.stored_views import stored_views
from impslam.recognition.submap import view

PLAN = np.concatenate([room(-3.0, 2.0, -1.5, 2.2), walls([-1, -1.5, -1, 0.3], [0.5, 1, 1.2, 2.2])])


@pytest.fixture(scope="module")
def search_map():
    keyframes = mapped(PLAN, way(-2.0, 0.9, 1.5, 0.2, 6))
    return make_search_map(keyframes, stored_views(keyframes))


def every_sum(search_map, points):
    """Return the sums (HEADINGS, rows, columns) of likelihoods wherever a lidar may stand."""
    level, free = search_map.likelihood[0], search_map.allowed[0] > 0
    _, height, width = level.shape
    rows, columns = np.indices(free.shape)
    sums = np.zeros((HEADINGS, height, width), np.int64)
    for a in range(HEADINGS):
        angle = 2.0 * math.pi * a / HEADINGS
        c, s = math.cos(angle), math.sin(angle)
        for x, y, nx, ny, weight in points.astype(float):
            sector = math.floor(math.atan2(s * nx + c * ny, c * nx - s * ny) / SECTOR + 0.5)
            k = sector % DIRECTIONS if weight > 0.0 else DIRECTIONS
            u = columns + math.floor((c * x - s * y) / CELL + 0.5)
            v = rows + math.floor((s * x + c * y) / CELL + 0.5)
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            found = level[k, np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
            sums[a] += np.where(inside, found, int(FULL * CHANCE))
    return np.where(free, sums, 0)


def test_a_robot_may_be_where_a_lidar_that_looks_ahead_has_not_seen_the_floor():
    hall = room(-8.0, 8.0, -8.0, 8.0)
    keyframes = mapped(hall, np.zeros((1, 3)))
    ahead = keyframes.points[:, 0] > LASER[0]
    keyframes = replace(
        keyframes, points=keyframes.points[ahead], starts=np.array([0, ahead.sum()])
    )
    search_map = make_search_map(keyframes, stored_views(keyframes))
    places = np.array([[-1.0, 0.0], [-4.0, 0.0], [4.0, 0.0], [7.95, 0.0]])
    columns, rows = np.floor((places - search_map.corner) / CELL).astype(int).T
    assert (search_map.state[2 * rows[:2], 2 * columns[:2]] == UNKNOWN).all()
    assert search_map.allowed[0, rows, columns].tolist() == [1, 0, 1, 0]


def test_points_without_a_normal_count_for_every_direction_where_no_normal_is_known():
    keyframes = mapped(PLAN, way(-2.0, 0.9, 1.5, 0.2, 6))
    views = stored_views(keyframes)
    for view_, pose in zip(views, keyframes.poses, strict=True):
        y = transform(pose, view_.features[:, :2].astype(float))[:, 1]
        view_.features[y > 2.1, 4] = 0.0  # the upper wall
    search_map = make_search_map(keyframes, views)
    column, lower, upper = np.floor(
        (np.array([0.5, -1.5, 2.2]) - search_map.corner[[0, 1, 1]]) / CELL
    ).astype(int)
    assert (search_map.likelihood[0, :DIRECTIONS, upper, column] > FULL // 2).all()
    along = search_map.likelihood[
        0, [0, 2, 3], lower, column
    ]  # this wall faces upwards: direction 1
    assert search_map.likelihood[0, 1, lower, column] > FULL // 2
    assert (along == int(OTHER_DIRECTION * FULL)).all()


@pytest.mark.parametrize("truth", [[-2.0, 1.0, 0.3], [1.3, -0.4, 2.8]])
def test_the_best_place_is_that_of_trying_every_one(search_map, truth):
    features = view(seen(PLAN, truth)).features
    points = features[features[:, 4] > 0.0]
    points = points[
        np.arange(COARSE_POINTS) * len(points) // COARSE_POINTS
    ]  # bounds are then exact
    places = search_everywhere(search_map, points)
    assert places.complete
    best = every_sum(search_map, points).max() / (FULL * COARSE_POINTS)
    assert places.scores[0] == pytest.approx(best)
    assert (np.diff(places.scores) <= 0.0).all()


def beams_of(pose):
    scan = view(seen(PLAN, pose))
    ends = scan.features[:, :2].astype(float)
    is_single = scan.features[:, 4] == 0.0
    return Beams(np.broadcast_to(LASER[:2], ends.shape).copy(), ends, is_single)


def test_beams_are_explained_where_they_were_taken(search_map):
    truth = np.array([-2.0, 1.0, 0.3])
    told = explain(search_map, beams_of(truth), truth)
    assert told.matched > 0.9
    assert told.score > 0.9
    assert told.through + told.short + told.unknown == pytest.approx(1.0 - told.matched)


def test_beams_through_walls_and_into_free_space_lower_the_score(search_map):
    beams = beams_of([-2.0, 1.0, 0.3])
    through = explain(search_map, beams, np.array([1.2, 0.2, 0.3]))
    assert through.through > 0.2
    ends = beams.starts + 0.4 * (beams.ends - beams.starts)
    short = explain(search_map, beams._replace(ends=ends), np.array([-2.0, 1.0, 0.3]))
    assert short.short > 0.6
    assert max(through.score, short.score) < 0.1


def test_single_points_in_free_space_say_nothing(search_map):
    """They are on chair legs and people, or between two surfaces that share a beam."""
    truth = np.array([-2.0, 1.0, 0.3])
    beams = beams_of(truth)
    short = np.arange(len(beams.ends)) % 3 == 0
    beams.ends[short] = beams.starts[short] + 0.6 * (beams.ends[short] - beams.starts[short])
    surface = explain(search_map, beams._replace(is_single=np.zeros(len(short), np.bool_)), truth)
    single = explain(search_map, beams._replace(is_single=short), truth)
    assert single.short == surface.short > 0.2
    assert single.score == pytest.approx(surface.score + single.short, abs=0.02)


def test_beams_that_end_in_unknown_space_have_no_effect(search_map):
    beams = beams_of([-2.0, 1.0, 0.3])
    told = explain(search_map, beams, np.array([500.0, 0.0, 0.0]))
    assert told.unknown == 1.0
    assert told.score == 0.0


def test_points_out_of_reach_are_left_out(search_map):
    points = np.zeros((COARSE_POINTS, 5), np.float32)
    points[:, 0] = 100.0
    places = search_everywhere(search_map, points)
    assert len(places.poses) == 0
    assert not places.complete
