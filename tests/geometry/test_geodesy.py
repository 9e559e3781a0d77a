"""Places on the ellipsoid, against values of WGS 84 that are published or follow from its axes."""

import math

import numpy as np
import pytest

from impslam.geometry.geodesy import FLATTENING, SEMI_MAJOR, LocalPlane, earth_centred


def test_points_on_the_axes_of_the_earth():
    at = earth_centred(np.array([0.0, 0.0, 90.0]), np.array([0.0, 90.0, 0.0]), np.zeros(3))
    polar = 6_356_752.314245  # m, WGS 84's semi-minor axis
    np.testing.assert_allclose(at, [[6378137, 0, 0], [0, 6378137, 0], [0, 0, polar]], atol=1e-6)


# Metres a degree has at a latitude: by pi/180 of M and of N cos(lat), Snyder (1987), Table 5 (WGS 84).
@pytest.mark.parametrize(
    ("latitude", "north", "east"),
    [(0.0, 110574.3, 111319.5), (45.0, 111131.8, 78846.8), (60.0, 111412.2, 55800.0)],
)
def test_a_degree_is_as_long_as_printed(latitude, north, east):
    small = 1e-3
    plane = LocalPlane(latitude, 13.0, 0.0)
    up = plane.points(
        np.array([latitude + small, latitude]), np.array([13.0, 13.0 + small]), np.zeros(2)
    )
    np.testing.assert_allclose(
        up[0] / small, [0.0, north, -1e-3 * north * math.radians(0.5)], atol=0.3
    )
    assert up[1, 0] / small == pytest.approx(east, abs=0.1)
    assert abs(up[1, 1]) < 1e-3
    assert up[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_a_known_distance():
    """Flinders Peak to Buninyong (Geoscience Australia's GDA manual): 54972.271 m on GRS 80."""
    lat = np.array([-(37 + 57 / 60 + 3.72030 / 3600), -(37 + 39 / 60 + 10.15610 / 3600)])
    lon = np.array([144 + 25 / 60 + 29.52440 / 3600, 143 + 55 / 60 + 35.38390 / 3600])
    a, b = earth_centred(lat, lon, np.zeros(2))
    chord = float(np.linalg.norm(a - b))
    arc = 2.0 * SEMI_MAJOR * math.asin(0.5 * chord / SEMI_MAJOR)  # within 1e-8 of the curvature
    assert arc == pytest.approx(54972.271, abs=0.05)


def test_geodetic_inverts_points(rng):
    for _ in range(50):
        lat, lon = rng.uniform(-89, 89), rng.uniform(-180, 180)
        plane = LocalPlane(lat, lon, rng.uniform(-100, 3000))
        point = rng.uniform(-5000, 5000, 3)
        place = plane.geodetic(point)
        back = plane.points(*(np.array(v) for v in place))
        np.testing.assert_allclose(back, point, atol=1e-6)


def test_the_flattening_is_that_of_wgs_84():
    assert pytest.approx(298.257223563) == 1 / FLATTENING
