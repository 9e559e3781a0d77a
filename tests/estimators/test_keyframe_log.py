"""Keyframes hang on nodes: exact where nothing drifts, and the same in any frame."""

import numpy as np
import pytest
from tests.estimators.drives import (
    LAP,
    RING,
    SIGMA,
    begun,
    driven,
    keyframe,
    keyframes,
    motions,
    scanned,
    way,
)
from tests.filters.worlds import observe
from tests.numeric import wrapped

from impslam.estimators.base import MIN_SIGMA
from impslam.estimators.keyframe_log import NO_POINTS, KeyframeLog, blended, refined, revised
from impslam.estimators.keyframe_log import motions as log_motions
from impslam.estimators.pose_graph import PoseGraph
from impslam.geometry.se2 import between, compose, inverse

WAY = way(*LAP[:3])
START = np.array([3.0, -2.0, 2.5])
MOVED = np.array([5.0, 1.0, -2.0])


def logged(d_pose, scans=None, nodes=(), start=WAY[0]):
    """Return a log of motions (k, 3), and the graph of its nodes: keyframe 0, and those named."""
    keys, graph = KeyframeLog(), PoseGraph()
    scans = [None] * len(d_pose) if scans is None else scans
    for k, (d, scan) in enumerate(zip(d_pose, scans, strict=True)):
        keys.add(keyframe(k, d, scan), start if k == 0 else None)
        if k == 0:
            graph.add_root(keys.chain[0], 1e-8 * np.eye(3))
        if k in nodes:
            T = between(keys.chain[keys.nodes[-1]], keys.chain[k])
            graph.extend(T, np.diag(SIGMA**2), keys.since_node)
            keys.mark_node()
    return keys, graph


def apart(one, other):
    return np.abs(wrapped(one - other, 2)).max()


# --------------------------------------------------------------------------- the log


def test_the_chain_is_the_motions_composed_from_the_start():
    keys, _ = logged(motions(WAY), start=START)
    assert apart(keys.chain, compose(START, between(WAY[0], WAY))) < 1e-12
    assert len(keys) == len(WAY)


def test_a_motion_between_hosts_has_the_errors_of_the_tracked_one(rng):
    """Keyframe 2 is replaced by keyframe 0, which is turned by 2.2 rad and 0.3 m away from it."""
    d = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.4], [0.8, -0.1, -0.3], [0.5, 0.3, 0.6]])
    keys, spread = KeyframeLog(), np.diag(np.array([0.03, 0.005, 0.02]) ** 2)
    for k, motion in enumerate(d):
        keys.append(motion, spread, None, START if k == 0 else None)
        keys.points.append(NO_POINTS)
    T_host = np.array([0.3, -0.1, 2.2])
    keys.drop(np.array([2]), np.array([0]), T_host[None])
    rows = np.array([0, 1, 3])
    edges = log_motions(keys, rows)
    assert [*zip(edges.i.tolist(), edges.j.tolist(), strict=True)] == [(0, 1), (1, 0), (0, 2)]
    n = 20000
    for row, k in ((1, 2), (2, 3)):
        motion = d[k] + rng.multivariate_normal(np.zeros(3), spread, n)
        at = compose(T_host, motion) if k == 3 else compose(motion, inverse(T_host))
        error = wrapped(at - edges.T_i_j[row], 2)
        assert np.abs(error.mean(0)).max() < 4.0 * np.sqrt(spread.max() / n)
        covariance = np.linalg.inv(edges.information[row])
        np.testing.assert_allclose(
            np.cov(error.T), covariance, rtol=0.06, atol=0.02 * covariance.max()
        )


def test_distance_counts_driving_and_turning():
    keys, _ = logged([[9.0, 9.0, 1.0], [3.0, 4.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.5]])
    np.testing.assert_allclose(keys.distance, [0.0, 5.0, 5.3, 6.45])
    assert keys.since_node == pytest.approx(6.45)
    keys.mark_node()
    assert keys.since_node == 0.0


def test_the_node_before_is_the_newest_up_to_each_keyframe():
    keys, _ = logged(motions(WAY[:9]), nodes=(3, 7))
    assert keys.nodes.tolist() == [0, 3, 7]
    assert keys.node_before.tolist() == [0, 0, 0, 1, 1, 1, 1, 2, 2]


