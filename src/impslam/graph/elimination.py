"""Elimination order of poses, and the block pattern of the factor.

Approximate minimum degree on the quotient graph (Amestoy, Davis and Duff 1996, Algorithm 1, without
supervariables: each unknown is three numbers already). The element of an eliminated pose is the pattern of
its column of the factor, so the symbolic factorisation needs no extra work.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Ints, Mask


class Pattern(NamedTuple):
    """The non-zero blocks below the diagonal of a factor; rows and columns are steps.

    Attributes
    ----------
    step : (k,) at which each pose is eliminated
    starts, rows : (k + 1,) and (m,) blocks of column s below the diagonal are starts[s] to
        starts[s + 1], their rows ascending
    row_starts, columns, blocks : (k + 1,), (m,), (m,) the same by rows: block `blocks[t]`, of column
        `columns[t]`, is in row r for t from row_starts[r] to row_starts[r + 1]
    """

    step: Ints
    starts: Ints
    rows: Ints
    row_starts: Ints
    columns: Ints
    blocks: Ints


class _Quotient(NamedTuple):
    """The quotient graph during elimination.

    Attributes
    ----------
    starts, lists : list v is lists[starts[v] :]: `poses[v]` remaining neighbours, then `elements[v]`
        elements. It never grows, because an element replaces a pose or other elements
    step, columns : (k,) and (k + 1,) `step` and `starts` of the pattern so far
    mark : (k,) the last step whose element contained the pose
    alive : (k,) poses whose element no later one has absorbed
    outside, seen : (k,) number of poses of an element outside the newest one, and the step of the count
    """

    starts: Ints
    lists: Ints
    poses: Ints
    elements: Ints
    step: Ints
    columns: Ints
    mark: Ints
    alive: Mask
    outside: Ints
    seen: Ints


class _Degrees(NamedTuple):
    """Poses in doubly linked lists by degree; -1 ends a list."""

    degree: Ints
    first: Ints
    after: Ints
    before: Ints


@kernel
def eliminate(i: Ints, j: Ints, fixed: Mask) -> Pattern:
    """Return the pattern of the factor of a system with blocks (i, j) (e,); `fixed` (k,) have none."""
    k = len(fixed)
    graph = _adjacency(i, j, fixed)
    degrees = _Degrees(graph.poses.copy(), np.full(k + 1, -1), np.full(k, -1), np.full(k, -1))
    for v in range(k - 1, -1, -1):
        _insert(degrees, v)
    rows = np.empty(4 * len(graph.lists) + k, np.int64)
    lowest = 0
    for s in range(k):
        while degrees.first[lowest] < 0:
            lowest += 1
        p = degrees.first[lowest]
        _remove(degrees, p)
        if graph.columns[s] + k > len(rows):
            rows = np.concatenate((rows, np.empty(len(rows) + k, np.int64)))
        element = _make_element(graph, p, s, rows)
        for v in element:
            _count_outside(graph, v, s)
        for v in element:
            _remove(degrees, v)
            more = len(element) - 1
            bound = min(degrees.degree[v], _prune(graph, v, p)) + more
            degrees.degree[v] = min(bound, k - s - 2)
            _insert(degrees, v)
            lowest = min(lowest, degrees.degree[v])
    return _sorted(graph.step, graph.columns, rows[: graph.columns[k]])


@kernel
def _adjacency(i: Ints, j: Ints, fixed: Mask) -> _Quotient:
    """Return each pose's distinct neighbours that are not fixed."""
    k = len(fixed)
    starts, fill = np.zeros(k + 1, np.int64), np.zeros(k, np.int64)
    for e in range(len(i)):
        if i[e] != j[e] and not (fixed[i[e]] or fixed[j[e]]):
            starts[i[e] + 1] += 1
            starts[j[e] + 1] += 1
    for v in range(k):
        starts[v + 1] += starts[v]
    lists = np.empty(starts[k], np.int64)
    for e in range(len(i)):
        if i[e] != j[e] and not (fixed[i[e]] or fixed[j[e]]):
            for a, b in ((i[e], j[e]), (j[e], i[e])):
                lists[starts[a] + fill[a]] = b
                fill[a] += 1
    seen = np.full(k, -1)
    for v in range(k):
        end = starts[v]
        for at in range(starts[v], starts[v + 1]):
            end = _append(lists, end, seen, v, lists[at])
        fill[v] = end - starts[v]
    seen[:] = -1
    none = np.zeros(k, np.int64)
    columns, alive = np.zeros(k + 1, np.int64), np.zeros(k, np.bool_)
    step, mark = np.full(k, -1), np.full(k, -1)
    return _Quotient(starts, lists, fill, none, step, columns, mark, alive, none.copy(), seen)


