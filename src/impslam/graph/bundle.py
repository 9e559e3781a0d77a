"""Joint refinement of keyframes: least squares over all overlapping pairs and the edges of the graph.

Points of keyframe j lie on surfaces seen by keyframe i: each contributes its distance to the line through
the nearest point of i, n . (T_i_j p - q) (point to line, Censi 2008), with the squared Geman-McClure
weight, to one Gauss-Newton problem over all poses (Lu and Milios 1997; with points instead of a chain of
alignments: Borrmann et al. 2008). Errors are additive on [x, y, theta]. The gates narrow in each round, as
poses converge.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.errors import ShapeError
from impslam.geometry.algebra import between
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.graph.bearings import Fans, ScanFeatures, nearest_feature, sort_by_bearing
from impslam.graph.block_system import (
    BlockSystem,
    add_relative,
    clear_system,
    empty_system,
    solve_system,
)
from impslam.graph.checked import check_edges
from impslam.graph.edges import linearise_edge
from impslam.surfaces.features import check_rows
from impslam.types import Array, Edges, Ints, Mask, check_shape


class RefinementSettings(NamedTuple):
    """Parameters of the refinement.

    Attributes
    ----------
    rounds : linearisations; after the second, poses move by millimetres
    gates : m, maximum distance of partners in the first and last round: the errors between passes after
        loop closing, and after the first round
    scales : m, of the robust kernel in the first and last round; the last is the noise of a point, 1 to
        3 cm
    information : 1/m^2, of the distance of one point; see `refine`
    share : minimum share of the points of j with partners; with fewer, i and j see different rooms
    """

    rounds: int = 2
    gates: tuple[float, float] = (0.3, 0.15)
    scales: tuple[float, float] = (0.1, 0.04)
    information: float = 0.2 / 0.03**2
    share: float = 0.35


MIN_FACING = 0.7  # cosine of 45 degrees between normals of one surface


class Refinement(NamedTuple):
    """The result of a refinement.

    Attributes
    ----------
    poses : (k, 3)
    pairs : (m, 2) aligned keyframes i, j
    information : (m, 3, 3) of T_i_j from the points of each pair, in the last round, as in `Edges`; zero
        if they did not fit
    shares : (m,) share of the points of j with partners
    """

    poses: Array
    pairs: Ints
    information: Array
    shares: Array


def refine(
    poses: Array,
    scans: ScanFeatures,
    edges: Edges,
    pairs: Ints,
    fixed: Ints | None = None,
    fit: RefinementSettings | None = None,
) -> Refinement:
    """Refine keyframes, given poses (k, 3) of their bases and pairs (m, 2) from `overlaps`.

    Keyframes in `fixed` (f,) do not move: by default the first one, which defines the map frame. A keyframe
    without overlap moves only by its edges.

    Solutions stop early (see `block_system`): errors over up to some sixty keyframes are refined, while the
    shape of a whole building remains that of the edges of the graph. Therefore pass all edges, including
    loops. On Intel and fr079, all poses are less than one standard deviation, as estimated below, from
    those of an exact solution (2026-11-22).

    A point counts as a fifth of an independent one with 3 cm of noise: points are 4 cm apart, normals are
    fitted over 25 cm, and errors due to the surface (brightness, texture, angle of incidence) are
    correlated between beams over a similar length. A scan that is in several pairs counts each time in
    `information`. With both, the covariance of poses (`solve.marginals`, of the edges and of further ones
    with the information of the pairs) covers the errors of simulated scans with 3 cm of independent noise,
    or half of it plus 1 cm correlated over eight beams, about twice over. Errors common to all scans (a
    scale of ranges, a bent mount) are not included, and neither are objects that moved between the passes.
    """
    is_fixed = np.isin(np.arange(len(poses)), 0 if fixed is None else fixed)
    check_rows(scans.features, scans.starts, len(poses))
    _check_ids(len(poses), pairs, edges)
    m = len(pairs)
    done = Refinement(plain(poses).copy(), pairs, np.zeros((m, 3, 3)), np.zeros(m))
    if len(poses) > 1:
        lasers = plain(np.broadcast_to(scans.lasers, (len(poses), 2)))
        # one compiled version for all callers
        edges = edges._replace(information=plain(edges.information))
        _refine(
            done,
            scans._replace(lasers=lasers),
            edges,
            is_fixed,
            RefinementSettings() if fit is None else fit,
        )
    return done


def _check_ids(keyframes: int, pairs: Ints, edges: Edges) -> None:
    check_shape("pairs", pairs, None, 2)
    check_edges(edges)
    for ids in (pairs, edges.i, edges.j):
        if ids.size and not 0 <= ids.min() <= ids.max() < keyframes:
            raise ShapeError(
                f"pairs or edges name keyframes that are not among the {keyframes} given"
            )


@kernel
def _refine(
    done: Refinement, scans: ScanFeatures, edges: Edges, fixed: Mask, fit: RefinementSettings
) -> None:
    """Refine `done.poses` in place, and fill the other fields of `done`."""
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
    fit: RefinementSettings,
    limits: tuple[float, float],
    system: BlockSystem,
) -> None:
    """Fill `system` with the normal equations at `done.poses`: of all pairs, then of all edges.

    Also fills the information and shares of the pairs in `done`. `limits` are the maximum distance of
    partners and the scale of the kernel, m.
    """
    poses, pairs, starts = done.poses, len(done.pairs), fans.scans.starts
    W, g, d = np.empty((3, 3)), np.empty(3), np.empty(3)
    clear_system(system)
    for row in range(len(system.i)):
        i, j = system.i[row], system.j[row]
        between(poses[i], poses[j], d)
        if row < pairs:
            H = done.information[row]
            found = linearise_pair(fans, i, j, d, limits, H, g)
            done.shares[row] = found / max(1, starts[j + 1] - starts[j])
            if done.shares[row] < fit.share:
                H[:] = 0.0
                continue
            H *= fit.information
            g *= fit.information
        else:
            H = W
            linearise_edge(edges, row - pairs, d, 1.0, H, g)
        add_relative(system, row, poses, H, g)


@kernel
def linearise_pair(
    fans: Fans, i: int, j: int, T_i_j: Array, limits: tuple[float, float], H: Array, g: Array
) -> int:
    """Fill H (3, 3) and g (3,) with the normal equations of a pair at T_i_j (3,), per point.

    The points of scan j are matched with lines of scan i; `limits` are as in `linearise`. Returns the
    number of points with a partner.
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
        if features[p, 4] > 0.0 and along < MIN_FACING:
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
