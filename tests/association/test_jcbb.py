"""JCBB finds the largest jointly compatible set; tests of single pairs are misled."""

import itertools
import time

import numpy as np
import pytest
from scipy.stats import chi2
from tests.association.scenes import mapped, pairs, point, wall

from impslam.association.jcbb import Jcbb
from impslam.association.mahalanobis import Mahalanobis
from impslam.association.nearest import Nearest

ORIGIN = np.zeros(3)
GATE = 0.999


def enumerate_all(belief, seen):
    """Return (count, d^2 + log det) of the best compatible set, by trying every one."""
    options = []
    for group in belief.hypothesise(seen):
        inside = (group.distance2 <= chi2.ppf(GATE, 2)) & group.possible
        options += [
            group.matches(np.flatnonzero(inside & (group.observations == i)).tolist())
            for i in range(len(seen))
        ]
    best = (0, 0.0)
    for chosen in itertools.product(*([None, *some] for some in options)):
        some = [match for match in chosen if match is not None]
        if not some or len({match.landmark for match in some}) < len(some):
            continue
        innovation, S = belief.joint(seen, some)
        d2 = innovation @ np.linalg.solve(S, innovation)
        if d2 <= chi2.ppf(GATE, len(innovation)):
            best = min(best, (-len(some), d2 + np.linalg.slogdet(S)[1]))
    return -best[0], best[1]


def value(belief, seen, choice):
    """Return (count, d^2 + log det) of a choice."""
    if not choice.matches:
        return 0, 0.0
    innovation, S = belief.joint(seen, choice.matches)
    d2 = innovation @ np.linalg.solve(S, innovation)
    return len(choice.matches), d2 + np.linalg.slogdet(S)[1]


def random_scene(seed, landmarks=5, seen=4):
    """A crowded map and a pose error larger than its spacing; one observation in four is spurious."""
    rng = np.random.default_rng(seed)
    places, sigma = rng.uniform(1.0, 3.0, (landmarks, 2)), np.array([0.4, 0.4, 0.1])
    belief = mapped([point(ORIGIN, p, rng=rng) for p in places], sigma=sigma)
    pose = rng.normal(0.0, sigma)
    true = [int(k) for k in rng.permutation(landmarks)[:seen]]
    observations = [point(pose, places[k], rng=rng) for k in true]
    if seed % 2:
        observations[0] = point(pose, rng.uniform(1.0, 3.0, 2))
    return belief, tuple(observations), true


def dense_scene(seed, count, spurious):
    """A scan of many points whose gates hold two landmarks on average; some observations are spurious.

    Return also which landmark each observation shows, of those that are not spurious.
    """
    rng, sigma = np.random.default_rng(seed), np.array([0.1, 0.1, 0.01])
    side = 2.6 * np.sqrt(count) * sigma[0] * 2.9  # one other landmark in an ellipse of 3.7 sigma
    places = rng.uniform(-side / 2, side / 2, (count, 2))
    belief = mapped([point(ORIGIN, p, rng=rng) for p in places], sigma=sigma)
    pose, order = rng.normal(0.0, sigma), rng.permutation(count)
    seen = [point(pose, places[k], rng=rng) for k in order]
    for i in range(spurious):
        seen[i] = point(pose, rng.uniform(-side / 2, side / 2, 2))
    return belief, tuple(seen), dict(enumerate(order.tolist()[spurious:], spurious))


def row(error):
    """A row of four posts half a metre apart, seen from a pose that is off by `error` along it."""
    places = [(2.0, y) for y in (0.0, 0.5, 1.0, 1.7)]
    belief = mapped([point(ORIGIN, p) for p in places], sigma=(0.3, 0.3, 0.01))
    pose = np.array([0.0, error, 0.0])
    return belief, tuple(point(pose, p) for p in places)


