"""A group of sightings of one landmark, as a Gaussian in information form.

It is expressed in the frame of its first sighting: offset and direction of a line, position of a point.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.building.sightings import add_relief
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array

_MAX_TURN = 0.35  # rad between sightings of one line, for any covariance
_MAX_CORNER_TURN = 0.8
"""rad between sightings of one corner; two sides of a thin wall differ by more."""
X, Y, _PHI, LOW, HIGH, _L00, _L01, _L11, _E0, _E1, _U0, _U1 = range(12)


class Rules(NamedTuple):
    """Criteria for two sightings of one landmark.

    Attributes
    ----------
    is_line : whether the kind is a line, with an extent
    gap : m, maximum unseen stretch between two pieces of one line
    relief : m, standard deviation of a surface from its line
    """

    is_line: bool
    gap: float
    relief: float


@kernel
def _move_along(value: Array, cov: Array, along: float) -> None:
    """Move the reference point of a line's offset, direction and covariance (3,) by `along`, m."""
    value[0] -= along * value[1]
    cov[0] += along * (along * cov[2] - 2.0 * cov[1])
    cov[1] -= along * cov[2]


@kernel
def local(
    anchor: Array, frame: Array, cov: Array, is_line: bool, value: Array, out: Array
) -> tuple[float, float]:
    """Write a sighting's values (2,) and covariance (3,) in a frame; return its extent there.

    `anchor` (3,) is x, y, phi of the frame.
    """
    dx, dy = frame[0] - anchor[0], frame[1] - anchor[1]
    out[:] = cov
    if not is_line:
        value[0], value[1] = dx, dy
        return 0.0, 0.0
    c, s = math.cos(anchor[2]), math.sin(anchor[2])
    turn = wrap_in_kernel(frame[2] - anchor[2])
    along = c * dy - s * dx
    # Exact offset: the intersection of the line with the normal at the anchor.
    value[0], value[1] = 0.0, turn
    _move_along(value, out, -along)
    value[0] = c * dx + s * dy + along * math.tan(turn)
    half = frame[3] * math.cos(turn)
    return along - half, along + half


@kernel
def _solve(group: Array) -> None:
    """Compute the values of a group from its information form."""
    det = group[_L00] * group[_L11] - group[_L01] ** 2
    group[_U0] = (group[_L11] * group[_E0] - group[_L01] * group[_E1]) / det
    group[_U1] = (group[_L00] * group[_E1] - group[_L01] * group[_E0]) / det


@kernel
def include(group: Array, value: Array, cov: Array, low: float, high: float) -> None:
    """Add a sighting to a group.

    `value` (2,) is in the group's frame, `cov` (3,) are xx, xy, yy of its covariance; `low` and `high` are
    the ends of what is seen along the frame, m.
    """
    det = cov[0] * cov[2] - cov[1] ** 2
    a, b, c = cov[2] / det, -cov[1] / det, cov[0] / det
    group[_L00] += a
    group[_L01] += b
    group[_L11] += c
    group[_E0] += a * value[0] + b * value[1]
    group[_E1] += b * value[0] + c * value[1]
    group[LOW], group[HIGH] = min(group[LOW], low), max(group[HIGH], high)
    _solve(group)


@kernel
def _covariance(group: Array, out: Array) -> None:
    """Write the covariance (3,) of a group's values."""
    det = group[_L00] * group[_L11] - group[_L01] ** 2
    out[0], out[1], out[2] = group[_L11] / det, -group[_L01] / det, group[_L00] / det


@kernel
def distance2(
    group: Array, frame: Array, cov: Array, extra: Array, rules: Rules, scratch: Array
) -> float:
    """Return the squared Mahalanobis distance of a sighting from a group; inf if extents rule it out.

    `extra` (3,) is the covariance due to the group's own keyframes, at the middle of the sighting, where
    lines are compared; `scratch` is (3, 3).
    """
    value, own, at = scratch[0], scratch[1], scratch[2]
    _covariance(group, own)
    if rules.is_line:
        turn = wrap_in_kernel(frame[2] - group[_PHI] - group[_U1])
        if abs(turn) > _MAX_TURN:
            return math.inf
        c, s = math.cos(group[_PHI]), math.sin(group[_PHI])
        dx, dy = frame[0] - group[X], frame[1] - group[Y]
        along = c * dy - s * dx
        if max(along - frame[3] - group[HIGH], group[LOW] - along - frame[3]) > rules.gap:
            return math.inf
        at[0], at[1] = group[_U0], group[_U1]
        _move_along(at, own, along)
        add_relief(own, group[HIGH] - group[LOW], rules.relief)
        value[0], value[1] = c * dx + s * dy - group[_U0] + along * math.tan(group[_U1]), turn
    else:
        if abs(wrap_in_kernel(frame[2] - group[_PHI])) > _MAX_CORNER_TURN:  # false for NaN
            return math.inf
        value[0] = frame[0] - group[X] - group[_U0]
        value[1] = frame[1] - group[Y] - group[_U1]
    a, b, d = own[0] + cov[0] + extra[0], own[1] + cov[1] + extra[1], own[2] + cov[2] + extra[2]
    form = d * value[0] ** 2 - 2.0 * b * value[0] * value[1] + a * value[1] ** 2
    result: float = form / (a * d - b * b)
    return result


@kernel
def begin(group: Array, frame: Array, cov: Array) -> None:
    """Initialise a group with its first sighting."""
    group[:] = 0.0
    group[X], group[Y], group[_PHI] = frame[0], frame[1], frame[2]
    group[LOW], group[HIGH] = math.inf, -math.inf
    value = np.zeros(2)
    include(group, value, cov, -frame[3], frame[3])


@kernel
def as_sighting(group: Array, is_line: bool, frame: Array, cov: Array) -> None:
    """Write a group as a single sighting: frame (4,) and covariance (3,) at its middle."""
    _covariance(group, cov)
    frame[0], frame[1] = group[X] + group[_U0], group[Y] + group[_U1]
    frame[2], frame[3] = group[_PHI], 0.0
    if is_line:
        c, s = math.cos(group[_PHI]), math.sin(group[_PHI])
        middle = 0.5 * (group[LOW] + group[HIGH])
        at = np.array([group[_U0], group[_U1]])
        _move_along(at, cov, middle)
        across = group[_U0] - middle * math.tan(group[_U1])
        frame[0] = group[X] + across * c - middle * s
        frame[1] = group[Y] + across * s + middle * c
        frame[2] = wrap_in_kernel(group[_PHI] + group[_U1])
        frame[3] = 0.5 * (group[HIGH] - group[LOW])
