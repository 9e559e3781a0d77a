"""Noiseless logs in memory, and a source that plays any list of messages as a reader would."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Self

from pydantic import PrivateAttr

from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World
from impslam.sources.base import Source, Stream
from impslam.sources.parts import LocatedMessage
from impslam.types import Message


class Played(Source):
    """A list of messages, watched like those of a file."""

    _list: list[Message] = PrivateAttr(default_factory=list)

    @classmethod
    def of(cls, messages: Iterable[Message], folder: Path) -> Self:
        """Return a source; `folder` gets an empty file for the path that every source has."""
        path = folder / "played.log"
        path.write_bytes(b"")
        source = cls(path=path)
        source._list = list(messages)
        return source

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Recognise nothing: it is made, not found."""
        return False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def _messages(self) -> Iterator[LocatedMessage]:
        for i, message in enumerate(self._list):
            yield LocatedMessage(message, i, type(message).__name__)

    def streams(self) -> list[Stream]:
        """Return nothing; nobody asks."""
        return []


def perfect(world: World, beam_time: float = 0.0) -> list[Message]:
    """Return what a robot without faults records: exact angles, exact ranges."""
    robot = SimulatedRobot(
        encoders=WheelEncoders.perfect(), lidar=Lidar.perfect(beam_time=beam_time), imu=None
    )
    return list(simulate(world, robot))
