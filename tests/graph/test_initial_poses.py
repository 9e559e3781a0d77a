import numpy as np
import pytest
from benchmarks.initial_poses import initial
from tests.graph.pose_graphs import random_graph

from impslam.errors import NumericalError
from impslam.geometry import se2
from impslam.geometry.angles import wrap
from impslam.graph.solve import solve
from impslam.types import Edges


def close(poses, others, atol):
    difference = poses - others
    difference[:, 2] = wrap(difference[:, 2])
    np.testing.assert_allclose(difference, 0.0, atol=atol)


@pytest.mark.parametrize("fixed", [[0], [3], [0, 20, 41]])
def test_noiseless_edges_give_the_truth_from_fixed_poses_alone(fixed):
    truth, edges, _ = random_graph(60, 25, seed=1, noise=0.0)
    start = np.random.default_rng(0).normal(0, 20, truth.shape)
    start[fixed] = truth[fixed]
    close(initial(start, edges, np.array(fixed)), truth, 1e-8)


def test_a_rigid_motion_of_everything_moves_the_start():
    _, edges, start = random_graph(60, 25, seed=2)
    motion, first = np.array([5.0, -70.0, -1.8]), np.array([0])
    moved = initial(se2.compose(motion, start), edges, first)
    close(moved, se2.compose(motion, initial(start, edges, first)), 1e-7)


def test_it_leads_to_the_optimum_from_a_useless_start():
    truth, edges, start = random_graph(150, 60, seed=3)
    first = np.array([0])
    useless = np.random.default_rng(0).normal(0, 20, truth.shape)
    useless[0] = truth[0]
    best = solve(start, edges, first)
    close(solve(initial(useless, edges, first), edges, first).poses, best.poses, 1e-6)


def test_what_edges_do_not_determine_is_named():
    _, edges, start = random_graph(20, 0)
    loose = Edges(*(np.delete(a, 11, axis=0) for a in edges))
    with pytest.raises(NumericalError, match="pose 12 is not determined"):
        initial(start, loose, np.array([0]))
    blind = edges.information.copy()
    blind[:, 2, 2] = 0.0
    with pytest.raises(NumericalError, match="is not determined"):
        initial(start, edges._replace(information=blind), np.array([0]))
