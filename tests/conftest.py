"""Fixtures shared by all tests."""

import logging
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# The same code gives the same answer, also on a slow machine.
# `--hypothesis-profile=default` searches with new examples.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

DATA = Path(os.environ.get("IMPSLAM_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real logs; the test is skipped where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"needs the real logs in {DATA} (set IMPSLAM_DATA to use another folder)")
    return DATA


@pytest.fixture(autouse=True)
def library_log() -> None:
    """Begin with the library's log as it is without a command: those set it up for themselves."""
    log = logging.getLogger("impslam")
    log.setLevel(logging.NOTSET)
    log.propagate, log.handlers[:] = True, []


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed."""
    return np.random.default_rng(20150501)


@pytest.fixture(scope="session")
def chromium() -> str:
    """Debian's Chromium; the test is skipped where it is absent."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("needs Chromium (apt-get install chromium)")
    return path
