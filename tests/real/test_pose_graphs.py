"""Published pose graphs, solved to their optima."""

import numpy as np
import pytest
from benchmarks.g2o import read_g2o
from benchmarks.initial_poses import initial

from impslam.graph.solve import marginals, solve

pytestmark = pytest.mark.real
FIRST = np.array([0])

OPTIMA = {
    "intel": 45.0047,
    "input_M3500_g2o": 137.913,
    "input_M3500b_g2o": 2054.716,
    "input_MITb_g2o": 41.163,
}
"""Chi-squares, 2026-11-22. The error of gtsam 4.3 is the logarithm of the format's: 1e-5 to 1e-3 apart."""


@pytest.mark.parametrize("name", OPTIMA)
def test_published_graphs_reach_their_optima(data_folder, name):
    graph = read_g2o(data_folder / "pose-graphs" / f"{name}.g2o")
    start = initial(graph.poses, graph.edges, FIRST)
    solution = solve(start, graph.edges, FIRST)
    assert solution.chi2 == pytest.approx(OPTIMA[name], rel=1e-5)
    covariances = marginals(solution.poses, graph.edges, FIRST)[1:]
    assert (np.linalg.eigvalsh(covariances) > 0.0).all()


@pytest.mark.parametrize("name", ["intel", "input_M3500_g2o"])
def test_odometry_is_start_enough_where_it_is_good(data_folder, name):
    graph = read_g2o(data_folder / "pose-graphs" / f"{name}.g2o")
    solution = solve(graph.poses, graph.edges, FIRST)
    assert solution.chi2 == pytest.approx(OPTIMA[name], rel=1e-6)
    assert solution.iterations <= 8


@pytest.mark.parametrize("name", ["intel", "input_MITb_g2o"])
def test_gtsam_finds_the_same(data_folder, name):
    gtsam = pytest.importorskip("gtsam")
    path = data_folder / "pose-graphs" / f"{name}.g2o"
    graph = read_g2o(path)
    poses = solve(initial(graph.poses, graph.edges, FIRST), graph.edges, FIRST).poses
    factors, _ = gtsam.readG2o(str(path), False)
    tight = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*poses[0]), tight))
    start = gtsam.Values()
    for key, pose in zip(graph.ids, poses, strict=True):
        start.insert(int(key), gtsam.Pose2(*pose))
    best = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
    assert 2.0 * factors.error(best) == pytest.approx(OPTIMA[name], rel=2e-3)
    there = np.array([[p.x(), p.y(), p.theta()] for p in map(best.atPose2, graph.ids.tolist())])
    P = marginals(poses, graph.edges, FIRST)
    assert np.abs(there - poses)[1:, :2].max() < 0.1 * np.sqrt(
        P[1:, :2, :2].diagonal(0, 1, 2).max()
    )
    theirs = gtsam.Marginals(factors, best)
    for key in graph.ids[[5, -1]].tolist():
        c, s = np.cos(there[key, 2]), np.sin(there[key, 2])
        B = np.array(
            [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
        )  # its errors are in the pose's axes
        sigmas = np.sqrt(np.diag(P[key]))
        difference = B @ theirs.marginalCovariance(key) @ B.T - P[key]
        assert np.abs(difference / np.outer(sigmas, sigmas)).max() < 0.02
