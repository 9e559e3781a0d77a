"""The map of surfaces: what is added is found, what is cleared is gone, and scans align with it."""

import math

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.numeric import jacobian
from tests.rooms import MOUNTS, features_at

from impslam.geometry.algebra import solve
from impslam.geometry.se2 import between, compose
from impslam.surfaces.features import END_WEIGHT, features
from impslam.surfaces.surface_map import (
    CELL,
    LONE_WEIGHT,
    MAX_BEYOND_END,
    MIN_NORMAL_COSINE,
    MIXED_WEIGHT,
    Alignment,
    add,
    align,
    clear,
    closeness_of,
    empty_surface_map,
    no_evidence,
    normal_equations,
    surfel_of,
)

ROOM = room(-2.0, 3.0, -1.5, 2.2)
CORRIDOR = np.array([[[-50.0, 1.0], [50.0, 1.0]], [[50.0, -1.0], [-50.0, -1.0]]])
HOW = Alignment(20, 0.4, 0.06, 0.03**-2, 1, np.inf)
FREE = np.full(3, 1e-6)
PLACE = np.array([4.0, 1.5, 0.4])


def rows(*points):
    """Return features (n, 5) in float32, as given."""
    return np.array(points, np.float32)


def map_of(*scans, size=40.0, most=20.0):
    """Return a map of (features, pose) pairs."""
    known = empty_surface_map(size, size, 5000)
    for scan, pose in scans:
        add(known, scan, np.asarray(pose, float), most)
    return known


def surfels(known):
    return known.surfels[: known.size[0]]


def aligned(known, scan, guess, prior=FREE, how=HOW):
    """Return pose, inlier share and evidence."""
    pose, evidence = np.array(guess, float), no_evidence()
    share = align(known, scan, pose, np.asarray(prior, float), how, evidence)
    return pose, share, evidence


# --------------------------------------------------------------------------- memory


