"""Waiting for another thread."""

import time


def wait_until(true, seconds=120.0):
    """Return once `true()` holds; the first scan of a test may have to compile, on a busy machine."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)
