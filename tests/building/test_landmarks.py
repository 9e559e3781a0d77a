"""Landmarks of a building: each once, in the right place, with an honest covariance."""

import math

import numpy as np
import pytest

from impslam.building.landmarks import Criteria, landmarks_of
from impslam.errors import ConfigError
from impslam.geometry.se2 import compose, inverse, transform
from impslam.landmarks.gps import GpsFrame
from impslam.landmarks.point import Corner, Cylinder
from impslam.landmarks.wall import Wall
from impslam.maps.grid import PlacedScans
from impslam.types import Observation

MODELS = {"cylinder": Cylinder(), "corner": Corner(), "wall": Wall()}
R_POINT = np.diag([4e-4, 3e-4])
R_WALL = np.array([[2e-4, 2e-5], [2e-5, 1e-4]])
PATH = np.column_stack(
    (np.linspace(-2.0, 2.0, 11), np.linspace(0.0, 0.5, 11), np.linspace(-3.5, 3.5, 11))
)
ZERO = np.zeros((len(PATH), 3, 3))
ROOM = [[[6, -5], [6, 5]], [[6, 5], [-6, 5]], [[-6, 5], [-6, -5]], [[-6, -5], [6, -5]]]


def wall(pose, ends, rng=None, R=R_WALL):
    """Return a wall as a pose sees it, its normal away from the robot."""
    a, b = transform(inverse(pose), np.array(ends, float))
    n = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
    n *= 1.0 if n @ a > 0 else -1.0
    z = np.array([n @ a, math.atan2(n[1], n[0])])
    z = z if rng is None else rng.multivariate_normal(z, R)
    return Observation("wall", z, R, np.arange(50), np.array([a, b]))


def point(pose, place, kind="cylinder", rng=None, heading=None, **attributes):
    """Return a point as a pose sees it."""
    z = transform(inverse(pose), np.array(place, float))
    z = z if rng is None else rng.multivariate_normal(z, R_POINT)
    if heading is not None:
        attributes["heading"] = heading - pose[2]
    return Observation(kind, z, R_POINT, attributes=attributes)


def scans_of(poses, segments, beams=360, limit=20.0):
    """Return exact scans in a world of segments (s, 2, 2)."""
    a = np.array(segments, float)[:, 0]
    d = np.array(segments, float)[:, 1] - a
    points = []
    for x, y, theta in poses:
        bearings = np.linspace(-np.pi, np.pi, beams, endpoint=False)
        u = np.column_stack((np.cos(bearings + theta), np.sin(bearings + theta)))[:, None]
        to = a - [x, y]
        det = u[..., 0] * d[:, 1] - u[..., 1] * d[:, 0]
        with np.errstate(all="ignore"):
            r = (to[:, 0] * d[:, 1] - to[:, 1] * d[:, 0]) / det
            s = (to[:, 0] * u[..., 1] - to[:, 1] * u[..., 0]) / det
        r[~((r > 0) & (s >= 0) & (s <= 1))] = limit
        ranges = np.nanmin(r, axis=1)
        points.append(ranges[:, None] * np.column_stack((np.cos(bearings), np.sin(bearings))))
    return PlacedScans(
        np.array(poses, float),
        np.zeros((len(poses), 2)),
        np.arange(len(poses) + 1) * beams,
        np.concatenate(points).astype(np.float32),
    )


def post(x, y):
    """Return a post, for scans."""
    return [[[x - 0.1, y], [x + 0.1, y]], [[x, y - 0.1], [x, y + 0.1]]]


def whole(pose, rng=None):
    """Return all of a room: four walls, two cylinders, two corners."""
    return [
        *(wall(pose, ends, rng) for ends in ROOM),
        point(pose, [2, 1.5], rng=rng, radius=0.15),
        point(pose, [-1, 3], rng=rng, radius=0.25),
        point(pose, [6, 5], "corner", rng, math.atan2(-1, -1)),
        point(pose, [-6, 5], "corner", rng, math.atan2(-1, 1)),
    ]


def sorted_ends(landmark):
    return np.array(sorted(landmark.end_points.tolist()))


def test_a_noiseless_world_is_exact():
    found = landmarks_of(PATH, ZERO, [whole(pose) for pose in PATH], MODELS)
    assert [mark.kind for mark in found] == ["wall"] * 4 + ["cylinder"] * 2 + ["corner"] * 2
    assert [mark.id for mark in found] == list(range(8))
    for mark, ends in zip(found[:4], ROOM, strict=True):
        np.testing.assert_allclose(sorted_ends(mark), sorted(ends), atol=1e-9)
    places = [mark.position for mark in found[4:]]
    np.testing.assert_allclose(places, [[2, 1.5], [-1, 3], [6, 5], [-6, 5]], atol=1e-9)
    assert [mark.parameters.get("radius") for mark in found[4:6]] == pytest.approx([0.15, 0.25])
    assert {mark.observations for mark in found} == {11}
    assert {(mark.first_stamp, mark.last_stamp) for mark in found} == {(0.0, 10.0)}


