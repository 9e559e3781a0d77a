"""How near to the GPS fixes of Victoria Park a path by odometry and trees can be.

    python benchmarks/outdoor_bound.py --data ../shared/data

All motions and matched trees of a run are solved at once by Gauss-Newton with Cauchy weights: without the
fixes, which gives the most likely path; for random errors of all measurements, which gives paths that are
as likely as the true one; and with the fixes, which gives the distance from them that no path explains.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, csc_array, eye_array
from scipy.sparse.linalg import SuperLU, splu

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.real_logs import Run  # noqa: E402  found from the root of the project

from impslam.evaluation.fixes import plausible  # noqa: E402  from the root
from impslam.evaluation.trajectory import align, interpolate  # noqa: E402
from impslam.geometry.angles import wrap  # noqa: E402
from impslam.geometry.se2 import between, transform  # noqa: E402
from impslam.map import Keyframe, PathRows, Revision  # noqa: E402
from impslam.open_log import open_log  # noqa: E402
from impslam.run import map_log  # noqa: E402
from impslam.types import Array, Ints, TruePose  # noqa: E402

START_SIGMA = 1e-4  # m and rad, of the first pose, which fixes the frame
MIN_SIGMA = 1e-3  # m and rad, of a motion: a stationary car has none
KERNEL = 3.0  # sigmas at which a Cauchy weight is a half
FIX_SIGMA = 3.0  # m, of a fix without corrections, under trees
ITERATIONS = 12
SAMPLES = 100


@dataclass
class Matched(Run):
    """A run with its motions, matched observations and fixes."""

    stamps: list[float] = field(default_factory=list)
    motions: list[tuple[Array, Array]] = field(default_factory=list)
    sightings: list[tuple[int, int, Array, Array]] = field(default_factory=list)
    fixes: list[Array] = field(default_factory=list)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Store the motion to the keyframe, and its observations of landmarks: keyframe, id, z, R."""
        super().revise(keyframe, revision, path)
        pairs = [(m.observation, m.landmark) for m in revision.matches]
        pairs += zip(revision.origins, revision.added, strict=True)
        seen = keyframe.observations
        self.sightings += [(len(self.stamps), n, seen[i].z, seen[i].R) for i, n in pairs]
        self.stamps.append(keyframe.motion.stamp)
        self.motions.append((keyframe.motion.d_pose, keyframe.motion.covariance))

    def truth(self, pose: TruePose) -> None:
        """Store a fix."""
        self.fixes.append(np.array([pose.stamp, *pose.pose]))


