"""Start of a circle fit: Taubin's algebraic fit, or a circle of known radius.

Taubin 1991; Newton's method on the characteristic polynomial, Chernov 2010, section 5.10.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel

Array = npt.NDArray[np.float64]


@kernel
def taubin(points: Array) -> tuple[float, float, float]:
    """Return x, y, radius of the algebraic fit to points (n, 2), m; NaN for points on a line."""
    n = len(points)
    mx, my = points[:, 0].mean(), points[:, 1].mean()
    xx = yy = xy = xz = yz = zz = 0.0
    for i in range(n):
        x, y = points[i, 0] - mx, points[i, 1] - my
        z = x * x + y * y
        xx += x * x / n
        yy += y * y / n
        xy += x * y / n
        xz += x * z / n
        yz += y * z / n
        zz += z * z / n
    mz, cov = xx + yy, xx * yy - xy * xy
    a3 = 4.0 * mz
    a2 = -3.0 * mz * mz - zz
    a1 = (zz - mz * mz) * mz + 4.0 * cov * mz - xz * xz - yz * yz
    a0 = xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - (zz - mz * mz) * cov
    root = 0.0
    for _ in range(30):  # from 0 Newton's method descends to the smallest root
        slope = a1 + root * (2.0 * a2 + 3.0 * a3 * root)
        if slope == 0.0:
            break
        step = (a0 + root * (a1 + root * (a2 + root * a3))) / slope
        root -= step
        if abs(step) <= 1e-14 * mz * mz:
            break
    det = root * root - root * mz + cov
    if not abs(det) > 1e-12 * mz * mz:
        return math.nan, math.nan, math.nan
    cx = (xz * (yy - root) - yz * xy) / det / 2.0
    cy = (yz * (xx - root) - xz * xy) / det / 2.0
    return cx + mx, cy + my, math.sqrt(cx * cx + cy * cy + mz)


@kernel
def circle_start(points: Array, beams: Array, radius: float) -> Array:
    """Return a circle [x, y, radius] to start from, m; `radius` is NaN if unknown.

    `points` (n, 2) are in m, `beams` (n, 2) unit vectors from the lidar to them.
    """
    circle = np.empty(3)
    if not math.isnan(radius):
        # The mean of a whole visible arc is pi / 4 of the radius in front of the centre.
        bx, by = beams[:, 0].sum(), beams[:, 1].sum()
        depth = 0.785 * radius / max(math.hypot(bx, by), 1e-12)
        circle[0], circle[1] = points[:, 0].mean() + depth * bx, points[:, 1].mean() + depth * by
        circle[2] = radius
    else:
        circle[0], circle[1], circle[2] = taubin(points)
    return circle
