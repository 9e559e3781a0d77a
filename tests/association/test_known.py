"""Association by label, however far off the observation is."""

import numpy as np
from tests.association.scenes import mapped, pairs, point

from impslam.association.known import Known

ORIGIN = np.zeros(3)


def test_labels_decide_at_any_distance():
    belief = mapped([point(ORIGIN, (1, 0), 7), point(ORIGIN, (2, 0), 8)])
    seen = (point(ORIGIN, (1, 0), 8), point(ORIGIN, (50, 50), 7))
    assert pairs(belief.associate(seen, Known())) == {0: 1, 1: 0}


def test_an_unknown_label_is_new_and_no_label_is_neither():
    belief = mapped([point(ORIGIN, (1, 0), 7)])
    choice = belief.associate((point(ORIGIN, (1, 0), 9), point(ORIGIN, (1, 0))), Known())
    assert choice.matches == ()
    assert choice.new == (0,)


def test_landmarks_without_label_are_never_matched():
    belief = mapped([point(ORIGIN, (1, 0))])
    assert belief.associate((point(ORIGIN, (1, 0), 0),), Known()).matches == ()


def test_a_label_read_twice_is_the_nearer_one_and_the_other_is_not_new():
    belief = mapped([point(ORIGIN, (1, 0), 7)])
    seen = (point(ORIGIN, (1.2, 0), 7), point(ORIGIN, (1.1, 0), 7))
    choice = belief.associate(seen, Known())
    assert pairs(choice) == {1: 0}
    assert choice.new == ()


def test_of_two_landmarks_of_a_label_that_was_read_twice_the_nearer_one_is_seen_again():
    for places in (((1, 0), (3, 2)), ((3, 2), (1, 0))):
        belief = mapped([point(ORIGIN, place, 7) for place in places])
        choice = belief.associate((point(ORIGIN, (1, 0), 7),), Known())
        assert pairs(choice) == {0: places.index((1, 0))}


def test_a_gate_rejects_a_misread_label_that_is_not_new():
    belief = mapped([point(ORIGIN, (1, 0), 7), point(ORIGIN, (2, 0), 8)])
    seen = (point(ORIGIN, (1, 0), 7), point(ORIGIN, (50, 50), 8), point(ORIGIN, (3, 3), 9))
    choice = belief.associate(seen, Known(gate=0.999999))
    assert pairs(choice) == {0: 0}
    assert choice.new == (2,)


def test_no_label_is_new_while_the_map_has_none_of_the_kind():
    choice = mapped([]).associate((point(ORIGIN, (1, 0)),), Known())
    assert choice.new == (0,)
