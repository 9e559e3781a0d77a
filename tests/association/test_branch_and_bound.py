"""The search against enumeration on bare matrices, where every rule of it decides some case."""

import itertools

import numpy as np
import pytest
from scipy.stats import chi2

from impslam.association.branch_and_bound import NONE, search
from impslam.geometry.chi_square import quantile, quantiles


def problem(rng):
    """Pairs of rows of mixed size whose joint distances lie about the gate, shared landmarks."""
    n = 4
    dims, counts = rng.integers(1, 4, n), rng.integers(1, 4, n)
    groups = np.concatenate([[0], np.cumsum(counts)])
    sizes = np.repeat(dims, counts)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    landmarks = np.concatenate([rng.permutation(4)[:c] for c in counts])
    noises = rng.uniform(0.2, 1.0, n)
    R = np.diag(np.repeat(np.repeat(noises, counts), sizes))
    B = rng.normal(0.0, 0.7, (starts[-1], 3))
    S = B @ B.T + R
    nu = 1.6 * np.linalg.cholesky(S) @ rng.normal(size=starts[-1])
    return S, nu, starts, landmarks, groups, dims, dims * np.log(noises)


def run(case, gate, budget=10**6, beat=(0, np.inf)):
    S, nu, starts, landmarks, groups, dims, noise = case
    rest = np.append(0, np.cumsum(dims[::-1]))[::-1]  # reversed views, as the caller has them
    floor = np.append(0.0, np.cumsum(noise[::-1]))[::-1]
    limits = quantiles(gate, int(dims.sum()))
    found, _, full = search(
        (S, nu), (starts, landmarks), groups, (rest, floor), limits, budget, beat
    )
    return found, full


def worth(case, gate, chosen):
    """Return (-count, d^2 + log det) of pairs, or None where they exclude one another."""
    S, nu, starts, landmarks, *_ = case
    if len({int(landmarks[p]) for p in chosen}) < len(chosen):
        return None
    rows = np.concatenate([np.arange(starts[p], starts[p + 1]) for p in chosen] or [[]]).astype(int)
    block = S[np.ix_(rows, rows)]
    d2 = nu[rows] @ np.linalg.solve(block, nu[rows])
    if len(rows) and d2 > chi2.ppf(gate, len(rows)):
        return None
    return -len(chosen), d2 + np.linalg.slogdet(block)[1]


@pytest.mark.parametrize("gate", [0.9, 0.999])
def test_equal_to_enumeration(gate):
    """A search that is wrong in 3 % of such problems passes 100 with a chance of 5 % (0.97^100)."""
    rng = np.random.default_rng(11)
    for _ in range(100):
        case = problem(rng)
        groups = case[4]
        options = [[None, *range(a, b)] for a, b in itertools.pairwise(groups)]
        sets = ([p for p in some if p is not None] for some in itertools.product(*options))
        best = min(w for w in (worth(case, gate, some) for some in sets) if w is not None)
        found, full = run(case, gate)
        assert full
        assert worth(case, gate, [p for p in found if p != NONE]) == pytest.approx(best, abs=1e-9)


def test_only_a_set_that_beats_another_is_returned():
    rng = np.random.default_rng(12)
    for _ in range(30):
        case = problem(rng)
        best = run(case, 0.999)[0]
        count, score = worth(case, 0.999, [p for p in best if p != NONE])
        assert (run(case, 0.999, beat=(-count, score + 1e-6))[0] == best).all()
        assert (run(case, 0.999, beat=(-count, score - 1e-6))[0] == NONE).all()
        assert (run(case, 0.999, beat=(1 - count, np.inf))[0] == NONE).all()


def test_only_complete_sets_are_tested():
    """Two innovations of 3.2 sigma fail the gate of two, and pass that of six in any order."""
    nu = np.array([3.2, 3.2, 0.0, 0.0, 0.0, 0.0])
    one = np.ones(6, np.int64)
    for order in (nu, nu[::-1].copy()):
        case = (np.eye(6), order, np.arange(7), np.arange(6), np.arange(7), one, np.zeros(6))
        assert (run(case, 0.999)[0] != NONE).all()


def test_a_spent_budget_is_reported_and_bounds_the_work():
    """Twenty observations of ten landmarks each, all alike: a full search would never end."""
    rng, n, k = np.random.default_rng(0), 20, 10
    size = np.full(n, 1)
    case = (
        np.eye(n * k),
        rng.uniform(2.0, 3.0, n * k),
        np.arange(n * k + 1),
        np.tile(np.arange(k), n),
        np.arange(0, n * k + 1, k),
        size,
        np.zeros(n),
    )
    found, full = run(case, 0.999, budget=2000)
    assert not full
    assert worth(case, 0.999, [p for p in found if p != NONE]) is not None
    assert (found != NONE).any()


def test_quantiles_are_those_of_chi_square():
    table = quantiles(0.99, 5)
    assert table[0] == 0.0
    np.testing.assert_allclose(table[1:], chi2.ppf(0.99, [1, 2, 3, 4, 5]))
    assert quantile(0.99, 2) == pytest.approx(-2.0 * np.log(0.01))
