"""The two maps of the last metres."""

import numpy as np

from impslam.tracking.submaps import confirmed_surfels, empty_submaps, extend


def wall(y: float) -> np.ndarray:
    """Return the features of a wall of 2 m at y m, seen from below."""
    x = np.arange(-1.0, 1.0, 0.05) + 0.025
    rows = [x, np.full_like(x, y), np.zeros_like(x), np.full_like(x, -1.0), np.ones_like(x)]
    return np.column_stack(rows).astype(np.float32)


def test_surfels_that_only_a_newest_scan_of_poor_fit_shows_are_not_confirmed():
    submaps, pose = empty_submaps(10.0), np.zeros(3)
    assert len(confirmed_surfels(submaps)) == 0
    extend(submaps, wall(1.025), pose, 6.0)
    assert np.allclose(confirmed_surfels(submaps)[:, 1], 1.025)
    extend(submaps, np.concatenate((wall(1.025), wall(3.025))), pose, 6.0, False)
    assert np.allclose(confirmed_surfels(submaps)[:, 1], 1.025)
    for fits in (False, True):
        extend(submaps, wall(5.025), pose, 6.0, fits)
        shown = [1.025, 3.025, 5.025] if fits else [1.025, 3.025]
        assert np.allclose(np.unique(confirmed_surfels(submaps)[:, 1].round(3)), shown)


def test_confirmed_surfels_are_those_of_the_older_map():
    submaps, pose = empty_submaps(10.0), np.zeros(3)
    for k in range(8):
        extend(submaps, wall(1.025 + k), pose, 6.0)
        submaps.travelled[0] += 1.0
    older = submaps.first if submaps.older[0] == 0 else submaps.second
    assert np.allclose(confirmed_surfels(submaps), older.surfels[: older.size[0]])
