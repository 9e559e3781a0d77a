"""Ambiguous observations are not used, and certain ones resolve the ambiguity of others."""

import math

import numpy as np
import pytest
from tests.association.scenes import mapped, pairs, point, wall

from impslam.component import components

ORIGIN = np.zeros(3)
ALONE = {"mahalanobis": {"density": 1e-6}, "jcbb": {}}
"""Hardly any other objects of the kind, so that landmarks only compete with each other."""


@pytest.fixture(params=sorted(ALONE))
def make(request):
    """Return a function that makes the association with further parameters."""
    cls = components("association")[request.param]
    return lambda **more: cls(**ALONE[request.param], **more)


def between(share):
    """Return a belief of two landmarks, an observation at a share of the path between, and the odds."""
    belief = mapped([point(ORIGIN, (2, 0)), point(ORIGIN, (2, 0.6))], sigma=(0.2, 0.2, 1e-6))
    seen = (point(ORIGIN, (2, 0.6 * share)),)
    (group,) = belief.hypothesise(seen)
    densities = -0.5 * (group.distance2 + group.log_det)
    return belief, seen, math.exp(densities[0] - densities[1])


@pytest.mark.parametrize("share", [0.5, 0.4, 0.3, 0.2, 0.0])
def test_the_odds_decide_between_two_landmarks(make, share):
    belief, seen, odds = between(share)
    refused = belief.associate(seen, make(odds=1.01 * odds))
    assert (refused.matches, refused.new) == ((), ())
    if odds > 1.01:
        assert pairs(belief.associate(seen, make(odds=0.99 * odds))) == {0: 0}
    expected = {0: 0} if odds > 10.0 else {}
    assert pairs(belief.associate(seen, make())) == expected


def test_another_observation_resolves_the_ambiguity(make):
    """The one between could be either; but one of them is seen elsewhere."""
    belief, seen, _ = between(0.5)
    both = (*seen, point(ORIGIN, (2, 0.9)))
    assert pairs(belief.associate(both, make())) == {0: 0, 1: 1}


def test_an_observation_near_a_landmark_observed_elsewhere_is_new(make):
    """As two barcodes side by side: the known one is observed, so the other is a new one."""
    belief = mapped([point(ORIGIN, (2, 0))], sigma=(0.02, 0.02, 1e-6))
    beside = point(ORIGIN, (2, 0.1))  # outside the gate, inside that of what is new
    alone = belief.associate((beside,), make())
    assert (alone.matches, alone.new) == ((), ())
    both = belief.associate((point(ORIGIN, (2, 0)), beside), make())
    assert (pairs(both), both.new) == ({0: 0}, (1,))


def test_pieces_of_a_wall_match_one_wall(make):
    """Either could be the wall, which is not ambiguous, and neither is new."""
    belief = mapped([wall(ORIGIN, [[2, -2], [2, 2]])])
    pieces = (wall(ORIGIN, [[2, -2], [2, -1]]), wall(ORIGIN, [[2, 1], [2, 2]]))
    choice = belief.associate(pieces, make())
    assert len(choice.matches) == 1
    assert choice.new == ()
