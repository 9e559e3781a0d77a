"""CPU seconds of each command, from its start to its end.

    python benchmarks/startup.py [REPETITIONS]

User and system time of the process, the median of several, after one that compiles. The helps measure only
imports; the log has 27 scans of a lidar with 180 beams in a room, so that its run is mostly start-up. Only
the environment variables needed to find the program are set.
"""

from __future__ import annotations

import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from impslam.cli.commands import COMMANDS

SCANS, WIDTH, LENGTH = 27, 6.0, 8.0
KEPT = ("PATH", "PYTHONPATH", "HOME")


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


def main() -> None:
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_log(folder / "room.log")
        helps = [["--help"], *([command, "--help"] for command in COMMANDS)]
        runs = [["list"], ["config"], ["inspect", "room.log"]]
        runs += [["run", "room.log", "-o", "run", "--force"]]
        for words in (*helps, *runs):
            cpu(words, folder)
            seconds = [cpu(words, folder) for _ in range(repetitions)]
            line = f"{statistics.median(seconds):6.2f} s  imp {' '.join(words)}"
            print(line, f"  (least {min(seconds):.2f})", flush=True)


if __name__ == "__main__":
    main()
