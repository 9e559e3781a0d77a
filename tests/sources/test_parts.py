"""Columns of several layouts are joined and cut into batches, in order; stamps are checked across them."""

import heapq
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam import columns
from impslam.columns import Columns
from impslam.sources.parts import Piece, merge_order, to_batches
from impslam.sources.stamps import StampCheck
from impslam.types import OdometryPose

LOG = Path("a.log")


def poses(stream: str, order: list[int], layout: float = 0.0) -> Columns:
    values = {"stamp": np.array(order, float), "pose": np.zeros((len(order), 3))}
    return Columns(stream, OdometryPose, np.array(order), values, {"angle": layout})


@pytest.mark.parametrize("rows", [1, 2, 3, 100])
def test_columns_are_cut_in_the_order_of_the_log(rows: int) -> None:
    parts = [poses("a", [0, 3, 4]), poses("b", [1, 5, 9]), poses("a", [2, 8]), poses("b", [7])]
    batches = list(to_batches(parts, rows))
    for one, two in pairwise(batches):
        last = max(columns.order[-1] for columns in one.values())
        assert last < min(columns.order[0] for columns in two.values())
    assert all(sum(map(len, batch.values())) <= rows for batch in batches)
    found = {"a": [], "b": []}
    for batch in batches:
        for name, c in batch.items():
            assert (np.diff(c.order) > 0).all()
            np.testing.assert_array_equal(c.stamps, c.order)
            found[name] += c.order.tolist()
    assert found == {"a": [0, 2, 3, 4, 8], "b": [1, 5, 7, 9]}
    assert len(batches) == -(-9 // rows)


def test_a_batch_ends_where_a_layout_changes() -> None:
    parts = [poses("a", [0, 1, 4]), poses("a", [2, 3], 1.0), poses("b", [5])]
    found = [
        {name: (c.order.tolist(), c["angle"]) for name, c in batch.items()}
        for batch in to_batches(parts, 100)
    ]
    assert found == [{"a": ([0, 1], 0.0)}, {"a": ([2, 3], 1.0)}, {"a": ([4], 0.0), "b": ([5], 0.0)}]


def test_no_rows_give_no_batch() -> None:
    assert not list(to_batches([], 5))


STAMPS = [0.0, 0.5, 0.5, 0.25, 20.0, 20.0, 19.0, 60.0]
WANTED = {
    "repeated stamp": ("a.log:102: x has the same stamp as its predecessor, 0.500000", 2),
    "backward stamp": (
        "a.log:103: x has a stamp 0.250000 s before that of its predecessor; file order is kept",
        2,
    ),
    "gap": ("a.log:104: x was silent for 19.8 s; was recording paused?", 2),
}


@pytest.mark.parametrize("rows", [1, 2, 3, 100])
def test_stamps_are_checked_across_the_cuts(rows: int) -> None:
    check, found = StampCheck(LOG), {}
    for begin in range(0, len(STAMPS), rows):
        k = np.arange(begin, min(begin + rows, len(STAMPS)))
        values = {"stamp": np.array(STAMPS)[k], "pose": np.zeros((len(k), 3))}
        x = Columns("x", OdometryPose, k, values, {})
        y = Columns("y", OdometryPose, k, {"stamp": 0.5 * k}, {})
        unchecked = Columns("x", OdometryPose, k + 100, {"stamp": np.full(len(k), -9.0)}, {})
        part = [
            Piece(x, 100 + k, np.ones(len(k), bool)),
            Piece(y, k, np.ones(len(k), bool)),
            Piece(unchecked, k, np.zeros(len(k), bool)),
        ]
        for kind, example, count in check.check(part):
            first, before = found.get(kind, (example, 0))
            found[kind] = first, before + count
    assert found == WANTED


def test_a_full_batch_does_not_wait_for_the_next_message() -> None:
    read = []

    def log():
        for i in range(3):
            read.append(i)
            yield "a", OdometryPose(float(i), np.zeros(3))

    next(columns.batches(log(), 1))
    assert read == [0]


@given(st.lists(st.lists(st.integers(0, 9).map(float), max_size=8), min_size=1, max_size=4))
def test_files_are_merged_as_by_heapq(stamps: list[list[float]]) -> None:
    streams = [[(x, i, k) for k, x in enumerate(each)] for i, each in enumerate(stamps)]
    expected = list(heapq.merge(*streams, key=lambda row: row[0]))
    found = merge_order(*(np.array(each, float) for each in stamps))
    assert [
        (stamps[i][k], i, k)
        for _, i, k in sorted(
            (o, i, k) for i, order in enumerate(found) for k, o in enumerate(order)
        )
    ] == expected
