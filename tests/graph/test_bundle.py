import numpy as np
import pytest
from tests.rooms import FRONT, MOUNTS, drive, scans_at

from impslam.errors import ShapeError
from impslam.geometry import se2
from impslam.geometry.angles import wrap
from impslam.graph.bearings import ScanFeatures, sort_by_bearing
from impslam.graph.block_system import empty_system
from impslam.graph.bundle import (
    Refinement,
    RefinementSettings,
    linearise,
    linearise_pair,
    refine,
)
from impslam.graph.overlaps import Nearness, overlaps
from impslam.graph.solve import marginals
from impslam.types import Edges

PRECISE = RefinementSettings(rounds=6)


def chain(poses, sigmas=(0.05, 0.05, 0.02)):
    T = se2.between(poses[:-1], poses[1:])
    information = np.tile(np.diag(np.array(sigmas) ** -2.0), (len(T), 1, 1))
    none = np.full(len(T), np.inf)
    return Edges(np.arange(len(T)), np.arange(1, len(T) + 1), T, information, none)


def perturbed(poses, seed=3):
    noise = np.random.default_rng(seed).normal(0, [0.03, 0.03, 0.01], poses.shape)
    noise[0] = 0.0
    return poses + noise


def off(one, two):
    error = se2.between(se2.compose(one[0], se2.between(two[0], two)), one)
    return np.abs(error).max(0)


@pytest.mark.parametrize("mount", MOUNTS)
def test_perturbed_keyframes_are_recovered(mount):
    truth = drive()
    guess = perturbed(truth)
    nearness = Nearness(turn=np.pi) if MOUNTS[mount].beams > 400 else None
    scans = scans_at(truth, MOUNTS[mount])
    done = refine(
        guess, scans, chain(guess, (0.5, 0.5, 0.2)), overlaps(guess, nearness), fit=PRECISE
    )
    assert (off(done.poses, truth) < 1e-3).all()
    assert (done.poses[0] == truth[0]).all()
    assert np.median(done.shares) > 0.7


def test_truth_stays():
    truth = drive()
    done = refine(truth, scans_at(truth), chain(truth), overlaps(truth))
    assert (off(done.poses, truth) < 5e-4).all()


def test_the_laser_may_sit_anywhere():
    truth = drive()
    guess = perturbed(truth)
    scans = scans_at(truth)
    lasers = np.tile(FRONT.pose[:2], (len(truth), 1))
    one = refine(guess, scans, chain(guess), overlaps(guess))
    two = refine(guess, scans._replace(lasers=lasers), chain(guess), overlaps(guess))
    assert one.poses.tobytes() == two.poses.tobytes()


@pytest.mark.parametrize("T", [[3.0, -7.0, 0.0], [-40.0, 25.0, 2.5]])
def test_a_rigid_motion_of_everything_moves_the_result(T):
    truth = drive()
    guess, scans = perturbed(truth), scans_at(truth)
    pairs, edges, moved = overlaps(guess), chain(guess), se2.compose(np.array(T), guess)
    one = refine(guess, scans, edges, pairs).poses
    two = refine(moved, scans, edges, pairs).poses
    assert (np.abs(se2.between(se2.compose(np.array(T), one), two)) < 1e-5).all()


def test_gradient_by_differences_with_fixed_pairs():
    truth = drive()[:2]
    scans = scans_at(truth)
    fans = sort_by_bearing(scans._replace(lasers=np.tile(scans.lasers, (2, 1))))
    d = se2.between(truth[0], truth[1]) + np.array([0.011, -0.007, 0.004])
    H, g = np.empty((3, 3)), np.empty(3)
    limits = 0.3, 1e6  # so wide a kernel weighs all points alike: the cost is a sum of squares
    linearise_pair(fans, 0, 1, d, limits, H, g)
    numeric = np.empty((3, 3))
    for a in range(3):
        up, down = np.empty(3), np.empty(3)
        step = np.eye(3)[a] * 1e-7  # too small for any point to change its partner
        linearise_pair(fans, 0, 1, d + step, limits, np.empty((3, 3)), up)
        linearise_pair(fans, 0, 1, d - step, limits, np.empty((3, 3)), down)
        numeric[:, a] = (up - down) / 2e-7
    # Gauss-Newton leaves out residuals times second derivatives, here up to 1 % of the turn's entry.
    np.testing.assert_allclose(H, numeric, rtol=0.03, atol=0.01 * np.abs(H).max())
    np.testing.assert_array_equal(H, H.T)