def test_a_rigid_motion_of_everything_moves_everything():
    rng = np.random.default_rng(1)
    seen = [whole(pose, rng) for pose in PATH]
    P = np.broadcast_to(np.diag([1e-4, 1e-4, 1e-6]), (len(PATH), 3, 3))
    motion = np.array([3.0, -7.0, 2.2])
    before = landmarks_of(PATH, P, seen, MODELS)
    after = landmarks_of(compose(motion, PATH), P, seen, MODELS)
    assert [mark.id for mark in before] == [mark.id for mark in after]
    for one, two in zip(before, after, strict=True):
        if one.end_points is None:
            np.testing.assert_allclose(transform(motion, one.position), two.position, atol=1e-9)
        else:
            np.testing.assert_allclose(transform(motion, one.end_points), two.end_points, atol=1e-9)


def test_the_same_input_gives_the_same_bytes():
    rng = np.random.default_rng(2)
    seen = [whole(pose, rng) for pose in PATH]
    one, two = (repr(landmarks_of(PATH, ZERO, seen, MODELS)) for _ in range(2))
    assert one == two


def test_more_keyframes_keep_the_ids():
    rng = np.random.default_rng(3)
    seen = [whole(pose, rng) for pose in PATH]
    early = landmarks_of(PATH[:5], ZERO[:5], seen[:5], MODELS)
    late = landmarks_of(PATH, ZERO, seen, MODELS)
    assert [mark.id for mark in early] == [mark.id for mark in late]


def test_the_two_sides_of_a_thin_wall_are_two():
    north = [np.array([x, 2.0, -1.5]) for x in (-1, -0.5, 0, 0.5)]
    south = [np.array([x, -2.0, 1.5]) for x in (-1, -0.5, 0, 0.5)]
    seen = [[wall(p, [[-3, 0.05], [3, 0.05]])] for p in north]
    seen += [[wall(p, [[-3, -0.05], [3, -0.05]])] for p in south]
    found = landmarks_of(np.array(north + south), ZERO[:8], seen, MODELS)
    assert [mark.end_points[0, 1] for mark in found] == pytest.approx([0.05, -0.05])


def test_corners_on_the_two_sides_of_a_thin_wall_are_two():
    seen = [
        [point(p, [0, 0.04], "corner", heading=0.8), point(p, [0, -0.04], "corner", heading=-0.8)]
        for p in PATH
    ]
    assert len(landmarks_of(PATH, ZERO, seen, MODELS)) == 2


def test_overlapping_pieces_are_one_wall():
    pieces = [(-3, -1), (1.5, 3), (-2, 0.5), (-0.5, 2.0)] * 3
    poses = np.zeros((12, 3))
    seen = [[wall(p, [[a, 2], [b, 2]])] for p, (a, b) in zip(poses, pieces, strict=True)]
    (mark,) = landmarks_of(poses, np.zeros((12, 3, 3)), seen, MODELS)
    np.testing.assert_allclose(sorted_ends(mark), [[-3, 2], [3, 2]], atol=1e-9)


def test_a_piece_that_stands_off_by_a_skirting_belongs_to_the_wall():
    """Its beams tell a direction 2.3 degrees off, to a tenth of a degree."""
    R = np.diag([1e-3, 2e-3]) ** 2
    skirting = [[-0.25, 2.0], [0.25, 2.02]]
    seen = [[wall(p, [[-3, 2], [3, 2]], R=R), wall(p, skirting, R=R)] for p in PATH]
    assert len(landmarks_of(PATH, ZERO, seen, MODELS)) == 1
    assert len(landmarks_of(PATH, ZERO, seen, MODELS, criteria=Criteria(relief=0.0))) == 2


def test_collinear_walls_with_a_wide_gap_are_two():
    seen = [[wall(p, [[-4, 3], [-0.6, 3]]), wall(p, [[0.6, 3], [4, 3]])] for p in PATH]
    assert len(landmarks_of(PATH, ZERO, seen, MODELS)) == 2


def test_collinear_walls_with_an_open_door_are_two():
    """Even if one scan took both for one wall."""
    sides = [[[-4, 3], [-0.4, 3]], [[0.4, 3], [4, 3]]]
    seen = [[wall(p, ends) for ends in sides] for p in PATH]
    seen[4].append(wall(PATH[4], [[-4, 3], [4, 3]]))
    scans = scans_of(PATH, [*sides, [[-9, 7], [9, 7]]])
    found = landmarks_of(PATH, ZERO, seen, MODELS, scans)
    assert len(found) == 2
    np.testing.assert_allclose(sorted_ends(found[0]), sides[0], atol=0.25)  # a cell
    np.testing.assert_allclose(sorted_ends(found[1]), sides[1], atol=0.25)
    solid = scans_of(PATH, [[[-4, 3], [4, 3]]])
    assert len(landmarks_of(PATH, ZERO, seen, MODELS, solid)) == 1


