"""A queue from which the key of the greatest bound comes first, with a bucket for each bound."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.recognition.pyramid import Ints32
from impslam.types import Ints


class BucketQueue(NamedTuple):
    """Keys by their bound: a linked list for each; `first` (b,) and `after` (n,) are -1 at its end.

    `state` (2,) is the number of keys that were pushed, and the greatest bound.
    """

    first: Ints32
    after: Ints32
    keys: Ints
    state: Ints


@kernel
def empty_queue(most: int, room: int) -> BucketQueue:
    """Return a queue for bounds up to `most`, into which so many keys may be pushed."""
    return BucketQueue(
        np.full(most + 1, -1, np.int32),
        np.empty(room, np.int32),
        np.empty(room, np.int64),
        np.zeros(2, np.int64),
    )


@kernel
def push(queue: BucketQueue, bound: int, key: int) -> None:
    """Enter a key, unless there is no room for it."""
    k = queue.state[0]
    if k < len(queue.keys):
        queue.keys[k], queue.after[k] = key, queue.first[bound]
        queue.first[bound] = k
        queue.state[0] += 1
        queue.state[1] = max(queue.state[1], bound)


@kernel
def pop(queue: BucketQueue) -> tuple[int, int]:
    """Return the greatest bound and its newest key, and remove it; bound 0 if there is none."""
    best = queue.state[1]
    while best > 0 and queue.first[best] < 0:
        best -= 1
    queue.state[1] = best
    if best == 0:
        return 0, 0
    k = queue.first[best]
    queue.first[best] = queue.after[k]
    return best, queue.keys[k]
