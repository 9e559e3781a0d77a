"""Cylinders: found completely, with consistent covariances, and nothing else mistaken for one."""

import dataclasses

import numpy as np
import pytest
from pydantic import ValidationError
from tests.extractors.scans import URG_ANGLES, cast, regular_angles, room, with_ranges

from impslam.extractors.circle import Circle

ROOM = room(-3.0, 3.0, -2.5, 2.5)
NOTHING = np.empty((0, 2, 2))
LASER = np.array([0.145, 0.02, 0.1])
POSE = np.array([0.3, -0.2, 0.4])
TURTLEBOT = np.linspace(0.0, 2.0 * np.pi, 360)  # first and last beam coincide


def cylinders(scan, rng, **parameters):
    return Circle(**parameters).extract(scan, rng)


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("angles", [URG_ANGLES, URG_ANGLES[::-1], TURTLEBOT])
@pytest.mark.parametrize("radius", [None, 0.15])
def test_noiseless_is_exact_in_any_beam_order(rng, radius, angles, upside_down):
    circles = np.array([[1.5, 0.2, 0.15], [1.0, 1.3, 0.15], [1.7, -1.2, 0.15]])
    scene = cast(
        ROOM, circles, pose=POSE, laser=LASER, angles=angles, upside_down=upside_down, sigma=0.002
    )
    found = cylinders(scene.scan, rng, radius=radius)
    assert len(found) == 3
    for o in found:
        k = int(np.argmin(np.hypot(*(scene.circles[:, :2] - o.z).T)))
        # The edge is known to half a beam's spacing only, so it may pull by a little.
        np.testing.assert_allclose(o.z, scene.circles[k, :2], atol=0.003)
        assert o.attributes["radius"] == pytest.approx(0.15, abs=0.003)
        assert set(o.beams) <= set(scene.beams_on_circle(k))
        assert o.beams.dtype == np.int64


def test_cylinder_across_the_first_beam_of_a_full_turn(rng):
    circles = np.array([[1.2, 0.0, 0.15]])
    for angles in (TURTLEBOT, regular_angles(360, 2 * np.pi) + np.pi):
        scene = cast(ROOM, circles, angles=angles, noise=0.005, sigma=0.005, rng=rng)
        (o,) = cylinders(scene.scan, rng)
        assert o.z == pytest.approx([1.2, 0.0], abs=0.02)
        assert len(o.beams) >= 12


def test_where_the_laser_was_at_other_beams_does_not_matter(rng):
    """It moves by centimetres during a sweep; the edges of a cylinder are seen from where it was then."""
    scene = cast(ROOM, np.array([[1.5, 0.2, 0.15]]), noise=0.005, sigma=0.005, rng=rng)
    scan, origins = scene.scan, scene.scan.origins.copy()
    hits = scene.beams_on_circle(0)
    origins[: hits[0]] -= [0.03, 0.0]
    origins[hits[-1] + 1 :] += [0.03, 0.0]
    (still,) = cylinders(scan, rng)
    (moved,) = cylinders(dataclasses.replace(scan, origins=origins), rng)
    np.testing.assert_array_equal(moved.z, still.z)
    np.testing.assert_array_equal(moved.R, still.R)


@pytest.mark.parametrize(("radius", "floor"), [(None, 0.9), (0.15, 0.95)])
def test_covariance_is_consistent_and_most_are_found(rng, radius, floor):
    d2, tried = [], 0
    for _ in range(300):
        distance, bearing = rng.uniform(0.6, 2.5), rng.uniform(-1.8, 1.8)
        truth = distance * np.array([np.cos(bearing), np.sin(bearing)])
        scene = cast(ROOM, np.append(truth, 0.15)[None], noise=0.01, rng=rng)
        tried += 1
        for o in cylinders(scene.scan, rng, radius=radius):
            error = o.z - truth
            assert np.hypot(*error) < 0.2
            d2.append(error @ np.linalg.solve(o.R, error))
    assert len(d2) >= floor * tried
    assert 1.0 < np.mean(d2) < 2.6  # cautious: these beams have no width, as those of a lidar have


def fitted(rng, radius, distance, mixed=0):
    """Return the errors along and across the line of sight of many cylinders (n, 2), and R (n, 2, 2).

    `mixed` beams at each side of the cylinder measure a range between it and the background.
    """
    errors, covariances, noise = [], [], 0.003 + 0.003 * distance
    for bearing in rng.uniform(-1.2, 1.2, 600):
        c, s = np.cos(bearing), np.sin(bearing)
        axes = np.array([[c, s], [-s, c]])
        circle = np.append(distance * axes[0], 0.15)[None]
        scene = cast(2.0 * ROOM, circle, noise=noise, sigma=noise, rng=rng)
        scan, hits = scene.scan, scene.beams_on_circle(0)
        if mixed:
            ends = np.concatenate([hits[:mixed], hits[-mixed:]])
            ranges = scan.ranges.copy()
            ranges[ends] += 0.3
            scan = with_ranges(scan, ranges)
        for o in cylinders(scan, rng, radius=radius):
            errors.append(axes @ o.z - [distance, 0.0])
            covariances.append(axes @ o.R @ axes.T)
    assert len(errors) > 400
    return np.array(errors), np.array(covariances)


