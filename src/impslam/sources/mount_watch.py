"""Notices when the mount of a laser is no longer the one that its scans are used with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress

import numpy as np

from impslam.errors import MessageError
from impslam.sources.transforms import FrameTree, Link
from impslam.types import Array

SAME_PLACE, SAME_DIRECTION = 1e-3, math.radians(0.1)
"""m, rad: what publishers of one transform differ by; a 2D lidar cannot tell less."""


class MountWatch:
    """The mounts of lasers as transforms arrive, beside those at the first scan.

    Parameters
    ----------
    tree : the frames at the first scan
    lasers : base and the frame of the laser, by the stream of its scans

    Attributes
    ----------
    frames : the frames whose links the mounts are made of
    """

    def __init__(self, tree: FrameTree, lasers: Mapping[str, tuple[str, str]]) -> None:
        self._tree, self._lasers = tree.copy(), lasers
        ways = {stream: tree.way(*frames) for stream, frames in lasers.items()}
        self._first = {stream: T for stream, (T, _) in ways.items()}
        self.frames = {link.child for _, links in ways.values() for link in links}
        self._moved: dict[str, str] = {}

    def update(self, links: Iterable[Link]) -> None:
        """Enter links that have arrived."""
        own = [link for link in links if link.child in self.frames]
        for link in own:
            self._tree.add(link)
        if not own:
            return
        for stream, frames in self._lasers.items():
            with suppress(MessageError):
                T, _ = self._tree.way(*frames)
                self._moved[stream] = _difference(self._first[stream], T)

    def may_be_in(self, data: bytes) -> bool:
        """Tell whether a serialised message names one of the frames."""
        return any(frame.encode() in data for frame in self.frames)

    def moved(self, stream: str) -> str:
        """Return by how much the mount of a stream's laser differs from the first one, or nothing."""
        return self._moved.get(stream, "")


def _difference(first: Array, now: Array) -> str:
    with np.errstate(all="ignore"):  # a damaged log may move it by 1e300 m
        D = np.linalg.inv(first) @ now
        way = float(np.linalg.norm(D[:3, 3]))
    sine = 0.5 * float(np.linalg.norm((D - D.T)[[2, 0, 1], [1, 2, 0]]))
    turn = math.atan2(sine, 0.5 * (float(np.trace(D)) - 2.0))
    if way <= SAME_PLACE and turn <= SAME_DIRECTION:
        return ""
    return f"{way:.3f} m and {math.degrees(turn):.1f} degrees"