@kernel
def _append(out: Ints, end: int, mark: Ints, stamp: int, v: int) -> int:
    """Append v to a list unless its mark shows that it is in it; return the new end."""
    if mark[v] != stamp:
        mark[v] = stamp
        out[end] = v
        end += 1
    return end


@kernel
def _make_element(graph: _Quotient, p: int, s: int, rows: Ints) -> Ints:
    """Eliminate p at step s and absorb its elements; return its neighbours, i.e. column s."""
    graph.step[p], graph.mark[p] = s, s
    begin = end = graph.columns[s]
    middle = graph.starts[p] + graph.poses[p]
    for v in graph.lists[graph.starts[p] : middle]:
        end = _append(rows, end, graph.mark, s, v)
    for e in graph.lists[middle : middle + graph.elements[p]]:
        if graph.alive[e]:
            graph.alive[e] = False
            column = graph.step[e]
            for v in rows[graph.columns[column] : graph.columns[column + 1]]:
                end = _append(rows, end, graph.mark, s, v)
    graph.columns[s + 1], graph.alive[p] = end, True
    return rows[begin:end]


@kernel
def _count_outside(graph: _Quotient, v: int, s: int) -> None:
    """Update the counts `outside` of v's elements for pose v, which is in the newest element."""
    middle = graph.starts[v] + graph.poses[v]
    for e in graph.lists[middle : middle + graph.elements[v]]:
        if graph.alive[e]:
            if graph.seen[e] != s:
                graph.seen[e] = s
                graph.outside[e] = graph.columns[graph.step[e] + 1] - graph.columns[graph.step[e]]
            graph.outside[e] -= 1


@kernel
def _prune(graph: _Quotient, v: int, p: int) -> int:
    """Remove from list v what the new element p covers; return a bound on the degree without p."""
    stamp, begin = graph.mark[p], graph.starts[v]
    middle, end, others = begin + graph.poses[v], begin, 0
    for u in graph.lists[begin:middle]:
        if graph.mark[u] != stamp:
            graph.lists[end] = u
            end += 1
    kept = end - begin
    for e in graph.lists[middle : middle + graph.elements[v]]:
        if graph.alive[e] and graph.outside[e] > 0:
            graph.lists[end] = e
            end += 1
            others += graph.outside[e]
    graph.lists[end] = p
    graph.poses[v], graph.elements[v] = kept, end + 1 - begin - kept
    return int(kept + others)


@kernel
def _insert(degrees: _Degrees, v: int) -> None:
    d = degrees.degree[v]
    head = degrees.first[d]
    degrees.after[v], degrees.before[v], degrees.first[d] = head, -1, v
    if head >= 0:
        degrees.before[head] = v


@kernel
def _remove(degrees: _Degrees, v: int) -> None:
    after, before = degrees.after[v], degrees.before[v]
    if before >= 0:
        degrees.after[before] = after
    else:
        degrees.first[degrees.degree[v]] = after
    if after >= 0:
        degrees.before[after] = before


@kernel
def _sorted(step: Ints, starts: Ints, poses: Ints) -> Pattern:
    """Return the pattern with poses replaced by steps, sorted by transposing it twice."""
    k, m = len(step), len(poses)
    row_starts, place = np.zeros(k + 1, np.int64), np.empty(k, np.int64)
    columns, blocks, rows = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m, np.int64)
    for p in poses:
        row_starts[step[p] + 1] += 1
    for s in range(k):
        row_starts[s + 1] += row_starts[s]
        place[s] = row_starts[s]
    for s in range(k):
        for p in poses[starts[s] : starts[s + 1]]:
            columns[place[step[p]]] = s
            place[step[p]] += 1
    place[:] = starts[:k]
    for r in range(k):
        for t in range(row_starts[r], row_starts[r + 1]):
            c = columns[t]
            blocks[t], rows[place[c]] = place[c], r
            place[c] += 1
    return Pattern(step, starts, rows, row_starts, columns, blocks)
