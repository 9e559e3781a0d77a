"""Frames in space, as in TF, and the pose of a laser in the plane of the robot (REP 103, REP 105).

A link is the pose of a child in its parent, `T_parent_child` (4, 4) in SE(3). Each frame has at most one
parent, so the chain between two frames is unique: up to their nearest common ancestor, and down again.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from impslam.errors import MessageError
from impslam.types import Array

UNIT_TOLERANCE = 0.01
"""Maximum difference of the square of a quaternion's norm from 1, as in tf2."""


DIGITS = 9
"""Decimal places of a pose in m and rad; beyond them there are only rounding errors."""


class FrameTransform(NamedTuple):
    """The pose of a frame in its parent: `T` (4, 4), m."""

    parent: str
    child: str
    T: Array

    @property
    def pair(self) -> frozenset[str]:
        """The two frames, whichever is the parent."""
        return frozenset((self.parent, self.child))

    def below(self, parent: str) -> FrameTransform:
        """Return this link with one of its frames as the parent."""
        if parent == self.parent:
            return self
        return FrameTransform(
            self.child, self.parent, np.asarray(np.linalg.inv(self.T), np.float64)
        )


class Planar(NamedTuple):
    """The pose of a laser in the plane of base.

    Attributes
    ----------
    pose : (x, y, yaw) m, m, rad; yaw is the direction of the laser's x axis
    upside_down : whether its z axis points down
    tilt : angle between its plane and that of base, rad
    """

    pose: tuple[float, float, float]
    upside_down: bool
    tilt: float


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Return the yaw of a quaternion, which need not have unit length.

    Raises
    ------
    MessageError
        If its length is zero.
    """
    if math.hypot(x, y, z, w) < 1e-3:
        raise MessageError("the orientation is a zero quaternion")
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def rigid(translation: Array, quaternion: Array) -> Array:
    """Return the transform (4, 4) of a translation (3,) in m and a quaternion [x, y, z, w].

    Raises
    ------
    MessageError
        If a number is not finite, or the quaternion does not have unit length.
    """
    if not (np.isfinite(translation).all() and np.isfinite(quaternion).all()):
        raise MessageError("it contains a number that is not finite")
    length = math.hypot(*quaternion)
    if abs(length * length - 1.0) > UNIT_TOLERANCE:
        raise MessageError(f"its quaternion has the length {length:.3g} instead of 1")
    x, y, z, w = quaternion / length
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = translation
    return T


def flattened(T_base_laser: Array) -> Planar:
    """Return the pose in the plane of base of a laser, given its transform (4, 4) in space."""
    R, (x, y, _) = T_base_laser[:3, :3], T_base_laser[:3, 3].tolist()
    yaw = math.atan2(R[1, 0], R[0, 0])
    tilt = math.atan2(math.hypot(R[0, 2], R[1, 2]), abs(R[2, 2]))
    x, y, yaw = (round(value, DIGITS) + 0.0 for value in (x, y, yaw))
    return Planar((x, y, yaw), bool(R[2, 2] < 0.0), tilt)


class FrameTree:
    """Frames with links to their parents; if a frame has several parents, the first counts.

    Parameters
    ----------
    sensors : frames of sensors. They are fixed to the robot and carry no part of it, so a link from one of
        them to a frame that has another parent is published in reverse; it is inverted.
    """

    def __init__(self, sensors: Collection[str] = ()) -> None:
        self._links: dict[str, FrameTransform] = {}
        self._sensors = frozenset(sensors)

    def __contains__(self, frame: str) -> bool:
        """Return whether a frame has a parent or a child."""
        return frame in self._links or any(link.parent == frame for link in self._links.values())

    def get(self, child: str) -> FrameTransform | None:
        """Return the link of a frame to its parent."""
        return self._links.get(child)

    def lacks(self, parent: str, child: str) -> bool:
        """Return whether a link would give a parent to one of its frames, in reverse to a sensor."""
        return child not in self._links or (parent in self._sensors and parent not in self._links)

    def add(self, link: FrameTransform) -> bool:
        """Set the link of a frame, unless it has another parent; return whether it was set."""
        known = self._links.get(link.child)
        if known is None or known.parent == link.parent:
            self._links[link.child] = link
            return True
        if self._may_be_reversed(link):
            return self.add(link.below(link.child))
        if self._may_be_reversed(known):
            self._links[link.child] = link
            return self.add(known.below(known.child))
        return False

    def _may_be_reversed(self, link: FrameTransform) -> bool:
        return link.parent in self._sensors and link.child not in self._sensors

    def copy(self) -> FrameTree:
        """Return a copy that can be changed independently."""
        tree = FrameTree(self._sensors)
        tree._links = dict(self._links)
        return tree

    def up(self, frame: str, top: str = "") -> list[FrameTransform]:
        """Return the links from a frame up to the frame `top`, or else to the root.

        Raises
        ------
        MessageError
            If they form a loop.
        """
        links: list[FrameTransform] = []
        while frame != top and (link := self._links.get(frame)) is not None:
            if any(link is passed for passed in links):
                ring = " -> ".join(passed.child for passed in links)
                raise MessageError(f"the transforms form a loop: {ring} -> {frame}")
            links.append(link)
            frame = link.parent
        return links

    def chain(self, base: str, frame: str) -> tuple[Array, list[FrameTransform]]:
        """Return `T_base_frame` (4, 4) and the links that it consists of.

        Raises
        ------
        MessageError
            If the frames are not connected, or the links form a loop.
        """
        downs = self.up(frame, base)
        below = [frame, *(link.parent for link in downs)]
        ups = [] if below[-1] == base else self.up(base)
        above = [base, *(link.parent for link in ups)]
        ancestor = next((name for name in below if name in above), None)
        if ancestor is None:
            ends = f"{frame} leads up to {below[-1]}, {base} to {above[-1]}"
            raise MessageError(f"no transforms lead from {base} to {frame} ({ends})")
        ups, downs = ups[: above.index(ancestor)], downs[: below.index(ancestor)]
        return np.linalg.inv(_product(ups)) @ _product(downs), ups + downs


def _product(links: list[FrameTransform]) -> Array:
    """Return `T_top_bottom` of links from the bottom to the top."""
    T = np.eye(4)
    for link in links:
        T = link.T @ T
    return T
