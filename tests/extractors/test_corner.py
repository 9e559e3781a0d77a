"""Corners: exact, consistent, and only at meeting walls."""

import dataclasses

import numpy as np
import pytest
from tests.extractors.scans import URG_ANGLES, cast, regular_angles, room, seen_from

from impslam.extractors.corner import Corner

ROOM = room(-2.0, 2.5, -1.5, 1.8)
CORNERS = ROOM[:, 0]
LASER = np.array([0.145, 0.02, 0.1])
POSE = np.array([0.3, -0.2, 0.4])
FULL = regular_angles(720, 2.0 * np.pi)


def corners(scan, rng, **parameters):
    return Corner(**parameters).extract(scan, rng)


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("angles", [FULL, FULL[::-1], FULL + 1.1])
def test_room_has_its_four_corners(rng, angles, upside_down):
    scene = cast(ROOM, pose=POSE, laser=LASER, angles=angles, upside_down=upside_down, sigma=0.003)
    found = corners(scene.scan, rng)
    truth = np.array([seen_from(POSE, c) for c in CORNERS])
    assert len(found) == 4
    matched = set()
    for o in found:
        k = int(np.argmin(np.hypot(*(truth - o.z).T)))
        np.testing.assert_allclose(o.z, truth[k], atol=1e-3)
        assert o.attributes["angle"] == pytest.approx(np.pi / 2, abs=1e-3)
        centre = seen_from(POSE, np.array([0.25, 0.15])) - o.z
        heading = [np.cos(o.attributes["heading"]), np.sin(o.attributes["heading"])]
        assert np.dot(heading, centre) > 0.0
        matched.add(k)
    assert matched == {0, 1, 2, 3}


def test_pillar_has_a_convex_corner(rng):
    pillar = np.array([[[1.0, 0.0], [1.5, 0.6]], [[1.0, 0.0], [1.6, -0.5]]])
    (o,) = corners(cast(pillar, sigma=0.003).scan, rng)
    np.testing.assert_allclose(o.z, [1.0, 0.0], atol=2e-3)
    between = np.arctan2(0.6, 0.5) + np.arctan2(0.5, 0.6)
    assert o.attributes["angle"] == pytest.approx(2.0 * np.pi - between, abs=0.01)
    assert np.cos(o.attributes["heading"] - np.pi) == pytest.approx(1.0, abs=0.01)


def test_walls_that_do_not_meet_or_hardly_turn_make_no_corner(rng):
    apart = np.array([[[2.0, -1.5], [2.0, 0.8]], [[-1.0, 1.1], [1.7, 1.1]]])
    assert corners(cast(apart).scan, rng) == []
    hiding = np.array(
        [[[1.0, -1.0], [1.0, 0.2]], [[0.4, 1.2], [3.0, 1.2]], [[3.0, -1.0], [3.0, 1.2]]]
    )
    for o in corners(cast(hiding).scan, rng):
        assert o.z == pytest.approx([3.0, 1.2], abs=0.05)
    flat = np.array([[[2.0, -1.5], [2.0, 0.0]], [[2.0, 0.0], [1.5, 1.2]]])
    assert corners(cast(flat).scan, rng) == []
    short = np.array([[[2.0, -1.5], [2.0, 0.0]], [[1.8, 0.0], [2.0, 0.0]]])
    assert corners(cast(short).scan, rng) == []


def test_covariance_is_consistent(rng):
    walls = np.array([[[2.0, -1.5], [2.0, 1.0]], [[2.0, 1.0], [0.2, 1.4]]])
    d2 = []
    for _ in range(200):
        scene = cast(walls, laser=LASER, noise=0.01, rng=rng)
        for o in corners(scene.scan, rng, flatness=1e-4):
            error = o.z - [2.0, 1.0]
            d2.append(error @ np.linalg.solve(o.R, error))
    assert len(d2) > 190
    assert 1.4 < np.mean(d2) < 2.6


def test_covariance_contains_the_error_common_to_all_ranges(rng):
    scan = cast(ROOM[:2], laser=LASER, sigma=0.003).scan
    beams = np.column_stack((np.cos(scan.directions), np.sin(scan.directions)))

    def corner(by):
        moved = dataclasses.replace(scan, points=scan.points + by * beams)
        (o,) = corners(moved, rng)
        return o.z

    slope = (corner(1e-4) - corner(-1e-4)) / 2e-4
    (own,), (shared,) = corners(scan, rng), corners(dataclasses.replace(scan, bias=0.02), rng)
    extra = 0.02**2 * np.outer(slope, slope)
    np.testing.assert_allclose(shared.R - own.R, extra, rtol=0.02, atol=1e-8)


def test_empty_scan(rng):
    scan = cast(ROOM, angles=URG_ANGLES).scan
    for n in (0, 1, 3, 8):
        valid = np.zeros(len(scan.valid), bool)
        valid[:n] = True
        assert corners(dataclasses.replace(scan, valid=valid), rng) == []
