"""CPU seconds of each command, from its start to its end.

    python benchmarks/startup.py --repetitions 5 --data ../shared/data

User and system time of the process, the median of several, after one that compiles. The helps measure only
imports; the log has 27 scans of a lidar with 180 beams in a room, so that its run is mostly start-up. With
a folder of the public logs, whole logs are mapped as well, and Intel by dead reckoning alone, without
keyframes: what is neither start-up nor estimation is then given for a scan. Only the environment variables
needed to find the program are set.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import statistics
import subprocess
import tempfile
from pathlib import Path

from impslam.cli.commands import COMMANDS

SCANS, WIDTH, LENGTH = 27, 6.0, 8.0
KEPT = ("PATH", "PYTHONPATH", "HOME")
ROOM = ["run", "room.log", "-o", "run", "--force"]
LOGS = (
    "intel/intel.log",
    "fr079/fr079.log",
    "urg04lx-encoders/exp1.dat",
    "fr-hospital/fr-hospital.log",
)
INTEL_SCANS = 13631
DEAD = [
    "tracker.kind=odometry",
    *(f"keyframes.{limit}=inf" for limit in ("distance", "angle", "seconds")),
]


def write_log(path: Path) -> None:
    """Write a CARMEN log of a robot that drives 2.6 m through a rectangular room."""
    with path.open("w") as log:
        for i in range(SCANS):
            x, stamp = 0.1 * i, 0.2 * i
            ranges = " ".join(f"{_range(x, math.radians(a - 90.0)):.3f}" for a in range(180))
            pose, tail = f"{x} 0.0 0.0", f"{stamp} host {stamp}"
            log.write(f"ODOM {pose} 0.5 0.0 0.0 {tail}\n")
            log.write(f"FLASER 180 {ranges} {pose} {pose} {tail}\n")


def _range(x: float, angle: float) -> float:
    """Return the range along a beam from (x, 0) to the walls of the room about the origin."""
    c, s = math.cos(angle), abs(math.sin(angle))
    ahead = (LENGTH - x) / c if c > 1e-9 else math.inf
    return min(ahead, 0.5 * WIDTH / s if s > 1e-9 else math.inf)


def cpu(words: list[str], folder: Path) -> float:
    """Return user and system seconds of `imp WORDS`."""
    program = shutil.which("imp")
    assert program is not None, "impslam is not installed here"
    environment = {name: os.environ[name] for name in KEPT if name in os.environ}
    with subprocess.Popen(
        [program, *words], cwd=folder, env=environment, stdout=subprocess.DEVNULL
    ) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, words
    return used.ru_utime + used.ru_stime


def show(words: list[str], folder: Path, repetitions: int) -> float:
    """Print the median of a command's CPU seconds, and return it."""
    cpu(words, folder)
    seconds = [cpu(words, folder) for _ in range(repetitions)]
    median = statistics.median(seconds)
    print(f"{median:6.2f} s  imp {' '.join(words)}   (least {min(seconds):.2f})", flush=True)
    return median


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--data", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_log(folder / "room.log")
        helps = [["--help"], *([command, "--help"] for command in COMMANDS)]
        for words in (*helps, ["list"], ["config"], ["inspect", "room.log"]):
            show(words, folder, asked.repetitions)
        start = show(ROOM, folder, asked.repetitions)
        if asked.data is None:
            return
        run = ["-o", "run", "--force", "--quiet"]
        for log in LOGS:
            show(["run", str(asked.data.resolve() / log), *run], folder, asked.repetitions)
        settings = [word for setting in DEAD for word in ("--set", setting)]
        intel = ["run", str(asked.data.resolve() / LOGS[0]), *run, *settings]
        spent = show(intel, folder, asked.repetitions) - start
        print(f"{1e6 * spent / INTEL_SCANS:6.0f} us a scan, from reading to all files written")


if __name__ == "__main__":
    main()
