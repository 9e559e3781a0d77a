"""The chi-square gate has its stated rate, the choice is the best one, and walls stay apart."""

import numpy as np
import pytest
from scipy.stats import binom, multivariate_normal
from tests.association.scenes import R_POINT, mapped, move, pairs, point, wall

from impslam.association.assignment import unambiguous_pairs
from impslam.association.mahalanobis import Mahalanobis
from impslam.geometry.se2 import compose

ORIGIN = np.zeros(3)
ALONE = 1e-6  # 1/m^2: next to nothing else of the kind, so that gates and sums alone decide


@pytest.mark.parametrize("gate", [0.9, 0.99])
def test_the_gate_passes_true_pairings_at_its_rate(gate, rng):
    """Pose, first and second observation are drawn as the covariances say; 99.9 % bounds."""
    runs, passed, sigma = 1500, 0, np.array([0.05, 0.03, 0.02])
    for _ in range(runs):
        belief = mapped([point(ORIGIN, (2, 1), rng=rng)], sigma=sigma)
        pose = rng.normal(0.0, sigma)
        choice = belief.associate((point(pose, (2, 1), rng=rng),), Mahalanobis(gate=gate))
        passed += len(choice.matches)
    low, high = binom.ppf([0.0005, 0.9995], runs, gate)
    assert low <= passed <= high


def test_the_assignment_is_optimal_and_not_greedy():
    """Landmarks at 0 and 1, seen at 0.9 and 1.9: the nearest pair (0.9, 1) would waste the other."""
    belief = mapped([point(ORIGIN, (2, 0)), point(ORIGIN, (3, 0))], sigma=(0.5, 0.5, 1e-3))
    seen = (point(ORIGIN, (2.9, 0)), point(ORIGIN, (3.9, 0)))
    assert pairs(belief.associate(seen, Mahalanobis(density=ALONE))) == {0: 0, 1: 1}


@pytest.mark.parametrize("least", [0.0, 2.0])
@pytest.mark.parametrize("seed", range(10))
def test_choice_and_odds_equal_enumeration(seed, least):
    """A pair is taken if every assignment without it costs more by so much."""
    rng = np.random.default_rng(seed)
    cost, allowed = rng.normal(-1.0, 3.0, (4, 4)), rng.random((4, 4)) < 0.6
    every = []

    def descend(a, free, total, pairs):
        if a == len(cost):
            every.append((total, pairs))
            return
        descend(a + 1, free, total, pairs)
        for k in free:
            if allowed[a, k]:
                descend(a + 1, free - {k}, total + cost[a, k], pairs | {(a, k)})

    descend(0, frozenset(range(4)), 0.0, frozenset())
    total, best = min(every, key=lambda one: one[0])
    expected = {p for p in best if all(t >= total + least for t, some in every if p not in some)}
    a, k = np.nonzero(allowed)
    assert {(int(a[p]), int(k[p])) for p in unambiguous_pairs(a, k, cost[a, k], least)} == expected


def test_a_weak_pair_of_a_wall_is_not_taken_for_the_sake_of_a_weaker_one():
    """Two pieces of one wall are no alternatives to each other, but each may be of a new wall."""
    rows, columns = np.array([0, 1]), np.array([0, 0])
    for strong, expected in [(-1.0, []), (-5.0, [0])]:
        costs = np.array([strong, -0.5])
        assert unambiguous_pairs(rows[:1], columns[:1], costs[:1], 4.6, True) == expected
        assert unambiguous_pairs(rows, columns, costs, 4.6, True) == expected


def test_collinear_walls_five_metres_apart_stay_two():
    belief = mapped([wall(ORIGIN, [[2, -4], [2, -2]])])
    choice = belief.associate((wall(ORIGIN, [[2, 3], [2, 5]]),), Mahalanobis())
    assert choice.matches == ()
    assert choice.new == (0,)


def test_a_wall_is_recognised_from_a_later_pose():
    ends, later = [[4, -3], [4, 3]], np.array([1.5, 1.0, 0.8])
    belief = mapped([wall(ORIGIN, ends)], moved=later)
    assert pairs(belief.associate((wall(later, ends),), Mahalanobis())) == {0: 0}


def test_opposite_faces_of_a_thin_wall_stay_two():
    """Seen from either side of a partition 5 cm thick, within the pose's uncertainty."""
    near, far = [[2, -2], [2, 2]], [[2.05, -2], [2.05, 2]]
    behind = np.array([4.0, 0.0, 0.0])
    belief = mapped([wall(ORIGIN, near)], moved=behind, sigma=(0.1, 0.1, 0.02))
    choice = belief.associate((wall(behind, far),), Mahalanobis())
    assert choice.matches == ()
    assert choice.new == (0,)


