import math

import numpy as np

from impslam.graph.overlaps import Nearness, overlaps


def straight(n, spacing=0.4):
    return np.stack([np.arange(n) * spacing, np.zeros(n), np.zeros(n)], 1)


def test_neighbours_of_one_pass_are_the_nearest_four():
    pairs = overlaps(straight(30))
    of = pairs[pairs[:, 1] == 15, 0]
    assert sorted(of) == [13, 14, 16, 17]
    assert (np.diff(pairs[:, 1]) >= 0).all()


def test_other_passes_get_a_share():
    there = straight(40)
    back = there[::-1] + np.array([0.0, 0.3, 1.0])
    again = there + np.array([0.0, -0.3, 0.2])
    pairs = overlaps(np.concatenate([there, back, again]))
    of = pairs[pairs[:, 1] == 10, 0]
    assert (of < 40).sum() == 4
    assert of[of >= 40].tolist() == [90, 69]  # those right beside, and the nearest first


def test_a_pass_the_other_way_counts_for_lidars_that_see_all_around():
    there = straight(40)
    back = there[::-1] + np.array([0.0, 0.3, math.pi])
    both = np.concatenate([there, back])
    assert all((i < 40) == (j < 40) for i, j in overlaps(both) if 8 < j < 32)
    wide = overlaps(both, Nearness(turn=math.pi))
    assert any((i < 40) != (j < 40) for i, j in wide if 8 < j < 32)


def test_headings_wrap():
    poses = straight(2) + np.array([0.0, 0.0, math.pi - 0.01])
    poses[1, 2] = -math.pi + 0.01
    assert overlaps(poses).tolist() == [[1, 0], [0, 1]]


def test_what_is_far_is_not_paired():
    assert len(overlaps(straight(10, 3.5))) == 0
    assert len(overlaps(straight(1))) == 0
    assert len(overlaps(np.empty((0, 3)))) == 0


def test_no_pair_is_there_twice_and_none_with_itself():
    rng = np.random.default_rng(1)
    poses = np.cumsum(rng.normal(0, 0.4, (200, 3)), 0)
    pairs = overlaps(poses)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert (pairs[:, 0] != pairs[:, 1]).all()
    d = poses[pairs[:, 0], :2] - poses[pairs[:, 1], :2]
    assert np.hypot(d[:, 0], d[:, 1]).max() < 3.0
    assert np.bincount(pairs[:, 1]).max() <= 6
    assert overlaps(poses).tobytes() == pairs.tobytes()
