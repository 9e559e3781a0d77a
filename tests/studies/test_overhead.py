"""The study of the overhead camera: errors of cylinders, and completeness of its report."""

import math
from types import SimpleNamespace

import numpy as np

from impslam.overhead.discs import MeasuredCylinder
from impslam.simulation.world import load_world
from impslam.studies import overhead
from impslam.studies.report import load_text
from impslam.sweeps.job import Job


def test_cylinders_are_compared_with_the_nearest_and_none_may_be_missing() -> None:
    world, off = load_world("arena"), np.array([0.003, -0.004])
    found = [
        MeasuredCylinder(np.add(part.centre, off), np.eye(2), 0.15) for part in world.cylinders
    ]
    errors = overhead._cylinder_errors(world, SimpleNamespace(cylinders=found[::-1]))
    assert math.isclose(overhead._rms(errors), 0.005)
    errors = overhead._cylinder_errors(world, SimpleNamespace(cylinders=found[1:]))
    assert overhead._rms(errors) == math.inf


def test_the_section_reports_all_metrics(monkeypatch) -> None:
    row = dict.fromkeys(overhead.FOUND, 0.002)
    monkeypatch.setattr(overhead, "measure", lambda seed: row | {"seed": seed})
    monkeypatch.setattr(overhead, "film_and_track", lambda *_: (None, None, None))
    monkeypatch.setattr(overhead, "draw_track", lambda *_: None)
    monkeypatch.setattr(overhead, "as_png", lambda *_, **__: b"")
    section = overhead.overhead(Job(3))
    assert [name for name, _ in section.tables[0].rows] == [n for n, _ in overhead.FOUND.values()]
    assert section.numbers["place"] == [0.002] * 3
    assert section.title == load_text("overhead")["title"]
