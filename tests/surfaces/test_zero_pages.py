"""Zeros whose memory is taken where they are written."""

import subprocess
import sys

import numpy as np
import pytest

from impslam.surfaces.zero_pages import zero_pages

# Arrays as large as a tracker's, one after another: the C library would keep the memory of the first ones.
GROWTH = """
import os
from impslam.surfaces.zero_pages import zero_pages

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

before = resident()
for _ in range(6):
    two = [zero_pages((2480, 2480), "int32") for _ in range(2)]
    assert two[0].sum() == 0
    two[0][1000, 1000] = 7
del two
print(resident() - before)
"""


@pytest.mark.parametrize(("shape", "kind"), [((3, 5), np.int32), ((7,), np.uint8), ((0, 8), float)])
def test_they_are_zeros_of_that_shape_and_can_be_written(shape, kind):
    zeros = zero_pages(shape, kind)
    assert zeros.shape == shape
    assert zeros.dtype == kind
    assert not zeros.any()
    zeros[...] = 1
    assert zeros.all()


def test_arrays_do_not_share_memory():
    one, two = zero_pages((100,), float), zero_pages((100,), float)
    one[:] = 1.0
    assert not two.any()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_their_memory_is_given_back():
    said = subprocess.run(
        [sys.executable, "-c", GROWTH], capture_output=True, text=True, check=True
    )
    assert int(said.stdout) < 2_000_000