def test_scans_are_those_of_the_keyframes_that_have_some():
    scans = [None if k == 2 else scanned(RING, WAY[k]) for k in range(4)]
    keys, _ = logged(motions(WAY[:4]), scans)
    seen = keys.scans()
    assert len(seen.starts) == 5
    assert seen.starts[2] == seen.starts[3]
    assert seen.starts[-1] == len(seen.features)
    for k in (0, 1, 3):
        rows = seen.features[seen.starts[k] : seen.starts[k + 1]]
        np.testing.assert_array_equal(rows, keys.views[k].features)
    placed = keys.placed_scans(keys.chain)
    np.testing.assert_array_equal(placed.points, seen.features[:, :2])


# --------------------------------------------------------------------------- their poses


@pytest.mark.parametrize("nodes", [(), (1,), (5,), (6, 12, 18), range(1, len(WAY))])
def test_without_drift_all_poses_are_exact(nodes):
    keys, graph = logged(motions(WAY), nodes=nodes)
    for how in (revised, blended):
        assert apart(how(keys, graph), WAY) < 1e-12


def test_a_rigid_motion_of_the_nodes_moves_all_keyframes():
    keys, graph = logged(motions(WAY), nodes=(6, 12, 18))
    graph.poses = compose(MOVED, graph.poses)
    for how in (revised, blended):
        assert apart(how(keys, graph), compose(MOVED, WAY)) < 1e-12