@dataclass(frozen=True, eq=False)
class Problem:
    """Measurements of n poses and m trees, with square roots of their information (..., d, d).

    Attributes
    ----------
    d_pose, motion_roots : (n - 1, 3), (n - 1, 3, 3) motions from pose to pose
    pose, tree, z, roots : (k,), (k,), (k, 2), (k, 2, 2) which pose observes which tree where
    before, share, fixes : (g,), (g,), (g, 2) a fix lies after a pose, by a share of the way to the next
    """

    d_pose: Array
    motion_roots: Array
    pose: Ints
    tree: Ints
    z: Array
    roots: Array
    before: Ints
    share: Array
    fixes: Array


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses (n, 3), trees (m, 2), the weighted Jacobian at them and the factors of its normal matrix."""

    poses: Array
    trees: Array
    J: csc_array
    factors: SuperLU

    def sampled(self, rng: np.random.Generator) -> Array:
        """Return poses (n, 3) for random errors of all measurements."""
        step = self.factors.solve(self.J.T @ rng.standard_normal(self.J.shape[0]))
        return np.asarray(self.poses + step[: self.poses.size].reshape(-1, 3))


def problem(seen: Matched) -> Problem:
    """Return the measurements of a run."""
    stamps, fixes = np.array(seen.stamps), np.array(seen.fixes)
    fixes = fixes[plausible(fixes, np.array(seen.wheels))]
    fixes = fixes[(fixes[:, 0] >= stamps[0]) & (fixes[:, 0] < stamps[-1])]
    before = np.searchsorted(stamps, fixes[:, 0], side="right") - 1
    share = (fixes[:, 0] - stamps[before]) / (stamps[before + 1] - stamps[before])
    pose, numbers, z, R = (np.array(column) for column in zip(*seen.sightings, strict=True))
    d_pose, Q = (np.array(column)[1:] for column in zip(*seen.motions, strict=True))
    tree = np.unique(numbers, return_inverse=True)[1]
    motion_roots = _roots(Q + MIN_SIGMA**2 * np.eye(3))
    return Problem(d_pose, motion_roots, pose, tree, z, _roots(R), before, share, fixes[:, 1:3])


def _roots(covariances: Array) -> Array:
    return np.asarray(np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariances)), -1, -2))


def solve(p: Problem, poses: Array, fix_sigma: float = np.inf) -> Solution:
    """Return the most likely path; with a finite `fix_sigma`, m, the fixes are measurements, too."""
    trees = np.zeros((p.tree.max() + 1, 2))
    trees[p.tree] = [transform(poses[k], z) for k, z in zip(p.pose, p.z, strict=True)]
    for _ in range(ITERATIONS):
        parts = [_start(poses), _motions(p, poses), _sightings(p, poses, trees)]
        parts += [_fixes(p, poses, fix_sigma)] if np.isfinite(fix_sigma) else []
        J, r = _assembled(parts, poses.size + trees.size)
        normal = csc_array(J.T @ J + 1e-9 * eye_array(J.shape[1]))
        factors = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        step = -factors.solve(J.T @ r)
        poses = poses + step[: poses.size].reshape(-1, 3)
        trees = trees + step[poses.size :].reshape(-1, 2)
    return Solution(poses, trees, J, factors)


Part = tuple[Array, Ints, Array]
"""Residuals (k, d), the variables (k, v) they depend on, and their Jacobians (k, d, v)."""


def _start(poses: Array) -> Part:
    return np.zeros((1, 3)), np.arange(3)[None], np.eye(3)[None] / START_SIGMA


def _motions(p: Problem, poses: Array) -> Part:
    k = 3 * np.arange(len(poses) - 1)
    moved = between(poses[:-1], poses[1:])
    r = moved - p.d_pose
    r[:, 2] = wrap(r[:, 2])
    J = np.zeros((len(k), 3, 6))
    J[:, :2, 3:5] = _turned(poses[:-1, 2])
    J[:, :2, :2] = -J[:, :2, 3:5]
    J[:, 0, 2], J[:, 1, 2] = moved[:, 1], -moved[:, 0]
    J[:, 2, 2], J[:, 2, 5] = -1.0, 1.0
    return _weighted(r, k[:, None] + np.arange(6), J, p.motion_roots)


def _sightings(p: Problem, poses: Array, trees: Array) -> Part:
    turn = _turned(poses[p.pose, 2])
    seen = np.einsum("kij,kj->ki", turn, trees[p.tree] - poses[p.pose, :2])
    J = np.concatenate([-turn, seen[:, ::-1, None] * [[1.0], [-1.0]], turn], axis=2)
    columns = np.concatenate(
        [3 * p.pose[:, None] + np.arange(3), poses.size + 2 * p.tree[:, None] + np.arange(2)], 1
    )
    return _weighted(seen - p.z, columns, J, p.roots)


def _fixes(p: Problem, poses: Array, sigma: float) -> Part:
    """Return the residuals of the fixes, moved to where they fit the path best."""
    at = positions(p, poses)
    r = (at - transform(align(p.fixes, at), p.fixes)) / sigma
    columns = 3 * p.before[:, None] + np.array([0, 1, 3, 4])
    shares = np.stack([1.0 - p.share, p.share], 1) / sigma
    return r, columns, np.einsum("ks,ij->kisj", shares, np.eye(2)).reshape(-1, 2, 4)


def _turned(headings: Array) -> Array:
    """Return the rotations (k, 2, 2) from map to poses."""
    c, s = np.cos(headings), np.sin(headings)
    return np.moveaxis(np.array([[c, s], [-s, c]]), -1, 0)


def _weighted(r: Array, columns: Ints, J: Array, roots: Array) -> Part:
    r, J = np.einsum("kij,kj->ki", roots, r), roots @ J
    weights = 1.0 / np.sqrt(1.0 + np.sum(r**2, axis=1) / KERNEL**2)
    return weights[:, None] * r, columns, weights[:, None, None] * J


def _assembled(parts: list[Part], size: int) -> tuple[csc_array, Array]:
    """Return the Jacobian (rows, size) and the residuals (rows,)."""
    rows, columns, values, first = [], [], [], 0
    for r, variables, J in parts:
        numbers = first + np.arange(r.size).reshape(r.shape)
        rows.append(np.broadcast_to(numbers[:, :, None], J.shape).ravel())
        columns.append(np.broadcast_to(variables[:, None], J.shape).ravel())
        values.append(J.ravel())
        first += r.size
    where = np.concatenate(rows), np.concatenate(columns)
    J = csc_array(coo_array((np.concatenate(values), where), shape=(first, size)))
    return J, np.concatenate([r.ravel() for r, _, _ in parts])


def positions(p: Problem, poses: Array) -> Array:
    """Return the positions (g, 2) of the antenna, at base_link, at the times of the fixes."""
    a, b = poses[p.before, :2], poses[p.before + 1, :2]
    return np.asarray(a + p.share[:, None] * (b - a))


def rms(p: Problem, poses: Array) -> float:
    """Return the root mean square distance of the fixes from the path, after the best rigid fit."""
    at = positions(p, poses)
    return float(np.sqrt(np.mean(np.sum((at - transform(align(p.fixes, at), p.fixes)) ** 2, 1))))


def main() -> None:
    """Print the distances."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    config, source = open_log(parser.parse_args().data / "victoria-park")
    seen = Matched()
    map_log(config, source, [seen])
    p, stamps = problem(seen), np.array(seen.stamps)
    path = interpolate(seen.path, stamps)
    best, near = solve(p, path), solve(p, path, FIX_SIGMA)
    rng = np.random.default_rng(0)
    chance = np.array([rms(p, best.sampled(rng)) for _ in range(SAMPLES)])
    low, high = np.quantile(chance, [0.025, 0.975])
    show: Callable[[float], str] = "{:.2f} m".format
    print(f"run {show(rms(p, path))}, most likely path {show(rms(p, best.poses))}")
    print(f"samples of the posterior: 95 % from {show(low)} to {show(high)}")
    print(f"of them under 1.5 m: {100 * np.mean(chance < 1.5):.0f} %")
    print(f"with the fixes, sigma {FIX_SIGMA:g} m: {show(rms(p, near.poses))}")


if __name__ == "__main__":
    main()
