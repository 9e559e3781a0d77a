"""What trackers return for the sweeps of a batch."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from impslam.errors import ConfigError
from impslam.health import Reasons
from impslam.types import Array, Mask


class Steps(NamedTuple):
    """Results for m sweeps.

    Attributes
    ----------
    d_pose, covariance : (m, 3), (m, 3, 3) motion since the newest reference before each; the covariances
        of successive motions add up
    error : (m, 3, 3) covariance of the match itself, which replaces that of the reference before and does
        not add up, in the axes of that reference; of references only
    moved : (m, 3) motion since the sweep before each
    reference : (m,) whether the next motions start from this sweep: it was matched, or has too few
        points to match
    is_keyframe : (m,) whether it is a keyframe
    located : (m,) whether the scan determines the position along both axes
    reasons, amounts : (m,) why its pose cannot be trusted, and the distance or share that goes with it;
        see `impslam.health`
    reach : (m, 2) m, rad around the matched pose in which the robot may be; see `Keyframe`
    """

    d_pose: Array
    covariance: Array
    error: Array
    moved: Array
    reference: Mask
    is_keyframe: Mask
    located: Mask
    reasons: Reasons
    amounts: Array
    reach: Array


_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {
    "d_pose": ("f", (3,)), "covariance": ("f", (3, 3)), "error": ("f", (3, 3)), "moved": ("f", (3,)),
    "reference": ("b", ()), "is_keyframe": ("b", ()), "located": ("b", ()),
    "reasons": ("iu", ()), "amounts": ("f", ()), "reach": ("f", (2,)),
}  # fmt: skip
"""Kinds of `dtype`, and shape of a row, of each column of `Steps`."""


def checked(returned: Any, m: int, name: str) -> Steps:
    """Return what a tracker returned for m sweeps, checked, because it may be a plug-in.

    Raises
    ------
    ConfigError
        If these are no columns of m rows: kernels would read beyond their ends.
    """
    if wrong := _defect(returned, m):
        raise ConfigError(
            f"tracker {name!r} returned {wrong}; correct it, the contract is Steps in "
            "impslam.tracking.steps"
        )
    steps: Steps = returned
    return steps


def _defect(returned: Any, m: int) -> str:
    """Return what is wrong with the results for m sweeps, or ""."""
    if not isinstance(returned, Steps):
        return f"{type(returned).__name__} in place of Steps"
    for column, (kinds, row) in _COLUMNS.items():
        array: Any = getattr(returned, column)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
            return f"{column} that are no array of the right type"
        if array.shape != (m, *row):
            return f"{column} of shape {array.shape} instead of {(m, *row)}"
    return ""
