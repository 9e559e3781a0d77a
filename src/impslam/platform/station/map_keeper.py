"""Keeps the map that the robot makes on the disk: each minute, at its end, and when asked for."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from impslam.errors import ImpError, in_a_line
from impslam.paths import make_folder, written
from impslam.platform.station.going_on import GoingOn
from impslam.platform.station.map_store import FILE
from impslam.platform.station.mapper import LiveMapper

log = logging.getLogger(__name__)

PERIOD = 60.0  # s of map that a power failure may cost
SHARE = 20
"""A map is not saved again before so many times the seconds that saving took: a large one takes at
most a twentieth of the computer."""


class MapKeeper:
    """Saves what a mapper maps, each map into a folder of its own.

    The file of the map is replaced at once by one that is on the disk, so that a power failure leaves
    the old or the new one.

    Parameters
    ----------
    mapper : what makes the map
    folder : where maps are kept; it is made if need be
    announce : called with a level and a line where a map cannot be saved
    """

    def __init__(
        self, mapper: LiveMapper, folder: Path, announce: Callable[[str, str], None]
    ) -> None:
        self._mapper, self._folder, self._announce = mapper, folder, announce
        self._saving = threading.Lock()  # the clock and two people may want to at the same time
        self._target: Path | None = None
        self._kept, self._failure = 0, ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="map keeper", daemon=True)

    @property
    def name(self) -> str:
        """The folder of the map that is being made, "" before it is first saved."""
        return "" if self._target is None else self._target.name

    def start(self) -> None:
        """Begin to save each minute; remove what an earlier program did not come to write whole."""
        for part in self._folder.glob(f"*/.{FILE}.*.part"):
            with suppress(OSError):
                part.unlink()
        self._thread.start()

    def stop(self) -> None:
        """End, and save what is not saved yet."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._try()

    def begin(self, going_on: GoingOn | None = None) -> None:
        """Save the present map, and begin a new one or go on with another one.

        A map that is gone on with is saved as a new one: the map that it was stays as it is.

        Raises
        ------
        ImpError
            If the present map cannot be saved, or the other one cannot be gone on with; the present
            map then goes on.
        """
        with self._saving:
            self._keep()
            self._mapper.start(going_on)
            self._target, self._kept = None, 0

    def hint(self, x: float, y: float) -> None:
        """Seek anew where the robot is in the map that is gone on with, about a place, m.

        What was mapped without being found in it is given up.

        Raises
        ------
        ImpError
            If no map is gone on with, or the robot is found in it already.
        """
        with self._saving:
            going_on, status = self._mapper.going_on, self._mapper.status()
            if status.placed:
                raise ImpError("the robot need not be sought; it is known where it is in the map")
            if going_on is None:
                raise ImpError("a hint is for a map that is gone on with; drive on, to be found")
            self._mapper.start(going_on.hinted(x, y))
            self._kept = 0

    def save(self) -> Path:
        """Write the map as it is now, with all files of a run, into its folder; mapping goes on.

        Raises
        ------
        ImpError
            If nothing is mapped yet, or a file cannot be written.
        """
        with self._saving:
            if self._mapper.status().frozen:
                raise ImpError("the robot is localised in a map that stays as it is; none is new")
            steps = self._mapper.status().steps
            folder = self._within(self._mapper.save)
            self._kept = steps
            return folder

    def _keep(self) -> None:
        """Save the map if there is more of it than on the disk."""
        status = self._mapper.status()
        if status.steps > self._kept and not status.frozen:
            self._within(self._mapper.save_map)
            self._kept = status.steps

    def _within(self, save: Callable[[Path], Path]) -> Path:
        """Save into the folder of this map, which is made if need be; an empty one does not stay."""
        if self._target is None:
            with written(self._folder, "check it"):
                self._target = make_folder(self._folder, time.strftime("map-%Y%m%d-%H%M%S"))
        try:
            save(self._target)
        except ImpError:
            if not (self._target / FILE).exists():  # half a map is none, and takes room
                shutil.rmtree(self._target, ignore_errors=True)
                self._target = None
            raise
        return self._target

    def _try(self) -> None:
        """Save if need be; a failure is told once, until it is another one."""
        failure = ""
        try:
            with self._saving:
                self._keep()
        except Exception as error:  # of the estimator, perhaps; the next minute is another try
            log.debug("the map is not saved", exc_info=True)
            failure = in_a_line(error)
        if failure and failure != self._failure:
            self._announce("error", f"the map is not saved: {failure}")
        self._failure = failure

    def _work(self) -> None:
        pause = PERIOD
        while not self._closing.wait(pause):
            begin = time.monotonic()
            self._try()
            pause = max(PERIOD, SHARE * (time.monotonic() - begin))