def test_a_pose_error_beyond_the_spacing_swaps_nearest_neighbours_but_not_jcbb():
    """Off by 0.6 m: each post is seen where its neighbour is expected (Neira & Tardós 2001)."""
    belief, seen = row(0.6)
    truth = {0: 0, 1: 1, 2: 2, 3: 3}
    wrong = pairs(belief.associate(seen[1:], Nearest()))
    assert any(wrong[a] != a + 1 for a in wrong)
    alone = pairs(belief.associate(seen[1:], Mahalanobis()))
    assert any(alone[a] != a + 1 for a in alone)
    assert pairs(belief.associate(seen[1:], Jcbb())) == {a - 1: k for a, k in truth.items() if a}


@pytest.mark.parametrize("seed", range(40))
def test_equal_to_enumeration(seed):
    belief, seen, _ = random_scene(seed)
    choice = belief.associate(seen, Jcbb())
    assert value(belief, seen, choice) == pytest.approx(enumerate_all(belief, seen), abs=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_the_order_of_observations_does_not_matter(seed):
    belief, seen, _ = random_scene(seed, landmarks=12, seen=8)
    here = pairs(belief.associate(seen, Jcbb()))
    order = np.random.default_rng(seed).permutation(len(seen))
    there = pairs(belief.associate(tuple(seen[i] for i in order), Jcbb()))
    assert {int(order[a]): k for a, k in there.items()} == here


def test_right_more_often_than_tests_of_single_pairs():
    """Eight of twelve posts seen, pose off by more than their spacing, forty draws."""
    right = {Jcbb: 0, Mahalanobis: 0}
    for seed in range(0, 80, 2):
        belief, seen, true = random_scene(seed, landmarks=12, seen=8)
        for kind in right:
            found = pairs(belief.associate(seen, kind()))
            right[kind] += sum(true[a] == k for a, k in found.items())
    assert right[Jcbb] > 0.97 * 320
    assert right[Mahalanobis] < 0.9 * right[Jcbb]


@pytest.mark.parametrize("count", [40, 100, 200])
def test_a_dense_scan_is_matched(count):
    """One observation in ten is spurious; a search of them all at once ends far from the best set."""
    right, wrong, total = 0, 0, 0
    for seed in range(4):
        belief, seen, true = dense_scene(seed, count, count // 10)
        found = pairs(belief.associate(seen, Jcbb()))
        right += sum(true.get(i) == k for i, k in found.items())
        wrong += sum(true.get(i) != k for i, k in found.items())
        total += len(true)
    assert right > 0.97 * total
    assert wrong < 0.01 * total


def test_the_time_of_a_dense_scan_is_bounded():
    """Ten times the observations have a covariance of a hundred times the size."""
    seconds = []
    for count in (20, 200):
        belief, seen, _ = dense_scene(0, count, count // 10)
        belief.associate(seen, Jcbb())
        start = time.process_time()
        for _ in range(3):
            belief.associate(seen, Jcbb())
        seconds.append(time.process_time() - start)
    assert seconds[1] < 100.0 * seconds[0]


def test_spurious_observations_are_rejected():
    """Something beside a post, inside that post's own gate but out of step with the others."""
    belief, seen = row(0.2)
    stray = point(ORIGIN, (2.25, 1.7))
    alone = belief.associate((stray,), Jcbb())
    assert len(alone.matches) == 1
    choice = belief.associate((*seen[:3], stray), Jcbb())
    assert pairs(choice) == {0: 0, 1: 1, 2: 2}
    assert choice.new == ()  # too near the post to be new


def test_points_and_walls_are_tested_jointly():
    """A wall shows the error of the pose, and so which of two posts is observed."""
    ends, posts = [[3, -2], [3, 2]], [(2.0, 0.0), (2.5, 0.0)]
    belief = mapped(
        [point(ORIGIN, p) for p in posts] + [wall(ORIGIN, ends)], sigma=(0.4, 0.4, 0.01)
    )
    pose = np.array([-0.5, 0.0, 0.0])
    seen = (point(pose, posts[0]), wall(pose, ends))
    assert pairs(belief.associate(seen[:1], Mahalanobis(density=1e-6, odds=1.0))) == {0: 1}
    assert pairs(belief.associate(seen, Jcbb())) == {0: 0, 1: 2}


def test_true_pairings_pass_the_joint_gate_at_its_rate(rng):
    """All innovations of a scan together are chi-square: the joint covariance is the right one."""
    places, sigma = np.array([[2.0, 0.0], [0.0, 3.0], [-2.0, -1.0]]), np.array([0.05, 0.05, 0.02])
    values = []
    for _ in range(400):
        belief = mapped([point(ORIGIN, p, rng=rng) for p in places], sigma=sigma)
        pose = rng.normal(0.0, sigma)
        seen = tuple(point(pose, p, i, rng=rng) for i, p in enumerate(places))
        choice = belief.associate(seen, Jcbb(gate=1.0 - 1e-12))
        innovation, S = belief.joint(seen, choice.matches)
        values.append(innovation @ np.linalg.solve(S, innovation))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(values)) / len(values)
    assert low < np.mean(values) < high


def test_the_joint_covariance_is_that_of_the_dense_formula():
    """H and P written out in full, for points and walls in mixed order."""
    seen = (
        point(ORIGIN, (2, 1)),
        wall(ORIGIN, [[3, -2], [3, 2]]),
        point(ORIGIN, (-1, 2)),
        wall(ORIGIN, [[-2, 3], [2, 3]]),
    )
    belief = mapped(seen, moved=(0.3, 0.1, 0.2), sigma=(0.1, 0.2, 0.05))
    made = {match.observation: match for match in belief.associate(seen, Nearest()).matches}
    some = [made[i] for i in (3, 0, 2, 1)]
    innovation, S = belief.joint(seen, some)
    H, R = np.zeros((8, belief.state_size)), np.zeros((8, 8))
    for i, match in enumerate(some):
        here, kind = slice(2 * i, 2 * i + 2), seen[match.observation].kind
        table = belief._atlas.table(kind)
        columns = table.columns[table.ids.tolist().index(match.landmark)]
        there = table.model.predict(belief.pose, belief.belief.mean[columns][None])
        H[here, :3], H[here, columns] = there.z_D_pose[0], there.z_D_m[0]
        R[here, here] = seen[match.observation].R
    np.testing.assert_allclose(S, H @ belief.belief.covariance @ H.T + R, atol=1e-12)
    for i, match in enumerate(some):
        here = slice(2 * i, 2 * i + 2)
        np.testing.assert_allclose(innovation[here], match.innovation, atol=1e-12)
        np.testing.assert_allclose(S[here, here], match.S, atol=1e-12)


@pytest.mark.parametrize("budget", [1, 10, 40])
def test_a_search_cut_short_still_returns_compatible_pairs(budget):
    for seed in range(10):
        belief, seen, _ = random_scene(seed, landmarks=20, seen=12)
        choice = belief.associate(seen, Jcbb(budget=budget, odds=1.0))
        assert choice.matches
        innovation, S = belief.joint(seen, choice.matches)
        d2 = innovation @ np.linalg.solve(S, innovation)
        assert d2 <= chi2.ppf(GATE, len(innovation))


def test_for_a_known_pose_pairs_are_tested_one_by_one_by_the_same_gates():
    alone = Jcbb(gate=0.99, new_gate=0.9999, odds=5.0).for_known_pose()
    assert not alone.is_joint
    assert (alone.gate, alone.new_gate, alone.odds) == (0.99, 0.9999, 5.0)
    assert alone.for_known_pose() is alone


@pytest.mark.parametrize(
    ("off", "matched"), [(0.3, {0: 0, 1: 1, 2: 2, 3: 3}), (1.0, {0: 0, 1: 1, 2: 2})]
)
def test_a_poor_pair_among_good_ones_is_left_out(off, matched):
    """A post seen badly, 1 and 3.3 standard deviations from its place: both pass the joint gate."""
    posts = [(2.0, 0.0), (1.0, 2.0), (1.0, -2.0), (3.0, 1.0)]
    good = [point(ORIGIN, p) for p in posts]
    belief = mapped([*good[:3], good[3].with_noise(0.09 * np.eye(2))])
    seen = (*good[:3], point(ORIGIN, (3.0 + off, 1.0)))
    choice = belief.associate(seen, Jcbb())
    assert pairs(choice) == matched
    assert choice.new == ()  # too near the post to be new
    assert choice.ambiguous == tuple({0, 1, 2, 3} - set(matched))
