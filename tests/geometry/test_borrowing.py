"""Kernels count references only to the arrays that they make or return, and free all memory."""

import gc
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

from impslam.geometry.dispatcher import KernelDispatcher
from impslam.geometry.kernels import Kernel, kernel
from impslam.types import Array


class Pair(NamedTuple):
    """Two arrays of points (n, 2)."""

    first: Array
    second: Array


@kernel
def first_of(pair: Pair) -> Array:
    """Return an array of the caller."""
    return pair.first


@kernel
def moved(points: Array, x: float) -> Array:
    """Return a new array."""
    return points + x


@kernel
def dot(a: Array, b: Array) -> float:
    """Read two arrays."""
    return float(a[0] * b[0] + a[1] * b[1])


@kernel
def sum_of_views(pair: Pair) -> float:
    """Only borrow: read from a tuple, slice, transpose, and pass views on."""
    first, second = pair
    total = 0.0
    for k in range(len(first)):
        a, b = first[k], second.T[:, k]
        chosen = a if a[0] > b[0] else b
        total += dot(chosen, b)
    return total


@kernel
def sum_of_calls(pair: Pair) -> float:
    """Get arrays from other kernels, one of them new."""
    total = 0.0
    for k in range(len(pair.first)):
        total += dot(first_of(pair)[k], moved(pair.second[k], 1.0))
    return total


@kernel
def shift_rows(points: Array) -> float:
    """Copy rows of an array, which overlap, through a new one."""
    points[1:] = points[:-1]
    return float(points[-1, 0])


@kernel
def last_of(points: Array, anew: bool) -> float:
    """Use a variable that either borrows an array or owns it."""
    chosen = points[1:] if not anew else moved(points, 1.0)
    last = chosen[-1]
    return float(last[0])


def references(function: Kernel, *arguments: object) -> int:
    """Return how often the machine code of a kernel takes a reference."""
    dispatcher = KernelDispatcher(function.py_func)  # numba does not show the code of a cached one
    dispatcher(*arguments)
    (code,) = dispatcher.inspect_llvm().values()
    return int(code.count("call void @NRT_incref"))


@pytest.fixture
def pair() -> Pair:
    """Points."""
    return Pair(np.arange(10.0).reshape(5, 2), np.ones((5, 2)))


def test_a_kernel_takes_no_references_to_arrays_of_its_caller(pair: Pair) -> None:
    assert references(sum_of_views, pair) == 0
    assert sum_of_views(pair) == 2.0 + sum(4.0 * k + 1.0 for k in range(1, 5))


def test_a_kernel_takes_a_reference_to_what_it_returns_or_may_own(pair: Pair) -> None:
    assert references(first_of, pair) > 0
    assert references(last_of, pair.first, False) > 0


@pytest.fixture
def without_collector() -> Iterator[None]:
    """Free arrays of other tests in reference cycles now, and none during the test."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_all_memory_is_freed(pair: Pair, without_collector: None) -> None:
    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    for _ in range(3):
        assert sum_of_calls(pair) == 2.0 * pair.first.sum()
        assert shift_rows(pair.first.copy()) == 6.0
        assert [last_of(pair.first, anew) for anew in (False, True)] == [8.0, 9.0]
        view = first_of(pair)
        assert np.shares_memory(view, pair.first)
        del view
    after = rtsys.get_allocation_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0
    assert after.mi_alloc - before.mi_alloc == after.mi_free - before.mi_free > 0
