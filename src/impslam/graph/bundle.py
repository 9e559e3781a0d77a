"""Joint refinement of keyframes: all pairs that overlap, and the graph's edges, in one least squares.

Points of keyframe j lie on the surfaces that keyframe i has seen: each adds its distance to the line
through the nearest point of i, n . (T_i_j p - q) (point to line, Censi 2008), weighed down by the
squared Geman-McClure weight, in one Gauss-Newton problem over all poses (Lu and Milios 1997; with
points in place of a chain of alignments: Borrmann et al. 2008). Errors are additive on [x, y, theta].
The gates narrow from round to round, as poses settle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.errors import ShapeError
from impslam.geometry.algebra import between as between_in_kernel
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.geometry.se2 import between
from impslam.graph.bearings import Fans, Scans, nearest_feature, sort_by_bearing
from impslam.graph.block_system import (
    BlockSystem,
    add_relative,
    clear_system,
    empty_system,
    solve_system,
)
from impslam.graph.pose_graph import Edges
from impslam.surfaces.features import check_rows
from impslam.types import Array, Ints, Mask, check_shape

__all__ = ["Edges", "Fit", "Refinement", "lay", "linearise", "pair_edges", "refine"]


class Fit(NamedTuple):
    """How keyframes are laid on each other.

    Attributes
    ----------
    rounds : linearisations; after the second, poses move by millimetres
    gates : m, distance of partners in the first and in the last round: what loops leave of error
        between passes, and what the first round leaves
    scales : m, of the robust kernel in the first and in the last round; the last is that of the noise
        of a point, 1 to 3 cm
    information : 1/m^2, of the distance of one point; see `refine`
    share : of the points of j that have to find partners; with fewer, i and j look at different rooms
    """

    rounds: int = 2
    gates: tuple[float, float] = (0.3, 0.15)
    scales: tuple[float, float] = (0.1, 0.04)
    information: float = 0.2 / 0.03**2
    share: float = 0.35


FACING = 0.7  # cosine of 45 degrees: normals farther apart belong to two surfaces


class Refinement(NamedTuple):
    """Keyframes refined.

    Attributes
    ----------
    poses : (k, 3)
    pairs : (m, 2) keyframes i, j that were laid on each other
    information : (m, 3, 3) of T_i_j by the points of each pair, in the last round; zero where they
        did not fit. As that of `Edges`
    shares : (m,) of the points of j that found partners
    """

    poses: Array
    pairs: Ints
    information: Array
    shares: Array


def refine(
    poses: Array,
    scans: Scans,
    edges: Edges,
    pairs: Ints,
    fixed: Ints | None = None,
    fit: Fit | None = None,
) -> Refinement:
    """Return keyframes refined; poses (k, 3) of their bases, pairs (m, 2) as `overlaps` tells them.

    Those of `fixed` (f,) are held where they are: by default the first one, since nothing else says
    where the map lies. A keyframe without overlap is moved by its edges alone.

    Solutions stop early (see `block_system`): what spans some sixty keyframes or less is refined, and
    the shape of a whole building stays as the edges of the graph have made it. So give all edges,
    loops too. On Intel and fr079, poses are everywhere less than one standard deviation, as claimed
    below, from those of an exact solution (2026-11-22).

    A point is taken for a fifth of an independent one of 3 cm: points lie 4 cm apart, normals are
    fitted over 25 cm, and a surface's own error (its brightness, its texture, the angle of
    incidence) repeats from beam to beam over about so much. The same scan is in several pairs, which
    `information` counts each time. With both, the covariance of poses (`solve.marginals`, of the edges
    and of `pair_edges`) covers the errors of simulated scans with 3 cm of independent noise, or half
    of it and 1 cm more that repeats over eight beams, about twice over. Errors that all scans have in
    common (a scale of ranges, a mount that is bent) are not in it, nor what moves between the passes.
    """
    held = np.isin(np.arange(len(poses)), 0 if fixed is None else fixed)
    check_rows(scans.features, scans.starts, len(poses))
    _check_ids(len(poses), pairs, edges)
    m = len(pairs)
    done = Refinement(plain(poses).copy(), pairs, np.zeros((m, 3, 3)), np.zeros(m))
    if len(poses) > 1:
        lasers = plain(np.broadcast_to(scans.lasers, (len(poses), 2)))
        edges = edges._replace(information=plain(edges.information))  # one kernel for all callers
        _refine(done, scans._replace(lasers=lasers), edges, held, Fit() if fit is None else fit)
    return done


def _check_ids(keyframes: int, pairs: Ints, edges: Edges) -> None:
    e = len(edges.i)
    check_shape("pairs", pairs, None, 2)
    check_shape("edges.j", edges.j, e)
    check_shape("edges.T_i_j", edges.T_i_j, e, 3)
    check_shape("edges.information", edges.information, e, 3, 3)
    check_shape("edges.kernel", edges.kernel, e)
    for ids in (pairs, edges.i, edges.j):
        if ids.size and not 0 <= ids.min() <= ids.max() < keyframes:
            raise ShapeError(
                f"pairs or edges name keyframes that are not among the {keyframes} given"
            )


def pair_edges(done: Refinement) -> Edges:
    """Return what the points of all pairs say of refined poses, as edges without error there.

    Beside the edges that were given to `refine` they make the covariance of the poses. The information
    of a pair in a bare corridor has no inverse.
    """
    i, j = np.ascontiguousarray(done.pairs[:, 0]), np.ascontiguousarray(done.pairs[:, 1])
    T_i_j = between(done.poses[i], done.poses[j])
    return Edges(i, j, T_i_j, done.information, np.full(len(i), np.inf))


@kernel
def _refine(done: Refinement, scans: Scans, edges: Edges, fixed: Mask, fit: Fit) -> None:
    """Refine `done.poses` in place, and fill in the rest."""
    fans, poses = sort_by_bearing(scans), done.poses
    i = np.concatenate((done.pairs[:, 0], edges.i))
    j = np.concatenate((done.pairs[:, 1], edges.j))
    system, x = empty_system(i, j, fixed), np.empty_like(poses)
    for r in range(fit.rounds):
        narrowing = min(1.0, r / max(1, fit.rounds - 2))
        gate = fit.gates[0] + narrowing * (fit.gates[1] - fit.gates[0])
        scale = fit.scales[0] + narrowing * (fit.scales[1] - fit.scales[0])
        linearise(done, fans, edges, fit, (gate, scale), system)
        solve_system(system, x)
        if not math.isfinite(x.sum()):
            break
        for k in np.flatnonzero(~fixed):
            poses[k] += x[k]
            poses[k, 2] = wrap_in_kernel(poses[k, 2])


@kernel
def linearise(
    done: Refinement,
    fans: Fans,
    edges: Edges,
    fit: Fit,
    limits: tuple[float, float],
    system: BlockSystem,
) -> None:
    """Fill `system` with the normal equations at `done.poses`: of all pairs, then of all edges.

    Also fills in what `done` says of the pairs. `limits` are the distance of partners and the scale of
    the kernel, m.
    """
    poses, pairs, starts = done.poses, len(done.pairs), fans.scans.starts
    W, g, d = np.empty((3, 3)), np.empty(3), np.empty(3)
    clear_system(system)
    for row in range(len(system.i)):
        i, j = system.i[row], system.j[row]
        between_in_kernel(poses[i], poses[j], d)
        if row < pairs:
            H = done.information[row]
            found = lay(fans, i, j, d, limits, H, g)
            done.shares[row] = found / max(1, starts[j + 1] - starts[j])
            if done.shares[row] < fit.share:
                H[:] = 0.0
                continue
            H *= fit.information
            g *= fit.information
        else:
            H = W
            _weigh(edges, row - pairs, d, H, g)
        add_relative(system, row, poses, H, g)


@kernel
def _weigh(edges: Edges, row: int, d: Array, H: Array, g: Array) -> None:
    """Fill H (3, 3) and g (3,) with what an edge says of the relative pose, which is d (3,) now."""
    T, known, kernel_ = edges.T_i_j[row], edges.information[row], edges.kernel[row]
    ex, ey, et = d[0] - T[0], d[1] - T[1], wrap_in_kernel(d[2] - T[2])
    for a in range(3):
        g[a] = known[a, 0] * ex + known[a, 1] * ey + known[a, 2] * et
    chi2 = ex * g[0] + ey * g[1] + et * g[2]
    w = 1.0 if kernel_ == np.inf else (kernel_ / (kernel_ + chi2)) ** 2
    g *= w
    H[:] = w * known


@kernel
def lay(
    fans: Fans, i: int, j: int, T_i_j: Array, limits: tuple[float, float], H: Array, g: Array
) -> int:
    """Fill H (3, 3) and g (3,) with what the points of scan j on the lines of i say of T_i_j (3,).

    In units of one point; `limits` as for `linearise`. Returns how many points have a partner.
    """
    features, starts = fans.scans.features, fans.scans.starts
    c, s = math.cos(T_i_j[2]), math.sin(T_i_j[2])
    H[:], g[:], found = 0.0, 0.0, 0
    for p in range(starts[j], starts[j + 1]):
        rx = c * features[p, 0] - s * features[p, 1]
        ry = s * features[p, 0] + c * features[p, 1]
        x, y = T_i_j[0] + rx, T_i_j[1] + ry
        q = nearest_feature(fans, i, x, y, limits[0])
        if q < 0 or features[q, 4] == 0.0:
            continue
        nx, ny = float(features[q, 2]), float(features[q, 3])
        along = c * (features[p, 2] * nx + features[p, 3] * ny)
        along += s * (features[p, 2] * ny - features[p, 3] * nx)
        if features[p, 4] > 0.0 and along < FACING:
            continue
        e = nx * (x - features[q, 0]) + ny * (y - features[q, 1])
        w = features[q, 4] / (1.0 + (e / limits[1]) ** 2) ** 2
        lever, found = ny * rx - nx * ry, found + 1
        H[0, 0] += w * nx * nx
        H[0, 1] += w * nx * ny
        H[0, 2] += w * nx * lever
        H[1, 1] += w * ny * ny
        H[1, 2] += w * ny * lever
        H[2, 2] += w * lever * lever
        g[0] += w * nx * e
        g[1] += w * ny * e
        g[2] += w * lever * e
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    return found
