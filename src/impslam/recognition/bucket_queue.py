"""A priority queue of keys by integer bound, with a bucket for each bound."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.recognition.pyramid import Ints32
from impslam.types import Ints


class BucketQueue(NamedTuple):
    """A linked list of keys for each bound; `first` (b,) and `after` (n,) are -1 at its end.

    `state` (2,) is the number of pushed keys, and the greatest bound.
    """

    first: Ints32
    after: Ints32
    keys: Ints
    state: Ints


@kernel
def empty_queue(max_bound: int, capacity: int) -> BucketQueue:
    """Return a queue for bounds up to `max_bound`, to which `capacity` keys can be pushed."""
    return BucketQueue(
        np.full(max_bound + 1, -1, np.int32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int64),
        np.zeros(2, np.int64),
    )


@kernel
def push(queue: BucketQueue, bound: int, key: int) -> None:
    """Add a key; ignore it if the queue is full."""
    k = queue.state[0]
    if k < len(queue.keys):
        queue.keys[k], queue.after[k] = key, queue.first[bound]
        queue.first[bound] = k
        queue.state[0] += 1
        queue.state[1] = max(queue.state[1], bound)


@kernel
def pop(queue: BucketQueue) -> tuple[int, int]:
    """Remove and return the greatest bound and its newest key; bound 0 if the queue is empty."""
    best = queue.state[1]
    while best > 0 and queue.first[best] < 0:
        best -= 1
    queue.state[1] = best
    if best == 0:
        return 0, 0
    k = queue.first[best]
    queue.first[best] = queue.after[k]
    return best, queue.keys[k]
