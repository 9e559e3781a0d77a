"""A junction tree of square areas: the joint Gaussian of a large map as those of many small parts.

The leaves are areas, and observations from an area depend only on the variables of its clique. An inner
node joins two nodes, and has the variables that either has in common with other areas (Paskin 2003; nothing
is thinned out here). A variable that is in two cliques is in all on the path between them. So updates of
one area affect the rest of the map only through the variables on the path, and are propagated when needed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import TypeAlias

import numpy as np

from impslam.filters.clique import Clique
from impslam.types import Ints

Node: TypeAlias = tuple[int, int, int]
"""Level, and column and row at that level; areas are of level 0."""


def parent(node: Node) -> Node:
    """Return the parent of a node."""
    level, i, j = node
    return (level + 1, i, j >> 1) if level % 2 else (level + 1, i >> 1, j)


def children(node: Node) -> list[Node]:
    """Return the two children of a node."""
    level, i, j = node
    if level % 2:
        return [(level - 1, 2 * i, j), (level - 1, 2 * i + 1, j)]
    return [(level - 1, i, 2 * j), (level - 1, i, 2 * j + 1)]


def path(begin: Node, end: Node) -> list[Node]:
    """Return the nodes from `begin` to `end`, both included."""
    up, down = [begin], [end]
    while up[-1] != down[-1]:
        if up[-1][0] <= down[-1][0]:
            up.append(parent(up[-1]))
        if up[-1][0] > down[-1][0]:
            down.append(parent(down[-1]))
    return up + down[-2::-1]


class JunctionTree:
    """Cliques by node; each has the valid conditional given its variables common with a neighbour."""

    def __init__(self) -> None:
        self.cliques: dict[Node, Clique] = {}

    def __getitem__(self, node: Node) -> Clique:
        return self.cliques.get(node) or Clique.empty()

    def neighbours(self, node: Node) -> list[Node]:
        """Return the existing neighbours of a node."""
        return [other for other in (parent(node), *children(node)) if other in self.cliques]

    def propagate_along(self, begin: Node, end: Node, carried: Ints) -> list[Node]:
        """Propagate updates along the path to another area; return the path.

        The scalars `carried` (k,) are added to all its nodes.
        """
        nodes = path(begin, end)
        for newer, node in pairwise(nodes):
            self.cliques[node] = self[node].absorbed(self.cliques[newer], carried)
        return nodes

    def fetch(self, node: Node, wanted: Mapping[Node, Ints]) -> None:
        """Add scalars (k,) of other areas to this one and to all nodes on the paths."""
        own = self[node].codes
        by_neighbour: dict[Node, dict[Node, Ints]] = {}
        for area, codes in wanted.items():
            missing = codes[~np.isin(codes, own)]
            if len(missing):
                by_neighbour.setdefault(path(node, area)[1], {})[area] = missing
        for neighbour, some in by_neighbour.items():
            self.fetch(neighbour, some)
            codes = np.concatenate(list(some.values()))
            self.cliques[node] = self.cliques[node].extended(self.cliques[neighbour], codes)

    def propagate(self, nodes: list[Node], tolerance: float) -> Iterator[Node]:
        """Propagate updates from nodes while means change by more than `tolerance`; yield updated nodes."""
        queue = list(nodes)
        known = set(nodes)
        for newer in queue:
            for node in self.neighbours(newer):
                if node in known:
                    continue
                one, other = self.cliques[newer], self.cliques[node]
                common = np.intersect1d(one.codes, other.codes, assume_unique=True)
                shift = one.mean[one.places(common)] - other.mean[other.places(common)]
                if len(shift) and np.abs(shift).max() > tolerance:
                    self.cliques[node] = other.absorbed(one, common[:0])
                    known.add(node)
                    queue.append(node)
                    yield node

    def complete(self, node: Node, clique: Clique) -> Iterator[tuple[Node, Clique]]:
        """Yield all nodes with fully updated cliques; the tree does not change.

        `clique` is the current one of `node`.
        """
        stack = [(node, node, clique)]
        none = clique.codes[:0]
        while stack:
            before, current, newer = stack.pop()
            yield current, newer
            others = [other for other in self.neighbours(current) if other != before]
            stack += [(current, n, self.cliques[n].absorbed(newer, none)) for n in others]
