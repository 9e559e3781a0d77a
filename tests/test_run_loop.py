"""A run that closes a loop: what it tells of it, and what must not jump."""

import numpy as np
import pytest
from tests.rings import GRAPH, ring

from impslam.geometry.se2 import between
from impslam.map import Map
from impslam.observers.base import Observer
from impslam.run import Run


class Seen(Observer):
    """The keyframes at which a loop closed."""

    def __init__(self):
        self.loops = []

    def revise(self, keyframe, revision, path):
        if len(revision.ids) > 1:
            self.loops.append(keyframe.id)


@pytest.fixture(scope="module")
def messages():
    return list(ring())


@pytest.fixture(scope="module")
def driven(messages):
    """The run, its map, and the keyframes at which a loop closed."""
    seen = Seen()
    run = Run(GRAPH, [seen])
    return run, run.play(messages), seen.loops


def test_the_map_has_the_graph(driven, tmp_path):
    _, known, loops = driven
    edges = known.edges
    closures = np.isfinite(edges.kernel)
    assert loops
    assert closures.any()
    assert (edges.i[~closures] == np.r_[0, edges.j[~closures][:-1]]).all()  # the chain has no gap
    assert (np.abs(edges.j - edges.i)[closures] > 50).all()  # a lap has about 100 keyframes
    poses = known.keyframes.poses
    error = between(poses[edges.i], poses[edges.j]) - edges.T_i_j
    assert np.abs(error[:, :2]).max() < 0.1
    assert (np.linalg.eigvalsh(edges.information) > 0.0).all()
    back = Map.load(known.save(tmp_path / "ring.imp")).edges
    assert [a.tobytes() for a in back] == [np.ascontiguousarray(a).tobytes() for a in edges]