def test_gradient_of_the_cost_by_differences():
    truth = drive()[:2]
    scans = scans_at(truth)
    fans = sort_by_bearing(scans._replace(lasers=np.tile(scans.lasers, (2, 1))))
    features, starts = fans.scans.features.astype(float), fans.scans.starts
    d, g = se2.between(truth[0], truth[1]) + np.array([0.011, -0.007, 0.004]), np.empty(3)
    linearise_pair(fans, 0, 1, d, (0.3, 1e6), np.empty((3, 3)), g)
    mine, other = features[: starts[1]], features[starts[1] :]

    def moved(pose):
        return se2.transform(pose, other[:, :2])

    apart = np.linalg.norm(moved(d)[:, None] - mine[None, :, :2], axis=2)
    q, normals = apart.argmin(1), other[:, 2:4] @ se2.rotation(d[2]).T
    lone = other[:, 4] == 0.0
    use = (apart.min(1) < 0.3) & (mine[q, 4] > 0.0)
    use &= lone | ((normals * mine[q, 2:4]).sum(1) >= 0.7)

    def cost(pose):
        e = ((moved(pose) - mine[q, :2]) * mine[q, 2:4]).sum(1)
        return 0.5 * (mine[q, 4] * e * e)[use].sum()

    numeric = [(cost(d + s) - cost(d - s)) / 2e-6 for s in np.eye(3) * 1e-6]
    np.testing.assert_allclose(g, numeric, rtol=1e-5, atol=1e-7)


def test_a_keyframe_without_overlap_moves_by_its_edge_alone():
    truth = drive()
    scans = scans_at(truth)
    k = len(truth)
    # One more, far away and blind, known only from the last one.
    T = np.array([30.0, 5.0, 0.4])
    guess = perturbed(truth)
    guess = np.vstack([guess, se2.compose(guess[-1], T) + np.array([0.3, -0.2, 0.05])])
    scans = ScanFeatures(scans.features, np.append(scans.starts, scans.starts[-1]), scans.lasers)
    some = chain(guess[:k])
    edges = Edges(
        np.append(some.i, k - 1), np.append(some.j, k), np.vstack([some.T_i_j, T]),
        np.concatenate([some.information, np.diag([100.0, 100.0, 1000.0])[None]]),
        np.append(some.kernel, np.inf),
    )  # fmt: skip
    done = refine(guess, scans, edges, overlaps(guess), fit=PRECISE)
    np.testing.assert_allclose(se2.between(done.poses[k - 1], done.poses[k]), T, atol=2e-3)


def test_without_pairs_the_edges_decide():
    truth = drive()
    guess = perturbed(truth)
    none = np.empty((0, 2), np.int64)
    done = refine(guess, scans_at(truth), chain(truth), none, fit=PRECISE)
    assert (off(done.poses, truth) < 1e-3).all()


def test_keyframes_that_are_fixed_stay():
    truth = drive()
    guess, fixed = perturbed(truth), np.arange(10)
    done = refine(guess, scans_at(truth), chain(guess), overlaps(guess), fixed)
    assert (done.poses[:10] == guess[:10]).all()
    assert (done.poses[10:] != guess[10:]).any()


def test_nothing_or_one_keyframe_comes_back_as_it_is():
    no, none = np.empty(0, np.int64), np.empty((0, 2), np.int64)
    empty = Edges(no, no, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0))
    scans = ScanFeatures(np.empty((0, 5), np.float32), np.zeros(1, np.int64), np.zeros(2))
    assert refine(np.empty((0, 3)), scans, empty, none).poses.shape == (0, 3)
    one = refine(drive()[:1], scans_at(drive()[:1]), empty, none)
    assert one.poses.tobytes() == drive()[:1].tobytes()


def test_runs_are_the_same_to_the_byte():
    truth = drive()
    guess, scans = perturbed(truth), scans_at(truth)
    before = guess.copy(), scans.features.copy()
    one, two = (refine(guess, scans, chain(guess), overlaps(guess)) for _ in range(2))
    for a, b in zip(one, two, strict=True):
        assert a.tobytes() == b.tobytes()
    assert before[0].tobytes() == guess.tobytes()
    assert before[1].tobytes() == scans.features.tobytes()


