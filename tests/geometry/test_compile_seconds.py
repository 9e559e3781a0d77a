"""How long kernels were compiled is counted once, and loading them is not compiling."""

import time

from impslam.geometry.kernels import compile_seconds, kernel


def test_compiling_is_counted_with_what_is_compiled_into_it_once() -> None:
    @kernel
    def inner(x: float) -> float:
        return x + 1.0

    @kernel
    def outer(x: float) -> float:
        return inner(x) + inner(2.0 * x)

    before, begin = compile_seconds(), time.perf_counter()
    outer(1.0)
    took, wall = compile_seconds() - before, time.perf_counter() - begin
    assert 0.0 < took <= wall
    outer(2.0)
    assert compile_seconds() - before == took
