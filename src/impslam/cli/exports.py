"""What `imp run` writes besides the run's folder: files for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from impslam.errors import ConfigError

if TYPE_CHECKING:
    from impslam.observers.base import Observer


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Exports:
    """Options of a run that is written for other programs, too.

    Parameters
    ----------
    mcap
        Write the result for Foxglove and RViz: /map, /path, /landmarks, /tf, /health in one MCAP file.
    rerun
        Write the run for the viewer Rerun, an .rrd file (needs rerun-sdk).
    video
        Write the drive as a video, an .mp4 file (VP9, 15 s; takes about half a minute).
    """

    mcap: Path | None = None
    rerun: Path | None = None
    video: Path | None = None

    def observers(self, show: Callable[[str, float], None]) -> list[Observer]:
        """Return what writes the files; `show` is called with what is written and the share that is.

        Raises
        ------
        ConfigError
            If a file cannot be written; the run has not begun yet.
        """
        for path, ending in self._files():
            if path.suffix != ending:
                raise ConfigError(f"{path}: give it a name that ends in {ending}")
            if not path.parent.is_dir():
                raise ConfigError(f"{path}: there is no folder {path.parent}; make it first")
        return list(self._made(show))

    def _files(self) -> list[tuple[Path, str]]:
        files = ((self.mcap, ".mcap"), (self.rerun, ".rrd"), (self.video, ".mp4"))
        return [(path, ending) for path, ending in files if path is not None]

    def _made(self, show: Callable[[str, float], None]) -> Iterator[Observer]:
        if self.mcap is not None:
            from impslam.observers.ros_map import RosMap

            yield RosMap(self.mcap)
        if self.rerun is not None:
            from impslam.observers.rerun_file import RerunFile

            yield RerunFile(self.rerun)
        if self.video is not None:
            from impslam.observers.video import Video

            yield Video(self.video, partial(show, "writing the video"))

    def lines(self) -> Iterator[str]:
        """Yield a line for each file."""
        for path, use in (
            (self.mcap, "for Foxglove and RViz"),
            (self.rerun, "for Rerun"),
            (self.video, "video"),
        ):
            if path is not None:
                yield f"{use}: {path}"
