"""Compiles what the estimator needs before the first scan, without holding up the rest.

Numba compiles a kernel when it is first called: on a fresh machine a minute or two, mostly with
Python's global lock held, in which devices and the helm would stall for tenths of a second again and
again. So a process of its own, at low priority, maps a simulated drive with the same config; what it
compiles stays on the disk, from where this process then loads it in less than a second.
"""

from __future__ import annotations

import logging
import math
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from impslam.columns import single_row
from impslam.config import Config, load
from impslam.observers.summary import config_toml
from impslam.run import Run
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Message, OdometryPose, Steering, TruePose, Velocity

log = logging.getLogger(__name__)

WORLD = "arena"
SCANS = 100  # by then landmarks have come, been matched and gone
PATIENCE = 600.0  # s for the process; the slowest computer that is worth a try needs a third
NICENESS = 10

_done: set[str] = set()
_lock = threading.Lock()


def warm_up(config: Config) -> None:
    """Return once the estimator of a config is compiled; at once if this process has done so."""
    table = config_toml(config.resolved())
    with _lock:
        if table in _done:
            return
        _compile_apart(table)
        rehearse(config, SCANS)  # the kernels of loops load from the disk in less than 0.1 s
        _done.add(table)


def rehearse(config: Config, scans: float = math.inf) -> None:
    """Map a simulated drive, or its beginning.

    Its end closes loops, where the estimator does, and the map is settled: all kernels are called.
    """
    run = Run(config)
    kind = run.robot.odometry.consumes
    for order, message in enumerate(simulate(load_world(WORLD))):
        told = _as_odometry(message, kind)
        run.feed(single_row(type(told).__name__, told, order))
        if run.scans >= scans:
            break
    run.settled().grid()


def _as_odometry(message: Message, kind: type) -> Message:
    """Return a true pose as the odometry of a kind would tell it; other messages as they are."""
    if isinstance(message, TruePose):
        if kind is OdometryPose:
            return OdometryPose(message.stamp, message.pose)
        if kind is Velocity:
            return Velocity(message.stamp, 0.1, 0.0)
        if kind is Steering:
            return Steering(message.stamp, 0.1, 0.0)
    return message


def _compile_apart(table: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.toml"
        path.write_text(table, encoding="utf-8")
        command = [sys.executable, "-m", "impslam.platform.station.warm_up", str(path)]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE)  # noqa: S603  ours
        except (OSError, subprocess.SubprocessError) as error:
            log.warning("compiling apart failed (%s); it is done in place", error)


if __name__ == "__main__":
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    rehearse(load(sys.argv[1]))
