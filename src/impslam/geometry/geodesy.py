"""Convert latitude and longitude to metres east and north of a nearby point.

WGS 84 (NIMA TR8350.2, 2000). Points go through earth-centred Cartesian coordinates,

    [(N + h) cos lat cos lon, (N + h) cos lat sin lon, (N (1 - e^2) + h) sin lat],
    N = a / sqrt(1 - e^2 sin^2 lat),

and are rotated into the axes east, north and up at the origin (Farrell, Aided Navigation, 2008, 2.4).
The plane touches the ellipsoid at the origin. A ground distance d becomes d (1 - d^2 / (6 a^2))
in the plane: 4 mm short after 10 km.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SEMI_MAJOR = 6_378_137.0  # m, WGS 84's a
FLATTENING = 1.0 / 298.257223563  # 1, WGS 84's f
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)  # 1, e^2


def earth_centred(latitude: Array, longitude: Array, altitude: Array) -> Array:
    """Return earth-centred points (..., 3) m from degrees and m above the ellipsoid."""
    sin, cos = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    radius = SEMI_MAJOR / np.sqrt(1.0 - ECCENTRICITY2 * sin**2)
    distance_from_axis = (radius + altitude) * cos
    east, up = np.radians(longitude), (radius * (1.0 - ECCENTRICITY2) + altitude) * sin
    return np.stack(
        [distance_from_axis * np.cos(east), distance_from_axis * np.sin(east), up], axis=-1
    )


@dataclass(frozen=True, slots=True)
class LocalPlane:
    """The plane that touches the ellipsoid at a point: x east, y north, z up, in m.

    Parameters
    ----------
    latitude, longitude : of the origin, in degrees
    altitude : of the origin, in m above the ellipsoid
    """

    latitude: float
    longitude: float
    altitude: float
    _axes: Array = field(init=False, repr=False, compare=False)
    _origin: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        lat, lon = math.radians(self.latitude), math.radians(self.longitude)
        (s, c), (sl, cl) = (math.sin(lat), math.cos(lat)), (math.sin(lon), math.cos(lon))
        axes = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
        object.__setattr__(self, "_axes", axes)
        origin = (np.asarray(v) for v in (self.latitude, self.longitude, self.altitude))
        object.__setattr__(self, "_origin", earth_centred(*origin))

    def points(self, latitude: Array, longitude: Array, altitude: Array) -> Array:
        """Return (..., 3) m east, north and up of the origin from degrees and m."""
        return np.asarray(
            (earth_centred(latitude, longitude, altitude) - self._origin) @ self._axes.T
        )

    def geodetic(self, point: Array) -> tuple[float, float, float]:
        """Return latitude and longitude in degrees and the altitude in m of one point (3,) m.

        Computed by fixed-point iteration, exact to 1e-9 m.
        """
        x, y, z = (self._origin + np.asarray(point) @ self._axes).tolist()
        distance_from_axis, latitude, altitude = math.hypot(x, y), math.radians(self.latitude), 0.0
        for _ in range(8):
            radius = SEMI_MAJOR / math.sqrt(1.0 - ECCENTRICITY2 * math.sin(latitude) ** 2)
            altitude = distance_from_axis / math.cos(latitude) - radius
            share = ECCENTRICITY2 * radius / (radius + altitude)
            latitude = math.atan2(z, distance_from_axis * (1.0 - share))
        return math.degrees(latitude), math.degrees(math.atan2(y, x)), altitude
