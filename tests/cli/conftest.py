from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import pytest

from impslam.cli import main
from impslam.health import NO_FAULT
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter


@dataclass(frozen=True)
class Result:
    """How a command ended: its exit code and what it printed."""

    code: int
    out: str
    err: str


Imp = Callable[..., Result]


@pytest.fixture
def imp(capfd: pytest.CaptureFixture[str]) -> Imp:
    """Call the command line in this process."""

    def call(*words: object) -> Result:
        code = main([str(word) for word in words])
        return Result(code, *capfd.readouterr())

    return call


@pytest.fixture
def undiagnosed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the diagnosis of a log before `imp run`, more than half of a run of the room."""
    monkeypatch.setattr("impslam.cli.run._log_fault", lambda *_, **__: NO_FAULT)


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of ten seconds in a small room, with its truth beside it."""
    log = tmp_path_factory.mktemp("room") / "room.mcap"
    assert main(["simulate", "room", "-o", str(log), "--quiet"]) == 0
    return log


@pytest.fixture(scope="session")
def brief(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of that log, with too few scans for a diagnosis, which takes most of a run's time."""
    log = tmp_path_factory.mktemp("brief") / "brief.mcap"
    with McapWriter(log, "imp") as writer:
        for message in islice(simulate(load_world("room"), seed=0), 700):
            writer.write(message)
    return log
