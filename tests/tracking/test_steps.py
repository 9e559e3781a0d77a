"""What a tracker of a plug-in returns is checked: kernels would read beyond arrays that are too small."""

import numpy as np
import pytest

from impslam.errors import ConfigError
from impslam.tracking.steps import Steps, checked

M = 4


def steps(**other):
    """Return results for M sweeps, some of them replaced."""
    yes, zeros = np.ones(M, np.bool_), np.zeros((M, 3, 3))
    found = Steps(
        np.zeros((M, 3)), zeros, zeros, np.zeros((M, 3)), yes, yes, yes, np.zeros(M, np.int8),
        np.zeros(M), np.zeros((M, 2)),
    )  # fmt: skip
    return found._replace(**other)


def test_columns_of_the_right_shapes_are_used_as_they_are():
    given = steps()
    assert checked(given, M, "mine") is given


@pytest.mark.parametrize(
    ("returned", "wrong"),
    [
        (None, "NoneType in place of Steps"),
        (steps(d_pose=np.zeros((M, 2))), r"d_pose of shape \(4, 2\) instead of \(4, 3\)"),
        (steps(reach=np.zeros((M - 1, 2))), r"reach of shape \(3, 2\) instead of \(4, 2\)"),
        (steps(is_keyframe=np.zeros(M)), "is_keyframe that are no array of the right type"),
        (steps(amounts=[0.0] * M), "amounts that are no array of the right type"),
    ],
)
def test_others_are_refused_with_the_name_of_the_tracker(returned, wrong):
    with pytest.raises(ConfigError, match=f"tracker 'mine' returned {wrong}; correct it"):
        checked(returned, M, "mine")
