"""Group the sightings of each landmark, by Mahalanobis distance in map and by extent.

In order, each sighting joins the nearest group in the gate or starts a new one; afterwards, groups that
have grown together are joined.
"""

from __future__ import annotations

import numpy as np

from impslam.building.groups import (
    HIGH,
    LOW,
    Rules,
    X,
    Y,
    as_sighting,
    begin,
    distance2,
    include,
    local,
)
from impslam.building.sightings import PlacedSightings, add_relief
from impslam.geometry.chi_square import GATE_2D
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

_JOIN_ROUNDS = 3  # a joined group may now match a third one


@kernel
def _nearest(
    groups: Array, frame: Array, cov: Array, extra: Array, rules: Rules, excluded: Mask
) -> int:
    """Return the nearest group of a sighting inside the gate, or -1, except the `excluded` (m,)."""
    best, nearest, scratch = -1, GATE_2D, np.empty((3, 3))
    radius = frame[3] + rules.gap + 1.0
    for g in range(len(groups)):
        dx, dy = frame[0] - groups[g, X], frame[1] - groups[g, Y]
        limit = radius + max(groups[g, HIGH], -groups[g, LOW])
        if dx * dx + dy * dy > limit * limit or excluded[g]:
            continue
        d2 = distance2(groups[g], frame, cov, extra, rules, scratch)
        if d2 < nearest:
            best, nearest = g, d2
    return best


@kernel
def _labelled(labels: Ints, first: Ints, label: int, excluded: Mask) -> int:
    """Return the group of a label, or -1, and exclude the groups of other labels."""
    if label >= 0:
        for g in range(len(first)):
            if labels[first[g]] == label:
                return g
            excluded[g] = excluded[g] or labels[first[g]] >= 0
    return -1


@kernel
def _join(groups: Array, extra: Array, parents: Ints, rules: Rules) -> bool:
    """Join groups (m, 12) that have grown together with the first of them; return whether any were.

    `extra` (m, 3) is as in `associate`, for each group; `parents` (m,) is the group that each belongs to.
    """
    frame, cov, value, any_joined = np.empty(4), np.empty(3), np.empty(2), False
    moved = np.empty(3)
    for j in range(1, len(groups)):
        if parents[j] != j:
            continue
        as_sighting(groups[j], rules.is_line, frame, cov)
        add_relief(cov, 2.0 * frame[3], rules.relief)
        excluded = parents[:j] != np.arange(j)
        i = _nearest(groups[:j], frame, cov, extra[j], rules, excluded)
        if i >= 0:
            parents[j], any_joined = i, True
            low, high = local(groups[i, :3], frame, cov, rules.is_line, value, moved)
            include(groups[i], value, moved, low, high)
    return any_joined


@kernel
def associate(
    placed: PlacedSightings, keyframes: Ints, labels: Ints, extra: Array, rules: Rules
) -> Ints:
    """Return the group (n,) of each sighting: the row of the group's first sighting.

    `extra` (n, 3) is the covariance that the keyframes of the group add. Sightings with the same label are
    one landmark, those with different labels are not. A scan shows a point landmark once.
    """
    n = len(keyframes)
    groups, first, last = np.empty((n, 12)), np.empty(n, np.int64), np.full(n, -1)
    out, count, excluded = np.empty(n, np.int64), 0, np.zeros(n, np.bool_)
    value, cov = np.empty(2), np.empty(3)
    for i in range(n):
        frame, seen = placed.frames[i], placed.relative[i]
        for g in range(count):
            excluded[g] = not rules.is_line and last[g] == keyframes[i]
        best = _labelled(labels, first[:count], labels[i], excluded)
        if best < 0:
            best = _nearest(groups[:count], frame, seen, extra[i], rules, excluded)
        if best < 0:
            best, count = count, count + 1
            first[best] = i
            begin(groups[best], frame, seen)
        else:
            low, high = local(groups[best, :3], frame, seen, rules.is_line, value, cov)
            include(groups[best], value, cov, low, high)
        last[best] = keyframes[i]
        out[i] = best
    parents = np.arange(count)
    if labels.max() < 0:
        for _ in range(_JOIN_ROUNDS):
            if not _join(groups[:count], extra[first[:count]], parents, rules):
                break
    for i in range(n):
        while parents[out[i]] != out[i]:
            out[i] = parents[out[i]]
        out[i] = first[out[i]]
    return out
