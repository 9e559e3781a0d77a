"""Unusable arguments of `localise`; `tests/cli/test_cli_map.py` tests its results."""

from __future__ import annotations

import numpy as np
import pytest
from tests.maps.drawn import mapped
from tests.recognition.plans import OFFICE, way

from impslam.errors import ConfigError
from impslam.localisation import localise

KNOWN = mapped(OFFICE, np.asarray(way(-6.0, -0.5, 6.0, 0.2, 3)))


@pytest.mark.parametrize(
    ("known", "every", "why"),
    [
        ("a.imp", 1, r"known = 'a\.imp': expected a Map"),
        (KNOWN, 0, "every = 0: expected 1 or more"),
    ],
)
def test_unusable_arguments_are_refused(known, every, why) -> None:
    with pytest.raises(ConfigError, match=why):
        next(localise(known, "drive.mcap", every=every))
