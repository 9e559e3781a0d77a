"""The peak memory of a process."""

import sys

import numpy as np
import pytest

from impslam.sweeps.memory import peak_memory
from impslam.sweeps.pool import run_in_process


def filled(megabytes):
    kept = np.ones(int(1e6) * megabytes, np.uint8)
    return peak_memory() + 0 * kept[0]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="not told there")
def test_it_grows_by_what_is_in_use():
    assert run_in_process(filled, 300) - run_in_process(filled, 1) == pytest.approx(299e6, rel=0.05)
