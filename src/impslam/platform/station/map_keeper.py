"""Saves the live map: every minute, at the end, and on request."""

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
from impslam.platform.station.continued_map import ContinuedMap
from impslam.platform.station.map_store import FILE
from impslam.platform.station.mapper import LiveMap, LiveMapper

log = logging.getLogger(__name__)

SAVE_INTERVAL = 60.0  # s of map that a power failure may cost
MIN_PAUSE_RATIO = 20
"""Smallest ratio of the pause before the next save to the time that the last one took: saving uses at
most a twentieth of the time."""


class MapKeeper:
    """Saves the maps of a mapper, each into its own folder.

    A file on the disk is replaced atomically, so that a power failure leaves the old or the new one. If a
    save fails, all earlier files stay.

    Parameters
    ----------
    mapper : makes the map
    folder : where maps are kept; created if necessary
    notify : called with a level and a line if a map cannot be saved
    """

    def __init__(
        self, mapper: LiveMapper, folder: Path, notify: Callable[[str, str], None]
    ) -> None:
        self._mapper, self._folder, self._notify = mapper, folder, notify
        self._saving = threading.Lock()  # the thread and several users may save at the same time
        self._target: Path | None = None
        self._saved_steps, self._failure = 0, ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map keeper", daemon=True)

    @property
    def name(self) -> str:
        """The folder name of the map that is being made, "" before it is first saved, or if none is."""
        target = self._target
        return target.name if target is not None and self._mapper.status().on else ""

    @property
    def folder(self) -> Path | None:
        """The folder of the present map, also of an ended one; None if it is not saved, or deleted."""
        return self._target

    def forget(self, name: str) -> None:
        """Save the present map to another folder from now on, if it was saved to the one deleted."""
        with self._saving:
            if self._target is not None and self._target.name == name:
                self._target = None

    def start(self) -> None:
        """Start to save every minute; remove partial files and folders that an earlier program left."""
        for part in self._folder.glob("*/.*.part"):
            if part.is_dir():
                shutil.rmtree(part, ignore_errors=True)
            with suppress(OSError):
                part.unlink()
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and save what is not saved yet."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._try_to_save()

    def begin(self, continued: ContinuedMap | None = None) -> None:
        """Save the present map, and begin a new one or continue another one.

        A continued map is saved as a new one; the original stays as it is. Mapping goes on during the
        save, which takes seconds for a large map. What has come since is saved after the other map has
        begun, so that the robot is tracked all the time.

        Raises
        ------
        ImpError
            If the present map cannot be saved, or the other one cannot be continued; mapping of the
            present map then goes on.
        """
        with self._saving:
            self._save_if_new()
            ended = self._mapper.start(continued)
            target, saved_steps = self._target, self._saved_steps
            self._target, self._saved_steps = None, 0
            if ended is not None and target is not None:
                self._save_rest(ended, target, saved_steps)

    def end(self) -> None:
        """End mapping, and save the map. It can still be saved with all files, and be continued.

        Raises
        ------
        ImpError
            If the map cannot be saved; it is tried again every minute.
        """
        with self._saving:
            self._mapper.stop()
            self._save_if_new()

    def hint(self, x: float, y: float) -> None:
        """Restart the search for the robot in the continued map, near a position, m.

        What was mapped before the robot was located is discarded.

        Raises
        ------
        ImpError
            If no map is continued, or the robot is already located in it, or mapping has ended.
        """
        with self._saving:
            status = self._mapper.status()
            if not status.on:
                raise ImpError("a hint is not needed; mapping has ended")
            if status.placed:
                raise ImpError("a hint is not needed; the robot is already located in the map")
            continued = self._mapper.continued
            if continued is None:
                raise ImpError("a hint needs a continued map; drive on until the robot is located")
            self._mapper.start(continued.with_hint(x, y))
            self._saved_steps = 0

    def save(self) -> Path:
        """Write the present map and all other files of a run into its folder; mapping goes on.

        Raises
        ------
        ImpError
            If nothing is mapped yet, the map is frozen, or a file cannot be written.
        """
        with self._saving:
            if self._mapper.status().frozen:
                raise ImpError("the robot is localised in a frozen map; there is nothing to save")
            steps = self._mapper.status().steps
            folder = self._save_into(self._mapper.save)
            self._saved_steps = steps
            return folder

    def _save_rest(self, ended: LiveMap, folder: Path, saved_steps: int) -> None:
        """Save an ended map again if it has grown since its last save."""
        ended.wait()
        try:
            if ended.status().steps > saved_steps:
                ended.save(folder)
        except Exception as error:  # maybe a bug of the estimator; the other map has begun
            log.debug("the end of a map is not saved", exc_info=True)
            text = f"{folder.name}: the last scans are not saved: {in_a_line(error)}"
            self._notify("error", text)

    def _save_if_new(self) -> None:
        """Save the map if it has grown since the last save."""
        status = self._mapper.status()
        if status.steps > self._saved_steps and not status.frozen:
            self._save_into(self._mapper.save_map)
            self._saved_steps = status.steps

    def _save_into(self, save: Callable[[Path], Path]) -> Path:
        """Save into the folder of this map; create it if necessary, and remove it if it stays empty."""
        if self._target is None:
            with written(self._folder, "check it"):
                self._target = make_folder(self._folder, time.strftime("map-%Y%m%d-%H%M%S"))
        try:
            save(self._target)
        except ImpError:
            if not (self._target / FILE).exists():  # a partial map is useless and takes space
                shutil.rmtree(self._target, ignore_errors=True)
                self._target = None
            raise
        return self._target

    def _try_to_save(self) -> None:
        """Save if necessary; report a failure once, until it changes."""
        failure = ""
        try:
            with self._saving:
                self._save_if_new()
        except Exception as error:  # maybe a bug of the estimator; retried a minute later
            log.debug("the map is not saved", exc_info=True)
            failure = in_a_line(error)
        if failure and failure != self._failure:
            self._notify("error", f"the map is not saved: {failure}")
        self._failure = failure

    def _run(self) -> None:
        pause = SAVE_INTERVAL
        while not self._closing.wait(pause):
            begin = time.monotonic()
            self._try_to_save()
            pause = max(SAVE_INTERVAL, MIN_PAUSE_RATIO * (time.monotonic() - begin))
