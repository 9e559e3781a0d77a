"""The values of static transforms in a log.

A static transform holds for the whole log. Two values of one are a contradiction, not motion: two programs
publish it, or one was restarted with another value.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from impslam.geometry.angles import wrap
from impslam.sources.mount_watch import MAX_SHIFT, MAX_TURN, difference
from impslam.sources.transforms import FrameTransform, FrameTree, Planar, flattened


class StaticLinks:
    """The different values of each static link."""

    def __init__(self) -> None:
        self._values: dict[frozenset[str], list[FrameTransform]] = {}

    def add(self, link: FrameTransform) -> None:
        """Add a value of a link, unless it is known."""
        values = self._values.setdefault(link.pair, [])
        if all(difference(known.T, link.below(known.parent).T) for known in values):
            values.append(link)

    def rivals(
        self, tree: FrameTree, base: str, frame: str
    ) -> Iterator[tuple[FrameTransform, Planar]]:
        """Yield values of links other than those of the tree, and the pose of a laser by them."""
        with np.errstate(all="ignore"):  # a damaged log may have links of 1e300 m
            T, links = tree.chain(base, frame)
            used = flattened(T)
            for link in self._others(links):
                other = tree.copy()
                other.add(link)
                rival = flattened(other.chain(base, frame)[0])
                if _differ(rival, used):
                    yield link, rival

    def _others(self, links: Iterable[FrameTransform]) -> Iterator[FrameTransform]:
        for link in links:
            for value in self._values.get(link.pair, ()):
                if difference(link.T, value.below(link.parent).T):
                    yield value


def _differ(a: Planar, b: Planar) -> bool:
    """Return whether two mounts differ by more than hardly matters; their height does not matter at all."""
    (ax, ay, a_yaw), (bx, by, b_yaw) = a.pose, b.pose
    is_apart = math.hypot(ax - bx, ay - by) > MAX_SHIFT or abs(wrap(a_yaw - b_yaw)) > MAX_TURN
    return is_apart or a.upside_down != b.upside_down