def test_between_the_gates_is_neither_matched_nor_new():
    belief = mapped([point(ORIGIN, (2, 0))], sigma=(1e-6, 1e-6, 1e-6))
    sigma = np.sqrt(2.0 * R_POINT[0, 0] + 1e-8)
    outcome = []
    for sigmas in (3.5, 4.5, 5.5):  # gates: 3.7 and 5.3 sigma
        seen = point(ORIGIN, (2 + sigmas * sigma, 0))
        choice = belief.associate((seen,), Mahalanobis(density=ALONE))
        outcome.append((len(choice.matches), len(choice.new)))
    assert outcome == [(1, 0), (0, 0), (0, 1)]


def test_the_choice_does_not_depend_on_the_map_frame():
    """The same scene, twenty metres on and turned, seen from a pose that is known as well."""
    places = np.array([[2.0, 0.0], [2.4, 0.3], [2.1, 0.9]])
    seen = (point(ORIGIN, (2.15, 0.05)), point(ORIGIN, (2.3, 0.4)), point(ORIGIN, (2.0, 0.85)))
    found = []
    for start in (ORIGIN, np.array([20.0, -7.0, 2.5])):
        belief = mapped([], moved=start, sigma=(1e-6, 1e-6, 1e-6))
        assert np.allclose(belief.pose, compose(ORIGIN, start))
        belief.extend([point(ORIGIN, p) for p in places], 1.0)
        move(belief, ORIGIN, (0.3, 0.3, 0.05))
        found.append(pairs(belief.associate(seen, Mahalanobis(odds=1.0))))
    assert found[0] == found[1]
    assert len(found[0]) == 3


# --------------------------------------------------------------------------- density


def outcome(density, belief, seen):
    choice = belief.associate((seen,), Mahalanobis(density=density))
    return len(choice.matches), len(choice.new)


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [
        (0.01, (1, 0)),
        (0.3, (1, 0)),
        (1.0, (0, 0)),  # 1 / (2 pi) per m^2 at best, below 1 per m^2, but not by ten to one
        (5.0, (0, 1)),  # 160 to one that it is another
    ],
)
def test_a_wide_gate_with_one_landmark_inside_does_not_suffice(sigma, expected):
    """Seen exactly where it is expected: only how well that is known differs."""
    belief = mapped([point(ORIGIN, (2, 0))], sigma=(sigma, sigma, 1e-6))
    assert outcome(1.0, belief, point(ORIGIN, (2, 0))) == expected


@pytest.mark.parametrize("landmark", ["point", "wall"])
def test_the_density_decides_at_even_odds(landmark):
    """Matched while N(nu; 0, S) is above the density, new once ten times below it."""
    if landmark == "point":
        first, again = point(ORIGIN, (2, 1)), point(ORIGIN, (2.2, 0.9))
    else:
        first = wall(ORIGIN, [[2, -2], [2, 2]])
        again = wall(ORIGIN, [[2.2, -2], [2.1, 2]])
    belief = mapped([first], sigma=(0.2, 0.2, 0.05))
    (match,) = belief.associate((again,), Mahalanobis(density=ALONE)).matches
    likelihood = multivariate_normal(cov=match.S).pdf(match.innovation)
    assert outcome(0.99 * likelihood, belief, again) == (1, 0)
    assert outcome(1.01 * likelihood, belief, again) == (0, 0)
    assert outcome(9.9 * likelihood, belief, again) == (0, 0)
    assert outcome(10.1 * likelihood, belief, again) == (0, 1)


def test_a_tight_pair_is_kept_beside_one_that_is_too_vague():
    """Two landmarks, one of them known to metres only: just the other is matched."""
    belief = mapped([point(ORIGIN, (2, 0))], sigma=(2.0, 2.0, 1e-6))
    belief.extend([point(ORIGIN, (1, 1))], 1.0)  # relative to the robot known to centimetres
    seen = (point(ORIGIN, (2, 0)), point(ORIGIN, (1, 1)))
    assert pairs(belief.associate(seen, Mahalanobis())) == {1: 1}


def test_without_others_of_its_kind_a_wide_pair_is_taken():
    belief = mapped([point(ORIGIN, (2, 0))], sigma=(5.0, 5.0, 1e-6))
    assert outcome(ALONE, belief, point(ORIGIN, (2, 0))) == (1, 0)


@pytest.mark.parametrize("density", [0.0, -1.0])
def test_the_density_is_positive(density):
    with pytest.raises(ValueError, match="density"):
        Mahalanobis(density=density)