def test_walls_that_nobody_sees_through_stay_as_they_are():
    seen = [whole(pose) for pose in PATH]
    with_scans = landmarks_of(PATH, ZERO, seen, MODELS, scans_of(PATH, ROOM))
    assert repr(with_scans) == repr(landmarks_of(PATH, ZERO, seen, MODELS))


def test_a_pedestrian_is_no_landmark():
    seen = [[*whole(p), point(p, [0.8 * i - 4, 2])] for i, p in enumerate(PATH)]
    assert len(landmarks_of(PATH, ZERO, seen, MODELS)) == 8


def test_who_stood_there_and_left_is_no_landmark():
    seen = [[*whole(p), *([point(p, [0, 2])] if i < 4 else [])] for i, p in enumerate(PATH)]
    posts = [*post(2, 1.5), *post(-1, 3)]
    found = landmarks_of(PATH, ZERO, seen, MODELS, scans_of(PATH, [*ROOM, *posts]))
    assert [mark.id for mark in found] == list(range(8))
    assert len(landmarks_of(PATH, ZERO, seen, MODELS)) == 9


def test_who_stays_is_one():
    seen = [[point(p, [0, 2])] for p in PATH]
    scans = scans_of(PATH, [*ROOM, *post(0, 2)])
    assert len(landmarks_of(PATH, ZERO, seen, MODELS, scans)) == 1


def test_landmarks_move_with_the_poses():
    rng = np.random.default_rng(4)
    seen = [whole(pose, rng) for pose in PATH]
    before = landmarks_of(PATH, ZERO, seen, MODELS)
    after = landmarks_of(PATH + np.array([0.5, 0.0, 0.0]), ZERO, seen, MODELS)
    for one, two in zip(before[4:], after[4:], strict=True):
        np.testing.assert_allclose(two.position - one.position, [0.5, 0.0], atol=1e-9)


def test_labels_decide():
    seen = [
        [
            Observation("cylinder", transform(inverse(p), place), R_POINT, label=label)
            for label, place in ((7, np.zeros(2)), (8, np.array([0.01, 0.0])))
        ]
        for p in PATH
    ]
    assert len(landmarks_of(PATH, ZERO, seen, MODELS)) == 2


def test_a_kind_without_a_model_is_refused():
    with pytest.raises(ConfigError, match="no landmark model"):
        landmarks_of(PATH, ZERO, [[point(PATH[0], [1, 1], "pole")]], MODELS)


def test_fixes_of_a_gps_are_no_landmarks():
    fix = Observation("gps", np.zeros(2), np.eye(2))
    seen = [[fix, point(p, [1.0, 2.0])] for p in PATH]
    found = landmarks_of(PATH, ZERO, seen, MODELS | {"gps": GpsFrame()})
    assert [mark.kind for mark in found] == ["cylinder"]


def test_nothing_seen_gives_nothing():
    assert landmarks_of(PATH, ZERO, [[]] * 11, MODELS) == ()
    assert landmarks_of(PATH, ZERO, [[point(PATH[0], [1, 1])]], MODELS) == ()


def nees(mark, truth):
    if mark.kind == "wall":
        error = np.array([mark.parameters["r"] - truth[0], mark.parameters["alpha"] - truth[1]])
    else:
        error = mark.position - truth
    return error @ np.linalg.solve(mark.covariance, error)


@pytest.mark.parametrize("shared", [0.0, 0.5, 1.0])
def test_the_claimed_covariance_is_never_too_small(shared):
    """Whatever part of the poses' error the keyframes share: mean NEES at most its 2 degrees of freedom."""
    rng = np.random.default_rng(5)
    P = np.diag([0.02, 0.02, 0.004]) ** 2
    covariances = np.broadcast_to(P, (len(PATH), 3, 3))
    point_nees, wall_nees = [], []
    for _ in range(60):
        common = rng.multivariate_normal(np.zeros(3), P)
        own = rng.multivariate_normal(np.zeros(3), P, len(PATH))
        poses = PATH + math.sqrt(shared) * common + math.sqrt(1.0 - shared) * own
        found = landmarks_of(poses, covariances, [whole(p, rng) for p in PATH], MODELS)
        assert len(found) == 8
        point_nees += [nees(found[4], [2, 1.5]), nees(found[5], [-1, 3])]
        wall_nees += [nees(found[0], [6, 0]), nees(found[1], [5, math.pi / 2])]
    # 120 values of chi-square with two degrees of freedom: the mean's standard deviation is 0.18.
    assert np.mean(point_nees) < 2.3
    assert np.mean(wall_nees) < 2.3
    if shared == 1.0:
        assert np.mean(point_nees) > 0.2  # and not without meaning


def test_fewer_sightings_than_asked_for_are_none():
    seen = [[point(p, [1, 1])] if i < 4 else [] for i, p in enumerate(PATH)]
    assert len(landmarks_of(PATH, ZERO, seen, MODELS, criteria=Criteria(sightings=4))) == 1
    assert len(landmarks_of(PATH, ZERO, seen, MODELS, criteria=Criteria(sightings=5))) == 0