def test_the_gradient_vanishes_at_the_end():
    truth = drive()
    guess, scans = perturbed(truth), scans_at(truth)
    fit, edges, pairs = RefinementSettings(rounds=8), chain(guess, (0.5, 0.5, 0.2)), overlaps(guess)
    poses = refine(guess, scans, edges, pairs, fit=fit).poses
    k, m = len(poses), len(pairs)
    fans = sort_by_bearing(scans._replace(lasers=np.tile(scans.lasers, (k, 1))))
    i, j = np.r_[pairs[:, 0], edges.i], np.r_[pairs[:, 1], edges.j]

    def gradient(at):
        system = empty_system(i, j, np.arange(k) == 0)
        here = Refinement(at, pairs, np.empty((m, 3, 3)), np.empty(m))
        linearise(here, fans, edges, fit, (0.15, 0.04), system)
        return np.abs(system.gradient).max()

    assert gradient(poses) < 0.02 * gradient(guess)


def test_information_is_not_more_than_the_noise_allows():
    # Independent noise of 3 cm, of which a claim with shared errors must not be surer.
    truth = drive()[:2]
    rng, chi2 = np.random.default_rng(5), []
    pairs = np.array([[0, 1]])
    weak = chain(truth, (10.0, 10.0, 10.0))
    T = se2.between(truth[0], truth[1])
    for _ in range(200):
        scans = scans_at(truth, noise=rng.normal(0, 0.03, (2, FRONT.beams)))
        done = refine(truth, scans, weak, pairs, fit=RefinementSettings(rounds=4))
        e = se2.between(done.poses[0], done.poses[1]) - T
        e[2] = wrap(float(e[2]))
        chi2.append(e @ done.information[0] @ e)
    assert np.mean(chi2) < 3.0
    assert np.mean(chi2) > 0.3  # nor so unsure that nothing is said


@pytest.mark.parametrize(("sigma", "shared"), [(0.03, 0.0), (0.015, 0.01)])
def test_the_covariance_covers_the_errors(sigma, shared):
    # Noise of each beam, and what eight neighbours have in common.
    truth = drive()[::2]
    rng, edges, pairs = np.random.default_rng(7), chain(truth, (0.5, 0.5, 0.2)), overlaps(truth)
    nees = []
    for _ in range(12):
        noise = rng.normal(0, sigma, (len(truth), FRONT.beams))
        noise += np.repeat(rng.normal(0, shared, (len(truth), 46)), 8, 1)[:, : FRONT.beams]
        done = refine(
            truth, scans_at(truth, noise=noise), edges, pairs, fit=RefinementSettings(rounds=4)
        )
        i, j = pairs.T
        T_i_j = se2.between(done.poses[i], done.poses[j])
        points = Edges(i, j, T_i_j, done.information, np.full(len(i), np.inf))
        both = Edges(*(np.concatenate(column) for column in zip(edges, points, strict=True)))
        P = marginals(done.poses, both, np.array([0]))
        e = done.poses - truth
        e[:, 2] = wrap(e[:, 2])
        nees += [e[j] @ np.linalg.solve(P[j], e[j]) for j in range(1, len(truth))]
    assert 0.5 < np.mean(nees) < 3.0


def test_an_edge_that_contradicts_the_scans_counts_for_little():
    truth = drive()
    scans, edges, pairs = scans_at(truth), chain(truth, (0.5, 0.5, 0.2)), overlaps(truth)

    def with_a_wrong_loop(kernel):
        wrong = Edges(
            np.append(edges.i, 3), np.append(edges.j, 60), np.vstack([edges.T_i_j, [1.0, 4.0, 1.0]]),
            np.concatenate([edges.information, np.diag([400.0, 400.0, 2500.0])[None]]),
            np.append(edges.kernel, kernel),
        )  # fmt: skip
        return off(refine(truth, scans, wrong, pairs).poses, truth)

    assert (with_a_wrong_loop(9.0) < 2e-3).all()
    assert (with_a_wrong_loop(np.inf) > 5e-3).any()


def test_what_does_not_fit_together_is_refused():
    truth = drive()[:5]
    scans, edges, pairs = scans_at(truth), chain(truth), overlaps(truth)
    with pytest.raises(ShapeError, match="starts has shape"):
        refine(truth[:4], scans, edges, pairs[:1])
    with pytest.raises(ShapeError, match="do not rise"):
        refine(truth, scans._replace(features=scans.features[:-1]), edges, pairs)
    with pytest.raises(ShapeError, match="not among the 5"):
        refine(truth, scans, edges, pairs + 1)
    with pytest.raises(ShapeError, match=r"edges\.kernel"):
        refine(truth, scans, edges._replace(kernel=edges.kernel[:2]), pairs)
