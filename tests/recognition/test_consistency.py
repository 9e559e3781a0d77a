"""Closures that are true agree as often as their covariances say, and a false one does not."""

import numpy as np
from scipy.stats import chi2, kstest

from impslam.geometry.se2 import between, compose
from impslam.recognition.consistency import GATE, Relation, consistent, distance2

NOTHING = Relation(np.zeros(3), np.zeros((3, 3)))


def random_pose(rng):
    return rng.uniform([-5.0, -5.0, -np.pi], [5.0, 5.0, np.pi])


def covariance(rng, scale):
    root = rng.normal(size=(3, 5)) * scale
    return root @ root.T / 5.0


def relations(rng, scale=0.01):
    """Return both closures and both chains between four places, with errors as they say."""
    a, b, c, d = (random_pose(rng) for _ in range(4))
    found = []
    for one, other in ((a, b), (c, d), (a, c), (b, d)):
        P = covariance(rng, scale)
        noise = np.linalg.cholesky(P) @ rng.standard_normal(3)
        found.append(Relation(between(one, other) + noise, P))
    return found


def test_true_closures_agree_as_their_covariances_say(rng):
    d2 = [distance2(*relations(rng)) for _ in range(2000)]
    assert kstest(d2, chi2(3).cdf).pvalue > 0.01


def test_noiseless_closures_agree_exactly(rng):
    a, b, c, d = (random_pose(rng) for _ in range(4))
    P = covariance(rng, 0.1)
    exact = [Relation(between(*pair), P) for pair in ((a, b), (c, d), (a, c), (b, d))]
    assert distance2(*exact) < 1e-20


def test_a_false_closure_is_refused(rng):
    one, other, references, queries = relations(rng)
    assert consistent(one, other, references, queries)
    for error in ([1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.5]):
        wrong = Relation(compose(one.pose, np.array(error)), one.covariance)
        assert not consistent(wrong, other, references, queries)


def test_closures_between_the_same_places_are_compared_alone():
    P = np.diag([0.01, 0.01, 0.001])
    one = Relation(np.array([1.0, 2.0, np.pi - 0.01]), P)
    other = Relation(np.array([1.1, 2.0, 0.01 - np.pi]), P)
    expected = 0.1**2 / 0.02 + 0.02**2 / 0.002
    assert np.isclose(distance2(one, other, NOTHING, NOTHING), expected)


def test_the_gate_refuses_one_true_pair_in_a_hundred():
    assert np.isclose(chi2.ppf(0.99, 3), GATE, atol=1e-3)
