"""Files for other programs that `imp run` can write beside the run's folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Self

from cyclopts import Parameter

from impslam.errors import ConfigError
from impslam.paths import written

if TYPE_CHECKING:
    from impslam.observers.base import Observer


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Exports:
    """Options that export a run to files for other programs.

    Parameters
    ----------
    mcap
        Export to an MCAP file for Foxglove and RViz, with /map, /path, /landmarks, /tf and /health.
    rerun
        Export to an .rrd file for the Rerun viewer (needs rerun-sdk).
    video
        Export to an .mp4 video of the drive (VP9, at most 15 s long; takes about half a minute).
    """

    mcap: Path | None = None
    rerun: Path | None = None
    video: Path | None = None

    def checked(self) -> Self:
        """Return these options; raise `ConfigError` if a file cannot be written."""
        for path, ending in self._endings():
            if path.suffix != ending:
                raise ConfigError(f"{path}: the file name must end in {ending}")
            if not path.parent.is_dir():
                raise ConfigError(f"{path}: no such folder: {path.parent}; create it first")
            if path.is_dir():
                raise ConfigError(f"{path}: is a folder; give another name")
            with (
                written(path, "check folder and permissions", ConfigError),
                TemporaryFile(dir=path.parent),
            ):
                pass
        return self

    def files(self) -> list[Path]:
        """Return the files to write."""
        return [path for path, _ in self._endings()]

    def _endings(self) -> list[tuple[Path, str]]:
        files = ((self.mcap, ".mcap"), (self.rerun, ".rrd"), (self.video, ".mp4"))
        return [(path, ending) for path, ending in files if path is not None]

    def observers(self, show: Callable[[str, float], None]) -> Iterator[Observer]:
        """Yield the observers that write the files; `show` is called with the task and its progress."""
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
        """Yield a line of output for each file."""
        for path, use in (
            (self.mcap, "for Foxglove and RViz"),
            (self.rerun, "for Rerun"),
            (self.video, "video"),
        ):
            if path is not None:
                yield f"{use}: {path}"
