import math

import numpy as np
import pytest
from tests.rooms import MOUNTS, scans_at

from impslam.graph.bearings import BINS, bearing_bin, nearest_feature, sort_by_bearing


def test_bins_grow_with_the_bearing():
    angles = np.linspace(0, 2 * math.pi, 20_000, endpoint=False)
    bins = [bearing_bin(3 * math.cos(a), 3 * math.sin(a)) for a in angles]
    assert (np.diff(bins) >= 0).all()
    assert set(bins) == set(range(BINS))
    assert bearing_bin(0.0, 0.0) == 0
    assert bearing_bin(1.0, -1e-20) == BINS - 1


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_nearest_feature_is_found(mount):
    poses = np.array([[1.0, 1.0, 0.3], [6.0, 2.9, -2.0], [13.0, 4.0, 3.0]])
    scans = scans_at(poses, MOUNTS[mount])
    fans = sort_by_bearing(scans._replace(lasers=np.tile(scans.lasers, (3, 1))))
    rng = np.random.default_rng(2)
    for i in range(3):
        rows = slice(scans.starts[i], scans.starts[i + 1])
        before, after = scans.features[rows], fans.scans.features[rows]
        assert sorted(map(bytes, before)) == sorted(map(bytes, after))
        near = after[rng.integers(len(after), size=300), :2] + rng.normal(0, 0.3, (300, 2))
        around = scans.lasers + rng.normal(0, 0.2, (100, 2))
        for x, y in np.concatenate([near, around]):
            d = np.hypot(after[:, 0] - x, after[:, 1] - y)
            q = nearest_feature(fans, i, x, y, 0.3)
            if d.min() < 0.3:
                assert d[q - scans.starts[i]] == d.min()
            else:
                assert q == -1


def test_a_scan_without_features_has_no_nearest():
    scans = scans_at(np.array([[1.0, 1.0, 0.3]]))
    empty = scans._replace(starts=np.array([0, len(scans.features), len(scans.features)]))
    fans = sort_by_bearing(empty._replace(lasers=np.zeros((2, 2))))
    assert nearest_feature(fans, 1, 1.0, 0.0, 0.3) == -1
