"""What holds for every observer: it sees a run, and cannot change it."""

from contextlib import suppress
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from tests.recorded import perfect

from impslam.config import load
from impslam.observers.base import Observer
from impslam.run import Run
from impslam.simulation.world import load_world


def arrays(*values):
    """Yield the arrays that stand in what an observer is shown."""
    for value in values:
        names = [f.name for f in fields(value)] if is_dataclass(value) else value._fields
        yield from (a for n in names if isinstance(a := getattr(value, n), np.ndarray))


class Spoiler(Observer):
    """Writes into whatever it is shown."""

    shown = 0

    def spoil(self, *values):
        for array in arrays(*values):
            self.shown += 1
            with suppress(ValueError):
                array[...] = np.ones((), array.dtype)

    def follow(self, track, path):
        self.spoil(track, path)

    def revise(self, keyframe, revision, path):
        self.spoil(keyframe, revision, path)

    def truth(self, pose):
        self.spoil(pose)


@pytest.mark.parametrize(
    "settings", [(), ("tracker.kind=scan_to_map",)], ids=["odometry", "scan_to_map"]
)
def test_an_observer_that_writes_into_what_it_is_shown_changes_nothing(settings, tmp_path):
    config, messages = load("imp", settings), perfect(load_world("room"))
    spoiler = Spoiler()
    files = [
        Run(config, observers).play(messages).save(tmp_path / "map.imp").read_bytes()
        for observers in ([], [spoiler], [Observer(), spoiler, Observer()])
    ]
    assert spoiler.shown > 1000
    assert files[0] == files[1] == files[2]
