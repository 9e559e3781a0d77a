"""Compile the kernels of the estimator before the first scan, in a process of their own.

Numba compiles a kernel at its first call: on a fresh machine, this takes a minute or two in total,
mostly with Python's global lock held, and would stall devices and drive control repeatedly for tenths of a
second. So a low-priority process maps a simulated drive with the same config; this process then loads
the compiled kernels from the disk in less than a second.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from impslam.columns import single_row
from impslam.config import Config, load
from impslam.continuing import KnownMap
from impslam.observers.summary import config_toml
from impslam.open_log import for_continuing
from impslam.run import Run
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Message, OdometryPose, Steering, TruePose, Velocity

log = logging.getLogger(__name__)

WORLD = "arena"
SCANS = 100  # enough for landmarks to be created, matched and removed
SCANS_TO_LOCATE = 200  # 20 s; a place is searched for once the robot has driven 3 m, after 12 s
COMPILE_TIMEOUT = 600.0  # s for the process; three times what a slow computer needs
NICENESS = 10
ENDS = (-signal.SIGINT, -signal.SIGTERM)
"""Exit codes of a process that was not meant to go on: these signals end this process, too."""

_done: set[str] = set()
_lock = threading.Lock()


def warm_up(config: Config) -> None:
    """Compile the estimator of a config, unless this process has already done so."""
    table = config_toml(config.resolved())
    with _lock:
        if table in _done:
            return
        _compile_in_subprocess(table)
        rehearse(config, SCANS)  # kernels of loop closure load from the disk in less than 0.1 s
        _done.add(table)


def rehearse(config: Config, scans: float = math.inf) -> None:
    """Map the first scans of a simulated drive, or all, and refine the map.

    The end of the drive closes loops, if the estimator does. After all, the robot is located in that map,
    if the estimator can continue one. So all kernels are called.
    """
    run = Run(config)
    _drive(run, scans)
    known = run.refined()
    known.grid()
    if math.isinf(scans) and for_continuing(config) is config:
        _drive(Run(config, begin=KnownMap(known, frozen=True)), SCANS_TO_LOCATE)


def _drive(run: Run, scans: float) -> None:
    """Feed the first scans of a simulated drive."""
    kind = run.robot.odometry.consumes
    for order, message in enumerate(simulate(load_world(WORLD))):
        sent = _as_odometry(message, kind)
        run.feed(single_row(type(sent).__name__, sent, order))
        if run.scans >= scans:
            break


def _as_odometry(message: Message, kind: type) -> Message:
    """Return a true pose as a message of an odometry type; other messages unchanged."""
    if isinstance(message, TruePose):
        if kind is OdometryPose:
            return OdometryPose(message.stamp, message.pose)
        if kind is Velocity:
            return Velocity(message.stamp, 0.1, 0.0)
        if kind is Steering:
            return Steering(message.stamp, 0.1, 0.0)
    return message


def _compile_in_subprocess(table: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.toml"
        path.write_text(table, encoding="utf-8")
        command = [sys.executable, "-m", "impslam.platform.station.warm_up", str(path)]
        try:
            run_until_either_ends(command)
        except (OSError, subprocess.SubprocessError) as error:
            if getattr(error, "returncode", 0) not in ENDS:
                log.warning("compiling in a subprocess failed (%s); compiling in place", error)


def run_until_either_ends(command: list[str]) -> None:
    """Run a command that calls `end_with_parent`: the end of this process closes its stdin."""
    none = subprocess.DEVNULL
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=none, stderr=none) as process:  # noqa: S603  ours
        try:
            code = process.wait(COMPILE_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
    if code:
        raise subprocess.CalledProcessError(code, command)


def end_with_parent() -> None:
    """End this process once its stdin is closed."""

    def wait() -> None:
        while os.read(0, 1024):  # sys.stdin would be locked, and Python would abort at its end
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    end_with_parent()
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    rehearse(load(sys.argv[1]))
