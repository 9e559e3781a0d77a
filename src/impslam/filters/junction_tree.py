"""A junction tree of square areas: the joint Gaussian of a large map, kept as those of many small parts.

The leaves are areas, and what is seen from an area depends on the variables of its clique alone. A node
above joins two, and holds what either has in common with other areas (Paskin 2003; nothing is thinned out
here). A variable that is in two cliques is in all on the way between them. So the rest of the map depends
on what is learned in one area only through the variables on the way, and is told of it when needed.
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
    """Return the node above."""
    level, i, j = node
    return (level + 1, i, j >> 1) if level % 2 else (level + 1, i >> 1, j)


def children(node: Node) -> list[Node]:
    """Return the two nodes below."""
    level, i, j = node
    if level % 2:
        return [(level - 1, 2 * i, j), (level - 1, 2 * i + 1, j)]
    return [(level - 1, i, 2 * j), (level - 1, i, 2 * j + 1)]


def way(begin: Node, end: Node) -> list[Node]:
    """Return the nodes from one to another, both included."""
    up, down = [begin], [end]
    while up[-1] != down[-1]:
        if up[-1][0] <= down[-1][0]:
            up.append(parent(up[-1]))
        if up[-1][0] > down[-1][0]:
            down.append(parent(down[-1]))
    return up + down[-2::-1]


class JunctionTree:
    """Cliques by node. Each tells truly how its variables depend on those common with a neighbour."""

    def __init__(self) -> None:
        self.cliques: dict[Node, Clique] = {}

    def __getitem__(self, node: Node) -> Clique:
        return self.cliques.get(node) or Clique.empty()

    def neighbours(self, node: Node) -> list[Node]:
        """Return the nodes next to one."""
        return [other for other in (parent(node), *children(node)) if other in self.cliques]

    def walk(self, begin: Node, end: Node, carried: Ints) -> list[Node]:
        """Tell the nodes on the way to another area what the first knows; return the way.

        Scalars that are `carried` (k,) become part of all of them.
        """
        nodes = way(begin, end)
        for newer, node in pairwise(nodes):
            self.cliques[node] = self[node].absorbed(self.cliques[newer], carried)
        return nodes

    def fetch(self, node: Node, wanted: Mapping[Node, Ints]) -> None:
        """Make scalars (k,) of other areas part of this one, and of all nodes on the way, each once."""
        own = self[node].codes
        by_neighbour: dict[Node, dict[Node, Ints]] = {}
        for area, codes in wanted.items():
            missing = codes[~np.isin(codes, own)]
            if len(missing):
                by_neighbour.setdefault(way(node, area)[1], {})[area] = missing
        for neighbour, some in by_neighbour.items():
            self.fetch(neighbour, some)
            codes = np.concatenate(list(some.values()))
            self.cliques[node] = self.cliques[node].extended(self.cliques[neighbour], codes)

    def spread(self, nodes: list[Node], tolerance: float) -> Iterator[Node]:
        """Tell all neighbours what these nodes know, where a mean moves by more; yield those told."""
        told = list(nodes)
        known = set(nodes)
        for newer in told:
            for node in self.neighbours(newer):
                if node in known:
                    continue
                one, other = self.cliques[newer], self.cliques[node]
                common = np.intersect1d(one.codes, other.codes, assume_unique=True)
                shift = one.mean[one.places(common)] - other.mean[other.places(common)]
                if len(shift) and np.abs(shift).max() > tolerance:
                    self.cliques[node] = other.absorbed(one, common[:0])
                    known.add(node)
                    told.append(node)
                    yield node

    def complete(self, node: Node, clique: Clique) -> Iterator[tuple[Node, Clique]]:
        """Yield all nodes with all that is known of them; nothing is changed.

        `clique` is what is known at one of them.
        """
        told = [(node, node, clique)]
        none = clique.codes[:0]
        while told:
            before, here, newer = told.pop()
            yield here, newer
            next_to = [other for other in self.neighbours(here) if other != before]
            told += [(here, n, self.cliques[n].absorbed(newer, none)) for n in next_to]
