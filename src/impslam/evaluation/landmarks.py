"""Landmarks against the truth: assignment, errors, missing and false landmarks."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from impslam.evaluation.options import GATE
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import transform
from impslam.types import Array, Landmark, TrueLandmark

ANGLE_GATE = math.radians(20.0)
"""rad: the same for the direction of walls."""
EQUIVALENT_KINDS = {"point": "cylinder", "cylinder": "point"}
"""Kinds of the same object, without and with its size."""


@dataclass(frozen=True, slots=True)
class LandmarkError:
    """Error of a landmark.

    `distance` (m) is that of a point, or of the estimated line from the middle of the true wall; `angle`
    (rad) is between walls; `foot` (m) is between the feet of the normals, the thesis's error of walls
    (5.2.2), which grows with the wall's distance from the origin.
    """

    name: str
    id: int
    kind: str
    distance: float
    angle: float
    foot: float


@dataclass(frozen=True, slots=True)
class LandmarkScore:
    """Assignment of estimates to the truth.

    `found` is in the order of the truth; `missing` are names of true landmarks; `false` are ids of
    estimates without a true landmark, `doubles` those of further estimates of a true one.
    """

    found: tuple[LandmarkError, ...]
    missing: tuple[str, ...]
    false: tuple[int, ...]
    doubles: tuple[int, ...]


def score_landmarks(
    estimates: Sequence[Landmark], truth: Sequence[TrueLandmark], gate: float = GATE
) -> LandmarkScore:
    """Assign estimates to the truth one to one with the least sum of distances.

    Estimates of kinds that do not occur in the truth are ignored. "point" and "cylinder" are the same
    object, without and with its size, and are equivalent if the truth contains only one of them.
    """
    kinds = {true.kind for true in truth}
    estimates = [mark for mark in estimates if true_kind(mark.kind, kinds) in kinds]
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  0.2 s, only for this

    cost = np.array([
        [_distance(mark, true_kind(mark.kind, kinds), true) for mark in estimates]
        for true in truth
    ])  # fmt: skip
    cost = cost.reshape(len(truth), len(estimates))
    near = cost <= gate
    # Pairs outside the gate have a constant cost, larger than any saving by pairs inside it.
    worst = 2.0 * gate * (1 + min(cost.shape))
    pairs = zip(*linear_sum_assignment(np.where(near, cost, worst)), strict=True)
    chosen = {int(i): int(j) for i, j in pairs if near[i, j]}
    left = sorted(set(range(len(estimates))) - set(chosen.values()))
    return LandmarkScore(
        tuple(_error(estimates[j], truth[i]) for i, j in sorted(chosen.items())),
        tuple(true.name for i, true in enumerate(truth) if i not in chosen),
        tuple(estimates[j].id for j in left if not near[:, j].any()),
        tuple(estimates[j].id for j in left if near[:, j].any()),
    )


def corners(truth: Sequence[TrueLandmark]) -> list[TrueLandmark]:
    """Return the common end points of true walls, as landmarks of kind corner."""
    walls = [wall for wall in truth if wall.end_points is not None]
    found = []
    for one, other in combinations(walls, 2):
        assert one.end_points is not None
        assert other.end_points is not None
        for point in one.end_points:
            if any(np.allclose(point, end, atol=1e-6) for end in other.end_points):
                name = f"corner of {one.name} and {other.name}"
                values = {"x": float(point[0]), "y": float(point[1])}
                found.append(TrueLandmark(name, "corner", point, values))
    return found


def true_kind(kind: str, true_kinds: Collection[str]) -> str:
    """Return the kind of true landmarks with which an estimated kind is compared."""
    return kind if kind in true_kinds else EQUIVALENT_KINDS.get(kind, kind)


def true_wall(name: str, ends: Array, kind: str = "wall") -> TrueLandmark:
    """Return the wall between two end points (2, 2)."""
    along = ends[1] - ends[0]
    normal = np.array([-along[1], along[0]]) / math.hypot(*along)
    r = float(normal @ ends[0])
    if r < 0.0:
        r, normal = -r, -normal
    values = {"r": r, "alpha": math.atan2(normal[1], normal[0])}
    return TrueLandmark(name, kind, r * normal, values, ends)


def transform_landmarks(T_a_b: Array, truth: Iterable[TrueLandmark]) -> list[TrueLandmark]:
    """Transform true landmarks from frame b to frame a; T_a_b (3,) is m, m, rad."""
    return [_moved(T_a_b, true) for true in truth]


def _moved(T_a_b: Array, true: TrueLandmark) -> TrueLandmark:
    if true.end_points is not None:
        return true_wall(true.name, transform(T_a_b, true.end_points), true.kind)
    x, y = transform(T_a_b, true.position[None])[0].tolist()
    values = {name: value for name, value in true.parameters.items() if name not in ("x", "y")}
    return TrueLandmark(true.name, true.kind, np.array([x, y]), {"x": x, "y": y, **values})


def landmark_errors(mark: Landmark, true: TrueLandmark) -> Array:
    """Return the error (2,) described by the landmark's covariance: of x, y, or of r, alpha."""
    if true.end_points is None:
        return mark.position - true.position
    r, alpha = mark.parameters["r"], mark.parameters["alpha"]
    off = wrap(alpha - true.parameters["alpha"])
    if abs(off) <= 0.5 * math.pi:
        return np.array([r - true.parameters["r"], off])
    # The estimate of a wall close to the origin may be on its other side, and r has no sign.
    return np.array([r + true.parameters["r"], wrap(off + math.pi)])


def _distance(mark: Landmark, kind: str, true: TrueLandmark) -> float:
    """Return the distance of two landmarks, m; infinite if they cannot be the same."""
    if kind != true.kind:
        return math.inf
    if mark.end_points is None or true.end_points is None:
        return math.dist(mark.position, true.position)
    if _angle(mark, true.end_points) > ANGLE_GATE:
        return math.inf
    along = true.end_points[1] - true.end_points[0]
    length = math.hypot(*along)
    low, high = np.sort((mark.end_points - true.end_points[0]) @ along / length)
    gap = max(0.0, float(low) - length, -float(high))
    return math.hypot(_perpendicular(mark, true.end_points), gap)


def _error(mark: Landmark, true: TrueLandmark) -> LandmarkError:
    foot = math.dist(mark.position, true.position)
    if true.end_points is None:
        return LandmarkError(true.name, mark.id, mark.kind, foot, 0.0, foot)
    distance, angle = _perpendicular(mark, true.end_points), _angle(mark, true.end_points)
    return LandmarkError(true.name, mark.id, mark.kind, distance, angle, foot)


def _perpendicular(mark: Landmark, ends: Array) -> float:
    r, alpha = mark.parameters["r"], mark.parameters["alpha"]
    x, y = ends.mean(axis=0)
    return float(abs(x * math.cos(alpha) + y * math.sin(alpha) - r))


def _angle(mark: Landmark, ends: Array) -> float:
    along = ends[1] - ends[0]
    across = math.atan2(along[1], along[0]) + 0.5 * math.pi
    return 0.5 * abs(wrap(2.0 * (mark.parameters["alpha"] - across)))
