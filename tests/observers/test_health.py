"""Health: why a pose is unreliable, and that it does not matter how a log is cut."""

from types import SimpleNamespace

import numpy as np
import pytest

from impslam.map import PathRows
from impslam.observers.health import HealthMonitor


def watch(spreads, cuts, *, valid=None, contradicted=None, located=None):
    """Let a robot drive 1 m a scan with these position variances; return the monitor's health."""
    n = len(spreads)
    poses = np.column_stack((np.arange(n), np.zeros((n, 2)))).astype(float)
    covariances = np.array(spreads)[:, None, None] * np.full((3, 3), 0.5)
    valid = np.ones((n, 3), bool) if valid is None else valid
    contradicted = np.zeros(n, bool) if contradicted is None else contradicted
    located = np.zeros(n, bool) if located is None else located
    monitor = HealthMonitor()
    for a, b in zip((0, *cuts), (*cuts, n), strict=True):
        rows = slice(a, b)
        sweeps = SimpleNamespace(scans=SimpleNamespace(valid=valid))
        track = SimpleNamespace(
            sweeps=sweeps, rows=rows, contradicted=contradicted[rows], located=located[rows]
        )
        path = PathRows(10.0 + np.arange(n)[rows], poses[rows], covariances[rows], poses[rows])
        monitor.follow(track, path)
    return monitor.health


@pytest.mark.parametrize("cuts", [(), (1,), (1, 2, 3, 4), (3,)])
def test_growth_since_the_first_pose_counts_and_no_cut_of_the_log(cuts):
    health = watch([9.0, 9.04, 9.09, 9.16, 9.0], cuts)
    assert (health.unreliable, health.stamp) == (2, 12.0)
    assert health.first == "nothing known was seen for 2.0 m, position uncertain by 0.3 m"
    assert health.at_end == ""


def test_the_most_severe_reason_is_told():
    blind, doubt = np.zeros((3, 3), bool), np.ones(3, bool)
    assert "not finite" in watch([1.0, 1.0, np.inf], (), valid=blind, contradicted=doubt).at_end
    assert "nothing known was seen" in watch([0.0, 1.0, 1.0], (), contradicted=doubt).at_end
    assert "another motion" in watch([0.0, 0.0, 0.0], (), valid=blind, contradicted=doubt).at_end
    assert "no valid range" in watch([0.0, 0.0, 0.0], (), valid=blind).at_end
    assert watch([0.0, 0.0, 0.0], ()).summary == "reliable throughout"


@pytest.mark.parametrize("cuts", [(), (2,), (1, 2, 3, 4)])
def test_growth_since_the_last_match_counts(cuts):
    """Two located scans start afresh; 2 m after the second, 0.3 m are uncertain again."""
    located = np.array([False, True, True, False, False])
    health = watch([9.0, 9.5, 10.0, 10.04, 10.09], cuts, located=located)
    assert (health.unreliable, health.stamp) == (1, 14.0)
    assert health.first == "nothing known was seen for 2.0 m, position uncertain by 0.3 m"
