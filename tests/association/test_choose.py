"""What an association of a plug-in returns is checked before a filter uses it."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS, R_POINT

from impslam.association.base import Assignment, Association
from impslam.errors import ConfigError
from impslam.filters.riekf import RightInvariantEkf
from impslam.types import Match, Observation

SEEN = tuple(Observation("corner", np.array([x, 0.0]), R_POINT) for x in (1.0, 3.0))


class Fixed(Association):
    """Returns what it is given."""

    returned: object = None

    def assign(self, observations, hypotheses, joint):
        return self.returned


def match(observation, landmark):
    return Match(observation, landmark, np.zeros(2), np.eye(2), 0.0)


def associated(returned):
    """Return what a filter with both corners as landmarks gets of an association."""
    one = RightInvariantEkf()
    one.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    one.extend(list(SEEN), 0.0)
    return one.associate(SEEN, Fixed(returned=returned))


def test_pairs_of_the_hypotheses_are_used_as_they_are():
    given = Assignment((match(0, 0),), (1,))
    assert associated(given) is given


@pytest.mark.parametrize(
    ("returned", "wrong"),
    [
        (None, "NoneType in place of an Assignment"),
        (Assignment((None,), ()), "NoneType in place of a Match"),
        (Assignment((match(0, 9),), ()), "a match of observation 0 with landmark 9, which is not"),
        (Assignment((), (2,)), "the index 2 of 2 observations"),
        (Assignment((), (), ambiguous=(-1,)), "the index -1 of 2 observations"),
    ],
)
def test_others_are_refused_with_the_name_of_the_association(returned, wrong):
    with pytest.raises(ConfigError, match=f"association .* returned {wrong}"):
        associated(returned)