def mean_radial_error(rng, radius, distance, mixed=0):
    """Return the mean error along the line of sight, weighted by information, over its scatter."""
    found, covariances = fitted(rng, radius, distance, mixed)
    errors, weights = found[:, 0], 1.0 / covariances[:, 0, 0]
    return np.average(errors, weights=weights) / np.std(errors)


@pytest.mark.parametrize("radius", [None, 0.15])
@pytest.mark.parametrize("distance", [0.8, 2.0, 3.0])
@pytest.mark.parametrize(("mixed", "limit"), [(0, 0.2), (1, 0.4)])
def test_centres_are_unbiased(rng, radius, distance, mixed, limit):
    """A landmark is seen in hundreds of scans, so a bias well below their scatter dominates its error."""
    assert abs(mean_radial_error(rng, radius, distance, mixed)) < limit


@pytest.mark.parametrize("distance", [0.8, 2.0, 3.0])
@pytest.mark.parametrize(("mixed", "low", "high"), [(0, 0.8, 2.2), (1, 1.6, 2.9)])
def test_covariance_is_consistent_with_and_without_mixed_beams(rng, distance, mixed, low, high):
    """Wide beams at the edge are no hits, so that the cylinder is wider than it seems."""
    errors, covariances = fitted(rng, None, distance, mixed)
    d2 = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
    assert low < np.mean(d2) < high


def test_covariance_contains_the_error_common_to_all_ranges(rng):
    scan = cast(ROOM, np.array([[1.5, 0.0, 0.15]]), sigma=0.005).scan
    (own,) = cylinders(scan, rng, radius=0.15)
    (shared,) = cylinders(dataclasses.replace(scan, bias=0.02), rng, radius=0.15)
    extra = shared.R - own.R
    assert np.sqrt(extra[0, 0]) == pytest.approx(0.02, rel=0.1)
    assert abs(extra[1, 1]) < 1e-5


@pytest.mark.parametrize("sigma", [0.003, 0.01])
def test_rooms_corners_doors_boxes_and_wall_ends_are_no_cylinders(rng, sigma):
    jambs = [[[1.5, -2.0], [1.5, -0.45]], [[1.5, 0.45], [1.5, 2.0]]]
    box = [[[0.8, 0.7], [0.95, 0.85]], [[0.95, 0.85], [0.8, 1.0]], [[0.8, 0.7], [0.65, 0.85]]]
    panel = [[[1.0, -0.2], [1.05, 0.15]]]
    for walls in (ROOM, np.vstack((ROOM, jambs)), np.vstack((ROOM, box)), np.vstack((ROOM, panel))):
        for _ in range(20):
            pose = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(-np.pi, np.pi)])
            scene = cast(walls, pose=pose, noise=sigma, sigma=sigma, rng=rng)
            assert cylinders(scene.scan, rng) == []


def test_cut_occluded_or_touching_arcs_are_skipped(rng):
    whole = np.array([[1.5, 0.0, 0.15]])
    cut_by_the_end = cast(NOTHING, whole, angles=URG_ANGLES[URG_ANGLES > 0.03], sigma=0.003)
    occluded = cast(NOTHING, np.vstack((whole, [[0.8, 0.06, 0.02]])), sigma=0.003)
    sunk = cast(np.array([[[1.42, -2.0], [1.42, 2.0]]]), whole, sigma=0.003)
    for scene in (cut_by_the_end, occluded, sunk):
        assert cylinders(scene.scan, rng) == []
    assert len(cylinders(cast(NOTHING, whole, sigma=0.003).scan, rng)) == 1


def test_wrong_size_is_refused(rng):
    scene = cast(NOTHING, np.array([[1.2, 0.0, 0.15]]), noise=0.005, sigma=0.005, rng=rng)
    assert cylinders(scene.scan, rng, radius=0.055) == []
    assert cylinders(scene.scan, rng, radius_max=0.1) == []
    assert cylinders(scene.scan, rng, radius_min=0.2) == []


def test_empty_scans_and_bad_parameters(rng):
    scan = cast(NOTHING, np.array([[1.2, 0.0, 0.15]])).scan
    for n in (0, 1, 2, 4):
        valid = np.zeros(len(scan.valid), bool)
        valid[np.flatnonzero(scan.valid)[:n]] = True
        assert cylinders(dataclasses.replace(scan, valid=valid), rng) == []
    with pytest.raises(ValidationError, match="radius_min"):
        Circle(radius_min=0.5)
