"""The sums of all coarse blocks are those of the blocks one by one."""

import numpy as np
import pytest

from impslam.recognition.coarse_sums import (
    BLOCK,
    LEVEL,
    MAX_GAP,
    REACH,
    coarse_sums,
    lines,
    runs_of,
)
from impslam.recognition.pyramid import CELL, pool

UNKNOWN = 25


@pytest.fixture
def level():
    """Return the coarse level (3, h, w) of random cells, of no whole number of blocks, in unknown space."""
    cells = np.full((LEVEL + 1, 3, 45, 70), UNKNOWN, np.uint8)
    inside = cells[0, :, 2 * BLOCK : -2 * BLOCK, 2 * BLOCK : -2 * BLOCK]
    inside[:] = np.random.default_rng(1).integers(0, 256, inside.shape)
    for k in range(3):
        pool(cells[:, k])
    return cells[LEVEL]


@pytest.mark.parametrize("points", [1, 4, 7])
def test_sums_are_those_of_each_block(level, points):
    rng = np.random.default_rng(points)
    allowed = (rng.random((45, 70)) < 0.4).astype(np.uint8)
    limit = int(REACH / CELL)
    rotated = np.stack(
        [rng.integers(0, 3, (6, points)), *rng.integers(-60, 61, (2, 6, points))], axis=2
    )
    rotated[0, 0, 1], rotated[1, 0, 1], rotated[2, 0, 2] = -limit, limit, limit
    runs = runs_of(allowed)
    sums = coarse_sums(lines(level, UNKNOWN), allowed, runs, rotated.astype(np.int32))
    for row, first, count, before in runs:
        for k in range(count):
            column = (first + k) * BLOCK
            expected = np.zeros(6, int)
            for a in range(6 if allowed[row, column] else 0):
                for direction, x, y in rotated[a]:
                    u, v = column + x, row + y
                    inside = 0 <= u < 70 and 0 <= v < 45
                    expected[a] += level[direction, v, u] if inside else UNKNOWN
            assert sums[:, before + k].tolist() == expected.tolist()


def test_runs_contain_all_allowed_blocks_and_short_gaps():
    allowed = np.zeros((9, 30 * BLOCK), np.uint8)
    blocks = [2, 3, 5, 5 + MAX_GAP + 1, 5 + 2 * MAX_GAP + 3]
    allowed[BLOCK, np.array(blocks) * BLOCK] = 1
    allowed[2 * BLOCK, -BLOCK] = 1
    assert runs_of(allowed).tolist() == [
        [BLOCK, 2, 5 + MAX_GAP + 2 - 2, 0],
        [BLOCK, blocks[-1], 1, 5 + MAX_GAP],
        [2 * BLOCK, 29, 1, 6 + MAX_GAP],
    ]


def test_a_map_without_any_place_has_no_sums(level):
    allowed = np.zeros((45, 70), np.uint8)
    rotated = np.zeros((6, 4, 3), np.int32)
    assert coarse_sums(lines(level, UNKNOWN), allowed, runs_of(allowed), rotated).shape == (6, 0)
