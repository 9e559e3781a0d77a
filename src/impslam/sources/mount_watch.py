"""Detects when the mount of a laser differs from the one that its scans are used with."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from contextlib import suppress

import numpy as np

from impslam.errors import MessageError
from impslam.sources.transforms import FrameTransform, FrameTree
from impslam.types import Array

MAX_SHIFT, MAX_TURN = 1e-3, math.radians(0.1)
"""Differences between publishers of one transform, m and rad, too small to matter for a 2D lidar."""


class MountWatch:
    """Compares the mounts of lasers, as transforms arrive, with those at the first scan.

    Parameters
    ----------
    tree : the frames at the first scan
    lasers : base frame and laser frame, by the stream of the scans

    Attributes
    ----------
    pairs : frames of each link that the mounts consist of
    """

    def __init__(self, tree: FrameTree, lasers: Mapping[str, tuple[str, str]]) -> None:
        self._tree, self._lasers = tree.copy(), lasers
        chains = {stream: tree.chain(*frames) for stream, frames in lasers.items()}
        self._first = {stream: T for stream, (T, _) in chains.items()}
        self.pairs = {link.pair for _, links in chains.values() for link in links}
        self._moved: dict[str, str] = {}

    def update(self, links: Iterable[FrameTransform]) -> None:
        """Add new links."""
        own = [link for link in links if link.pair in self.pairs]
        for link in own:
            self._tree.add(link)
        if not own:
            return
        for stream, frames in self._lasers.items():
            with suppress(MessageError):
                T, _ = self._tree.chain(*frames)
                self._moved[stream] = difference(self._first[stream], T)

    def may_be_in(self, data: bytes) -> bool:
        """Return whether a serialised message contains the frames of a link, without namespace."""
        names = ([frame.rsplit("/", 1)[-1].encode() for frame in pair] for pair in self.pairs)
        return any(all(name in data for name in pair) for pair in names)

    def moved(self, stream: str) -> str:
        """Return the difference of the mount of a stream's laser from the first one, or ""."""
        return self._moved.get(stream, "")


def difference(first: Array, now: Array) -> str:
    """Describe the difference of two transforms (4, 4); "" if it is too small to matter."""
    with np.errstate(all="ignore"):  # a damaged log may move it by 1e300 m
        D = np.linalg.inv(first) @ now
        shift = float(np.linalg.norm(D[:3, 3]))
    sine = 0.5 * float(np.linalg.norm((D - D.T)[[2, 0, 1], [1, 2, 0]]))
    turn = math.atan2(sine, 0.5 * (float(np.trace(D)) - 2.0))
    if shift <= MAX_SHIFT and turn <= MAX_TURN:
        return ""
    return f"{shift:.3f} m and {math.degrees(turn):.1f} degrees"