def test_keyframes_follow_the_node_before_and_blended_ones_both():
    keys, graph = logged(motions(WAY[:13]), nodes=(4, 8))
    graph.poses[1] += [0.1, 0.2, 0.0]
    moved = revised(keys, graph) - WAY[:13]
    np.testing.assert_allclose(moved[:4], 0.0, atol=1e-12)
    np.testing.assert_allclose(moved[4:8], np.tile([0.1, 0.2, 0.0], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(moved[8:], 0.0, atol=1e-12)
    share = np.concatenate([np.linspace(0, 1, 5), np.linspace(1, 0, 5)[1:], np.zeros(4)])
    blend = blended(keys, graph) - WAY[:13]
    np.testing.assert_allclose(blend, share[:, None] * [0.1, 0.2, 0.0], atol=1e-12)


def test_blended_goes_through_all_nodes_and_never_the_long_way_round():
    """Nodes on both sides of a heading of pi: between them it is pi, not 0."""
    truth = way((0.0, 0.0), (-5.0, 0.0))
    keys, graph = logged(motions(truth), nodes=(6, 12), start=truth[0])
    graph.poses[:, 2] = [3.1, -3.1, 3.1]
    poses = blended(keys, graph)
    assert apart(poses[keys.nodes], graph.poses) < 1e-12
    assert (np.abs(poses[:, 2]) > 3.09).all()


# --------------------------------------------------------------------------- refined


def perturbed(poses, size, seed=3):
    """Return poses off by some noise, and the first one as it is."""
    out = poses + np.random.default_rng(seed).normal(0.0, 1.0, poses.shape) * size
    out[0] = poses[0]
    return out


@pytest.fixture(scope="module")
def seen():
    return [scanned(RING, pose) for pose in WAY]


def test_noiseless_scans_stay_where_they_are(seen):
    keys, _ = logged(motions(WAY), seen)
    assert apart(refined(WAY, keys), WAY) < 2e-3  # normals beside edges are rounded


def test_refinement_recovers_perturbed_keyframes(seen):
    keys, _ = logged(motions(WAY), seen)
    start = perturbed(WAY, [0.04, 0.04, 0.01])
    assert apart(start, WAY) > 0.08
    assert apart(refined(start, keys), WAY) < 0.01


def test_refinement_is_the_same_in_any_frame(seen):
    keys, _ = logged(motions(WAY), seen)
    start = perturbed(WAY, [0.02, 0.02, 0.005])
    one, two = refined(start, keys), refined(compose(MOVED, start), keys)
    assert apart(compose(MOVED, one), two) < 1e-7
    np.testing.assert_array_equal(two[0], compose(MOVED, start[0]))


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("sees", [True, False])
def test_few_keyframes_are_refined_too(seen, n, sees):
    keys, graph = logged(motions(WAY[:n]), seen[:n] if sees else None)
    assert apart(refined(blended(keys, graph), keys), WAY[:n]) < 2e-3


def test_keyframes_without_scans_keep_to_their_motions(seen):
    """Ten in the middle of the way see nothing; the others pull at them."""
    some = [None if 10 <= k < 20 else scan for k, scan in enumerate(seen)]
    keys, _ = logged(motions(WAY), some)
    start = perturbed(WAY, [0.02, 0.02, 0.005])
    assert apart(refined(start, keys), WAY) < 0.02


def test_a_keyframe_of_a_stationary_robot_is_refined_with_the_previous_one(seen):
    """Its motion is zero, with the smallest covariance that keyframes are added with."""
    way = np.insert(WAY, 11, WAY[10], axis=0)
    scans = [*seen[:11], seen[10], *seen[11:]]
    keys, _ = logged(motions(way), scans)
    keys._steps.replace(np.array([11]), MIN_SIGMA**2 * np.eye(3)[None])
    start = perturbed(way, [0.02, 0.02, 0.005])
    out = refined(start, keys)
    assert apart(out, way) < 0.01
    assert apart(out[10], out[11]) < 1e-3


def test_blind_scans_equal_missing_scans(seen):
    """A scan of which no beam comes back has no features, and is no keyframe without one."""
    blind = scanned(RING, WAY[0], range_max=0.1)
    assert not blind.valid.any()
    some = [blind if 10 <= k < 20 else scan for k, scan in enumerate(seen)]
    keys, _ = logged(motions(WAY), some)
    none, _ = logged(motions(WAY), [None if 10 <= k < 20 else s for k, s in enumerate(seen)])
    start = perturbed(WAY, [0.02, 0.02, 0.005])
    np.testing.assert_array_equal(refined(start, keys), refined(start, none))


# --------------------------------------------------------------------------- in the estimator


def test_without_keyframes_there_is_nothing_to_refine():
    made = begun()
    assert made.refine() is None
    assert made.landmarks() == ()
    assert made.state_size == 0


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("sees", [True, False])
def test_a_run_of_few_keyframes_refines(n, sees):
    frames = keyframes(RING, WAY[:n], noise=0.0)
    if not sees:
        frames = [keyframe(k, d) for k, d in enumerate(motions(WAY[:n]))]
    made = begun(WAY[0])
    driven(made, frames)
    done = made.refine()
    assert done.ids.tolist() == list(range(n))
    assert apart(done.poses, WAY[:n]) < 2e-3
    assert (np.linalg.eigvalsh(done.covariances) > 0.0).all()


def test_a_sensor_without_scans_is_mapped_by_what_it_sees():
    """Range and bearing to landmarks, as of a camera: no view, and landmarks all the same."""
    truth = way((0.0, 0.0), (3.0, 0.0), (3.0, 2.0), (0.0, 2.0), (0.0, 0.0), (3.0, 0.0))
    made = begun(truth[0])
    frames = [
        keyframe(k, d, None, observe(pose))
        for k, (d, pose) in enumerate(zip(motions(truth), truth, strict=True))
    ]
    driven(made, frames)
    assert apart(made.refine().poses, truth) < 1e-9
    assert sorted(m.kind for m in made.landmarks()) == ["cylinder"] * 5 + ["wall"] * 4


@pytest.mark.parametrize("k", [0, 1, 12])
@pytest.mark.parametrize("what", ["d_pose", "covariance"])
def test_a_keyframe_with_unknown_motion_is_reported_and_the_run_continues(k, what):
    frames = keyframes(RING, WAY, noise=0.0)
    getattr(frames[k].motion, what)[:] = np.nan
    made = begun(WAY[0])
    revisions = driven(made, frames)
    assert "not finite" in revisions[k].refused
    assert [r.refused for i, r in enumerate(revisions) if i != k] == [""] * (len(frames) - 1)
    done = made.refine()
    assert np.isfinite(done.poses).all()
    assert np.isfinite(done.covariances).all()
    made.landmarks()
