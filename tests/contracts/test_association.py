"""What every association must keep, whatever it chooses by."""

import numpy as np
import pytest
from tests.association.scenes import mapped, pairs, point, wall

from impslam.component import components

ORIGIN = np.zeros(3)
ROOM = [[[3, -3], [3, 3]], [[3, 3], [-3, 3]], [[-3, 3], [-3, -3]], [[-3, -3], [3, -3]]]


@pytest.fixture(params=sorted(components("association")))
def association(request):
    return components("association")[request.param]()


def scene(rng, n=6):
    places = rng.uniform(-2.5, 2.5, (n, 2))
    seen = [point(ORIGIN, p, i, rng=rng) for i, p in enumerate(places)]
    return seen + [wall(ORIGIN, ends, 100 + i) for i, ends in enumerate(ROOM)]


@pytest.mark.parametrize("seed", range(10))
def test_each_observation_and_each_landmark_at_most_once(association, seed):
    """Crowded scenes, with every observation in them twice."""
    rng = np.random.default_rng(seed)
    belief = mapped(scene(rng), sigma=(0.5, 0.5, 0.2))
    seen = tuple(scene(np.random.default_rng(seed)) + scene(rng))
    choice = belief.associate(seen, association)
    asked, given = [m.observation for m in choice.matches], [m.landmark for m in choice.matches]
    assert asked == sorted(set(asked))
    assert set(asked).isdisjoint(choice.new)
    assert set(choice.new) <= set(range(len(seen)))
    assert len(given) == len(set(given))


def test_kinds_are_not_mixed(association):
    belief = mapped([point(ORIGIN, (1, 1), 0)])
    choice = belief.associate((point(ORIGIN, (1, 1), kind="corner"),), association)
    assert choice.matches == ()
    assert choice.new == (0,)


def test_nothing_seen(association):
    for belief in (mapped([]), mapped([point(ORIGIN, (1, 1), 0)])):
        choice = belief.associate((), association)
        assert choice.matches == ()
        assert choice.new == ()


def test_without_landmarks_everything_is_new(association):
    seen = (point(ORIGIN, (1, 1), 0), wall(ORIGIN, ROOM[0], 1))
    choice = mapped([]).associate(seen, association)
    assert choice.matches == ()
    assert choice.new == (0, 1)


def test_exact_observations_find_their_landmarks_in_any_order(association, rng):
    seen = [point(ORIGIN, p, i) for i, p in enumerate([(2, 0), (-2, 0.5), (0, 2.2), (0.3, -2.3)])]
    seen += [wall(ORIGIN, ends, 100 + i) for i, ends in enumerate(ROOM)]
    belief = mapped(seen)
    order = rng.permutation(len(seen))
    choice = belief.associate(tuple(seen[i] for i in order), association)
    assert pairs(choice) == {a: int(i) for a, i in enumerate(order)}
    assert choice.new == ()


def test_matches_carry_the_filters_own_scores(association):
    seen = (point(ORIGIN, (1.02, 1.0), 0),)
    belief = mapped([point(ORIGIN, (1, 1), 0)])
    (match,) = belief.associate(seen, association).matches
    innovation, S = belief.joint(seen, [match])
    np.testing.assert_allclose(match.innovation, innovation, atol=1e-12)
    np.testing.assert_allclose(match.S, S, rtol=1e-9)
    assert match.distance2 == pytest.approx(innovation @ np.linalg.solve(S, innovation))