def test_a_surfel_is_the_mean_of_its_points():
    points = rows([1.01, 1.02, -1, 0, 1], [1.03, 1.02, -1, 0, 1], [1.02, 1.04, 0, -1, 0])
    known = map_of((points, np.zeros(3)))
    (surfel,) = surfels(known)
    np.testing.assert_allclose(surfel[:6], [1.02, 1.02, -1.0, 0.0, 2.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(surfel[6:], [1.01, 1.02], atol=1e-6)


def test_a_surfel_adapts_to_changes():
    """The number of averaged points is limited: an old position weighs less than 2 % after 80 more."""
    known = map_of(*[(rows([1.01, 1.02, -1, 0, 1]), np.zeros(3))] * 100)
    for _ in range(80):
        add(known, rows([1.04, 1.02, -1, 0, 1]), np.zeros(3), 20.0)
    assert surfels(known)[0, 0] == pytest.approx(1.04, abs=0.02 * 0.03)


def test_features_are_in_the_frame_of_the_map():
    known = map_of((rows([3.0, 0.5, -1, 0, 1]), [1.0, 2.0, math.pi / 2]))
    np.testing.assert_allclose(surfels(known)[0, :4], [0.5, 5.0, 0.0, -1.0], atol=1e-6)


def test_each_point_finds_the_nearest_surfel_within_the_radius(rng):
    points = rng.uniform(-4.0, 4.0, (150, 2))
    known = map_of((np.column_stack((points, np.tile([1.0, 0, 1], (150, 1)))).astype("f4"), PLACE))
    cells = np.floor((surfels(known)[:, 6:8] - known.corner) / CELL)
    for row, column in rng.integers(0, 800, (2000, 2)):
        apart2 = ((cells - [column, row]) ** 2).sum(1)
        within = (np.abs(cells - [column, row]) <= 8).all(1) & (apart2 <= 64)
        k = surfel_of(known.cells[row, column])
        assert (k >= 0) == within.any()
        if k >= 0:
            assert apart2[k] == apart2.min()
            assert k == np.flatnonzero(within & (apart2 == apart2.min()))[0]  # the oldest
            assert closeness_of(known.cells[row, column]) == 65 - apart2[k]


@pytest.mark.parametrize("corner", [(-20.0, -20.0), (3.0, -40.0)])
def test_clear_leaves_no_trace(corner):
    scan = features_at(PLACE)
    known = map_of(*((scan, PLACE + np.array([dx, 0.0, 0.0])) for dx in np.arange(0.0, 12.0, 0.7)))
    assert known.size[0] > 100
    clear(known, np.array(corner))
    assert known.size[0] == 0
    assert not known.cells.any()
    assert known.corner.tolist() == list(corner)


def test_a_map_used_again_is_as_good_as_new():
    scan = features_at(PLACE)
    known = map_of((scan, [0.0, 0.0, 1.0]))
    clear(known, np.array([-20.0, -20.0]))
    add(known, scan, PLACE, 20.0)
    fresh = map_of((scan, PLACE))
    np.testing.assert_array_equal(known.cells, fresh.cells)
    np.testing.assert_array_equal(surfels(known), surfels(fresh))


@pytest.mark.parametrize("where", [np.nan, np.inf, -np.inf, 1e300, 19.9, -19.9, 21.0])
def test_points_off_the_grid_or_not_finite_are_left_out(where):
    point = rows([0.0, 0.0, -1, 0, 1])
    known = map_of((point, np.zeros(3)))
    for pose in ([where, 0.0, 0.0], [0.0, where, 0.0]):
        add(known, point, np.array(pose), 20.0)
        evidence = no_evidence()
        normal_equations(known, point, np.array(pose), 0.1, 1, evidence)
        assert not evidence.H.any()
    assert known.size[0] == 1


def test_a_full_map_takes_no_more():
    known = empty_surface_map(20.0, 20.0, 3)
    add(known, rows(*([0.2 * k, 0.0, 0, -1, 1] for k in range(9))), np.zeros(3), 20.0)
    assert known.size[0] == 3


def test_the_sides_of_a_thin_wall_stay_two_surfaces():
    """10 cm apart: seen from the other side, neither is drawn to the other."""
    one = rows(*([1.02, 0.05 * k + 0.02, -1, 0, 1] for k in range(-20, 21)))
    other = rows(*([1.12, 0.05 * k + 0.02, 1, 0, 1] for k in range(-20, 21)))
    known = map_of((one, np.zeros(3)), (other, np.zeros(3)))
    near, far = (surfels(known)[np.abs(surfels(known)[:, 0] - x) < 0.02] for x in (1.02, 1.12))
    assert len(near) == len(far) == 41
    assert len(near) + len(far) == known.size[0]
    assert (near[:, 2] == -1.0).all()
    assert (far[:, 2] == 1.0).all()
    for side, shift in ((one, 0.015), (other, -0.015)):
        evidence = no_evidence()
        normal_equations(known, side, np.array([shift, 0.0, 0.0]), 0.1, 1, evidence)
        assert evidence.H[0, 0] > 0.0
        assert evidence.g[0] / evidence.H[0, 0] == pytest.approx(shift, abs=1e-5)


def test_the_other_side_in_one_cell_does_not_turn_a_surfel():
    known = map_of((rows([1.01, 0.01, -1, 0, 1], [1.04, 0.01, 1, 0, 1]), np.zeros(3)))
    np.testing.assert_allclose(surfels(known)[0, :4], [1.01, 0.01, -1.0, 0.0], atol=1e-6)


# --------------------------------------------------------------------------- normal equations


def pairs(known, scan, pose):
    """Return rows of (surfel, feature) as `normal_equations` pairs them, by brute force."""
    points = compose(pose, np.column_stack((scan[:, :2], np.zeros(len(scan)))).astype(float))
    cells = np.floor((points[:, :2] - known.corner) / CELL).astype(int)
    found = [surfel_of(cell) for cell in known.cells[cells[:, 1], cells[:, 0]]]
    return [
        (known.surfels[k], row.astype(float)) for k, row in zip(found, scan, strict=True) if k >= 0
    ]


def residuals(held, pose, facing_at):
    """Return per pair the weight and the residual vector at a pose; pairs are held as they are."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    R = np.array([[c, -s], [s, c]])
    c, s = math.cos(facing_at), math.sin(facing_at)
    at = np.array([[c, -s], [s, c]])
    out = []
    for surfel, row in held:
        e = pose[:2] + R @ row[:2] - surfel[:2]
        if surfel[5] > 0.0 and row[4] > 0.0:
            beyond = surfel[5] < 1.0 and abs(surfel[2] * e[1] - surfel[3] * e[0]) >= MAX_BEYOND_END
            cosine = surfel[2:4] @ at @ row[2:4]
            if cosine >= MIN_NORMAL_COSINE and not beyond:
                agreement = (cosine - MIN_NORMAL_COSINE) / (1.0 - MIN_NORMAL_COSINE)
                out.append((surfel[5] * row[4] * agreement**2, np.array([surfel[2:4] @ e])))
            continue
        both = (at @ row[2:4], row[4]), (surfel[2:4], surfel[5])
        normals = [n for n, weight in both if weight != END_WEIGHT]
        normal = next((n for n in normals if n.any()), None)  # at grazing incidence
        e = e if normal is None else np.array([normal @ e])
        out.append((LONE_WEIGHT if surfel[5] == row[4] else MIXED_WEIGHT, e))
    return out


def cost(held, pose, scale, facing_at):
    """Return the robust cost by Geman and McClure: half the weighted sum of e^2 / (1 + e^2 / s^2)."""
    return sum(
        0.5 * w * (e @ e) / (1.0 + e @ e / scale**2) for w, e in residuals(held, pose, facing_at)
    )


@pytest.mark.parametrize("scale", [0.15, 0.4])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.02), (-0.1, 0.04, -0.05)])
def test_normal_equations_equal_numerical_differences_of_the_robust_cost(off, scale):
    scan = features_at(PLACE)
    scan[::7, 4] = 0.0  # some at grazing incidence, some without surface
    scan[::14, 2:4] = 0.0
    known = map_of(
        (features_at(PLACE + np.array([0.3, -0.2, 0.1])), PLACE + np.array([0.3, -0.2, 0.1]))
    )
    pose, evidence = PLACE + off, no_evidence()
    normal_equations(known, scan, pose, scale, 1, evidence)
    reach = min(8.0, 3.0 * scale / CELL) * CELL
    held = [
        (surfel, row)
        for surfel, row in pairs(known, scan, pose)
        if np.hypot(*_cells_apart(known, surfel, row, pose)) * CELL <= reach + 1e-9
    ]
    g = jacobian(lambda p: np.array([cost(held, p, scale, pose[2])]), pose)[0]
    np.testing.assert_allclose(evidence.g, g, rtol=1e-4, atol=1e-5)
    held = residuals(held, pose, pose[2]), held
    J = jacobian(lambda p: np.concatenate([e for _, e in residuals(held[1], p, pose[2])]), pose)
    w = np.concatenate([w / (1 + e @ e / scale**2) ** 2 * np.ones(len(e)) for w, e in held[0]])
    H = J.T @ (w[:, None] * J)
    np.testing.assert_allclose(evidence.H, H, rtol=1e-4, atol=1e-4)


def _cells_apart(known, surfel, row, pose):
    point = compose(pose, np.array([row[0], row[1], 0.0]))[:2]
    return np.floor((point - known.corner) / CELL) - np.floor((surfel[6:8] - known.corner) / CELL)


def test_points_at_grazing_incidence_determine_nothing_along_their_wall():
    """The ends of walls in view move with the robot, and must not hold the pose back."""
    graze = rows(*([0.4 * k, 1.0, 0, -1, 0] for k in range(12)))
    wall = rows(*([0.05 * k, 1.0, 0, -1, 1] for k in range(-20, 60)))
    pose, evidence = np.array([0.15, 0.02, 0.0]), no_evidence()
    for known, scan in ((graze, graze), (wall, graze), (graze, wall)):
        normal_equations(map_of((known, np.zeros(3))), scan, pose, 0.4, 1, evidence)
        assert evidence.sums[1] > 0.0
        assert evidence.H[1, 1] > 0.0
        assert evidence.H[0, 0] == evidence.g[0] == 0.0


@pytest.mark.parametrize(("weight", "pulls"), [(1.0, True), (0.5, False)])
def test_a_point_beyond_the_end_of_a_wall_does_not_pull(weight, pulls):
    """The normal at the end is wrong by 0.1 rad, and its distance from there is 20 cm."""
    end = rows([0.0, 1.0, 0.1, -math.sqrt(0.99), weight])
    further, evidence = rows([0.2, 1.0, 0.0, -1.0, 1.0]), no_evidence()
    normal_equations(map_of((end, np.zeros(3))), further, np.zeros(3), 0.4, 1, evidence)
    assert evidence.sums[1] == pytest.approx(1.0, abs=0.01)
    assert (evidence.g[0] != 0.0) == (evidence.H[0, 0] != 0.0) == pulls


def test_sums_count_points_and_measure_how_they_fit():
    points = rows(*([1.0, 0.05 * k, -1, 0, 1] for k in range(-20, 21)))
    known, evidence = map_of((points, np.zeros(3))), no_evidence()
    normal_equations(known, points, np.array([0.1, 0.0, 0.0]), 0.1, 1, evidence)
    inside, inliers, squares, weights = evidence.sums
    assert inside == 41
    assert inliers == pytest.approx(41 / 2, rel=0.01)  # at the kernel's scale, half
    assert squares / weights == pytest.approx(0.1**2, rel=1e-4)
    normal_equations(known, points, np.zeros(3), 0.1, 4, evidence)
    assert evidence.sums[0] == 11


# --------------------------------------------------------------------------- alignment


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.1), (-0.15, 0.2, -0.12)])
def test_the_exact_pose_of_a_noiseless_scan_is_found(mount, off):
    scan = features_at(PLACE, MOUNTS[mount])
    pose, share, evidence = aligned(map_of((scan, PLACE)), scan, PLACE + off)
    np.testing.assert_allclose(pose, PLACE, atol=3e-4)  # in corners, cells average over two walls
    assert share > 0.98
    assert np.linalg.eigvalsh(evidence.H)[0] > 1.0


@pytest.mark.parametrize("motion", [(0.2, 0.05, 0.15), (-0.3, 0.0, 0.0), (0.0, 0.0, 0.3)])
def test_a_scan_from_elsewhere_aligns_within_a_millimetre(motion):
    truth = compose(PLACE, np.array(motion))
    known = map_of((features_at(PLACE), PLACE))
    pose, share, _ = aligned(known, features_at(truth), truth + np.array([0.1, -0.05, 0.05]))
    off = between(truth, pose)
    assert np.hypot(off[0], off[1]) < 2e-3
    assert abs(off[2]) < 1e-3
    assert share > 0.8


@pytest.mark.parametrize("turn", [0.5, 2.0, -3.0])
def test_a_rigid_motion_of_everything_moves_the_pose(turn):
    """Cells fall elsewhere, and so do means of points: as far as half a millimetre."""
    move, truth = np.array([-3.0, 2.0, turn]), compose(PLACE, np.array([0.2, 0.0, 0.1]))
    first, scan, guess = (
        features_at(PLACE),
        features_at(truth),
        truth + np.array([0.05, 0.05, 0.03]),
    )
    one, _, e1 = aligned(map_of((first, PLACE)), scan, guess)
    two, _, e2 = aligned(map_of((first, compose(move, PLACE))), scan, compose(move, guess))
    assert np.abs(between(compose(move, one), two)).max() < 1e-3
    assert np.linalg.eigvalsh(e2.H) == pytest.approx(np.linalg.eigvalsh(e1.H), rel=0.1)


def test_the_prior_determines_what_the_map_does_not():
    """Along a bare corridor an error of 0.2 m stays; across it and in heading it vanishes."""
    sight = {"range_max": 3.0}
    known = map_of((features(cast(CORRIDOR, **sight).scan, 0.04), np.zeros(3)))
    truth = np.array([0.3, 0.04, 0.05])
    scan = features(cast(CORRIDOR, pose=truth, **sight).scan, 0.04)
    prior = np.array([100.0, 100.0, 130.0])
    for along in (-0.2, 0.0, 0.2):
        guess = truth + np.array([along, 0.1, 0.08])
        pose, _, evidence = aligned(known, scan, guess, prior)
        np.testing.assert_allclose(pose[1:], truth[1:], atol=1e-3)
        assert pose[0] == pytest.approx(guess[0], abs=2e-3)
        assert evidence.H[0, 0] < 1e-3 * evidence.H[1, 1]


def test_off_the_map_the_pose_stays():
    scan = features_at(PLACE)
    guess = PLACE + np.array([100.0, 0.0, 0.0])
    pose, share, evidence = aligned(map_of((scan, PLACE)), scan, guess)
    np.testing.assert_allclose(pose, guess, atol=1e-12)
    assert share == 0.0
    assert not evidence.H.any()


def test_a_gaussian_prior_holds_and_one_with_heavy_tails_yields():
    """0.2 m off by a prior of 5 mm: held by a Gaussian, given up with slack."""
    scan, guess = features_at(PLACE), PLACE + np.array([0.2, 0.0, 0.0])
    known = map_of((scan, PLACE))
    held, _, _ = aligned(known, scan, guess, np.full(3, 1e9))
    np.testing.assert_allclose(held, guess, atol=1e-3)
    loose, _, _ = aligned(known, scan, guess, np.full(3, 0.005**-2), HOW._replace(slack2=9.0))
    np.testing.assert_allclose(loose, PLACE, atol=0.01)


def test_alignment_converges_to_a_zero_gradient():
    truth = compose(PLACE, np.array([0.2, 0.0, 0.1]))
    known, scan = map_of((features_at(PLACE), PLACE)), features_at(truth)
    pose, _, _ = aligned(
        known, scan, truth + np.array([0.1, 0.0, 0.05]), how=HOW._replace(iterations=60)
    )
    evidence = no_evidence()
    normal_equations(known, scan, pose, HOW.narrow, 1, evidence)
    assert solve(evidence.H, evidence.g)
    assert np.abs(evidence.g).max() < 5e-4


def test_runs_are_the_same_to_the_byte():
    scan = features_at(PLACE)
    first, second = (aligned(map_of((scan, PLACE)), scan, PLACE + 0.05) for _ in range(2))
    assert first[0].tobytes() == second[0].tobytes()
    assert first[2].H.tobytes() == second[2].H.tobytes()


ALONG_WALL = 0.02 + 0.04 * np.arange(40)
FACING = np.float32([0.0, -1.0, 1.0])


def wall_with(point):
    """Return features of a wall along x at y = 1 m, seen from below, one of which is `point` (5,)."""
    rows = [(x, 1.0, *FACING) for x in ALONG_WALL if abs(x - point[0]) > 1e-3]
    return np.array([*rows, point], np.float32)


def information_along(known, scan):
    """Return the information (1/m^2, for points of 1 m) along the wall, of the scan where it was taken."""
    evidence = no_evidence()
    normal_equations(map_of((known, np.zeros(3))), scan, np.zeros(3), 0.06, 1, evidence)
    return evidence.H[0, 0]


CORNER = (0.82, 1.0, -math.sqrt(0.5), -math.sqrt(0.5), 1.0)
LONE, END = (0.82, 1.0, 0.0, 0.0, 0.0), (0.82, 1.0, 0.0, -1.0, END_WEIGHT)


@pytest.mark.parametrize(
    ("in_map", "in_scan", "lowest", "highest"),
    [
        (CORNER, (0.82, 1.0, *FACING), 0.0, 0.04),  # 0.5 if both normals counted as the same
        (LONE, (0.82, 1.0, *FACING), 0.0, 0.0),
        ((0.82, 1.0, *FACING), LONE, 0.0, 0.0),
        (LONE, END, MIXED_WEIGHT, MIXED_WEIGHT),
        (END, LONE, MIXED_WEIGHT, MIXED_WEIGHT),
        (LONE, LONE, LONE_WEIGHT, LONE_WEIGHT),
    ],
    ids=["corner", "lone in map", "lone in scan", "end in scan", "end in map", "both lone"],
)
def test_what_says_where_a_robot_is_along_a_wall(in_map, in_scan, lowest, highest):
    """Nothing but lone points and ends: another point of the wall takes the place of any other."""
    found = information_along(wall_with(in_map), wall_with(in_scan))
    assert lowest - 1e-6 <= found <= highest + 1e-6
