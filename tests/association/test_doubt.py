"""What a scan cannot tell is not used, and what it can tell of one observation helps with the others."""

import math

import numpy as np
import pytest
from tests.association.scenes import mapped, pairs, point, wall

from impslam.component import components

ORIGIN = np.zeros(3)
ALONE = {"mahalanobis": {"density": 1e-6}, "jcbb": {}}
"""Next to nothing else of the kind, so that landmarks are weighed against each other."""


@pytest.fixture(params=sorted(ALONE))
def make(request):
    """Return a function that makes the association with further parameters."""
    cls = components("association")[request.param]
    return lambda **more: cls(**ALONE[request.param], **more)


def between(share):
    """Return a belief of two landmarks, and one seen so far on the way between them; and the odds."""
    belief = mapped([point(ORIGIN, (2, 0)), point(ORIGIN, (2, 0.6))], sigma=(0.2, 0.2, 1e-6))
    seen = (point(ORIGIN, (2, 0.6 * share)),)
    (group,) = belief.hypothesise(seen)
    densities = -0.5 * (group.distance2 + group.log_det)
    return belief, seen, math.exp(densities[0] - densities[1])


@pytest.mark.parametrize("share", [0.5, 0.4, 0.3, 0.2, 0.0])
def test_between_two_landmarks_the_odds_decide(make, share):
    belief, seen, odds = between(share)
    refused = belief.associate(seen, make(odds=1.01 * odds))
    assert (refused.matches, refused.new) == ((), ())
    if odds > 1.01:
        assert pairs(belief.associate(seen, make(odds=0.99 * odds))) == {0: 0}
    expected = {0: 0} if odds > 10.0 else {}
    assert pairs(belief.associate(seen, make())) == expected


def test_another_observation_settles_which_is_which(make):
    """The one between could be either; but one of them is seen elsewhere."""
    belief, seen, _ = between(0.5)
    both = (*seen, point(ORIGIN, (2, 0.9)))
    assert pairs(belief.associate(both, make())) == {0: 0, 1: 1}


def test_what_is_near_a_landmark_that_is_seen_elsewhere_is_new(make):
    """As two barcodes side by side: the known one is seen, so that the other is not it."""
    belief = mapped([point(ORIGIN, (2, 0))], sigma=(0.02, 0.02, 1e-6))
    beside = point(ORIGIN, (2, 0.1))  # outside the gate, inside that of what is new
    alone = belief.associate((beside,), make())
    assert (alone.matches, alone.new) == ((), ())
    both = belief.associate((point(ORIGIN, (2, 0)), beside), make())
    assert (pairs(both), both.new) == ({0: 0}, (1,))


def test_pieces_of_a_wall_are_one_wall(make):
    """Either could be taken for it, which is no doubt about what was seen, and neither is new."""
    belief = mapped([wall(ORIGIN, [[2, -2], [2, 2]])])
    pieces = (wall(ORIGIN, [[2, -2], [2, -1]]), wall(ORIGIN, [[2, 1], [2, 2]]))
    choice = belief.associate(pieces, make())
    assert len(choice.matches) == 1
    assert choice.new == ()
