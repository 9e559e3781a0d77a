"""Positions of the laser and the GPS antenna on the car of the outdoor logs, and errors of its steering.

    python benchmarks/outdoor_calibration.py --data ../shared/data

Values in the presets use neither survey nor GPS. Landmarks observed from two positions some 1.5 s apart
give the motion of the laser, odometry gives that of the axle; the position of the laser ahead of the axle
and left of it, its yaw, its latency and the steering's offset and scale are fitted to both. The position
of the antenna is only used for scoring: in turns of 12 s the fixes are fitted to the path, with the
antenna's position as a parameter.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares, minimize

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from impslam.columns import Motions, Sweeps, messages, single_row  # noqa: E402  from the root
from impslam.evaluation.trajectory import interpolate  # noqa: E402
from impslam.extractors.reflector import Reflector  # noqa: E402
from impslam.geometry.se2 import between, rotation  # noqa: E402
from impslam.odometry.ackermann import Ackermann  # noqa: E402
from impslam.robot import Robot  # noqa: E402
from impslam.sensors.lidar2d import Lidar2D  # noqa: E402
from impslam.sensors.range_bearing import RangeBearing  # noqa: E402
from impslam.sources.base import recognise  # noqa: E402
from impslam.types import Array, Steering, TruePose  # noqa: E402

WHEELBASE, ENCODER_OFFSET = 2.83, 0.76  # m, by the ruler
NAMES = ("steering_offset", "steering_scale", "laser x", "laser y", "laser yaw", "latency")
RULER = np.array([0.0, 1.0, 3.78, 0.5, 0.0, 0.0])
SCAN_GAP = 7  # scans between the two of a pair, 1.5 s
GATE = 2.0  # m between a landmark and its observation
PAIR_SCALE = 0.1  # m, scale of the robust loss: a pair may be of two landmarks
WINDOW, MIN_TURN = 12.0, np.radians(30.0)  # s and rad, of stretches used for the antenna
FIX_SCALE = 0.15  # m, scale of the robust loss of fixes


@dataclass(frozen=True, eq=False)
class Log:
    """Odometry (n, 3), observations (stamps, and points in the laser's frame) and fixes (m, 3)."""

    wheels: Array
    stamps: Array
    sights: list[Array]
    fixes: Array


def read(log: Path) -> Log:
    """Read a log once."""
    rng = np.random.default_rng(0)
    lidar = Lidar2D(range_max=80.0, deskew=False, extractors={"beacons": Reflector()})
    car = Robot("car", Ackermann(wheelbase=WHEELBASE), {"lidar": lidar, "sick": RangeBearing()})
    wheels, stamps, sights, fixes = [], [], [], []

    def see(sensed: Iterable[tuple[Motions, Sweeps]]) -> None:
        for _, sweeps in sensed:
            stamps.extend(sweeps.columns.stamps.tolist())
            for k in range(len(sweeps)):
                seen = car.observe(sweeps, k, rng)
                sights.append(np.array([o.z for o in seen]).reshape(-1, 2))

    with recognise(log)(path=log) as source:
        for place, m in enumerate(messages(source.batches())):
            if isinstance(m, Steering):
                wheels.append((m.stamp, m.speed, m.angle))
            elif isinstance(m, TruePose):
                fixes.append((m.stamp, *m.pose[:2]))
            else:
                see(car.sense(single_row(type(m).__name__, m, place)))
    see(car.flush())
    return Log(np.array(wheels), np.array(stamps), sights, np.array(fixes))


def axle_path(wheels: Array, offset: float, scale: float) -> Array:
    """Return (n, 4) stamps and poses of the axle by dead reckoning."""
    t, speed, angle = wheels.T
    curvature = np.tan(scale * angle + offset)[:-1] / WHEELBASE
    way = speed[:-1] * np.diff(t) / (1.0 - ENCODER_OFFSET * curvature)
    heading = np.concatenate(([0.0], np.cumsum(way * curvature)))
    middle = 0.5 * (heading[1:] + heading[:-1])
    x, y = (np.concatenate(([0.0], np.cumsum(way * f(middle)))) for f in (np.cos, np.sin))
    return np.column_stack((t, x, y, heading))


def placed(poses: Array, points: Array) -> Array:
    """Return points (n, 2), each given in a pose's (n, 3) own frame, in map."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = points.T
    return poses[:, :2] + np.column_stack((c * x - s * y, s * x + c * y))


def pairs(log: Log) -> tuple[Array, Array, Array, Array]:
    """Return scans i and j (p,), and the same landmarks as each shows them (p, 2), twice."""
    poses = interpolate(axle_path(log.wheels, *RULER[:2]), log.stamps)
    found = []
    for i in range(len(log.stamps) - SCAN_GAP):
        j = i + SCAN_GAP
        before, after = log.sights[i], log.sights[j]
        if len(before) == 0 or len(after) == 0 or np.allclose(poses[i], poses[j], atol=0.05):
            continue  # the car is stationary
        one, two = (
            placed(np.tile(poses[k], (len(z), 1)), z + RULER[2:4])
            for k, z in ((i, before), (j, after))
        )
        apart = np.hypot(*(one[:, None] - two).T).T
        nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
        for a, b in enumerate(nearest):
            if apart[a, b] < GATE and back[b] == a:
                found.append((i, j, *before[a], *after[b]))
    table = np.array(found)
    return table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:4], table[:, 4:]


def calibrate(log: Log) -> tuple[Array, Array, int]:
    """Return the constants of NAMES, their standard deviations, and the number of pairs used."""
    i, j, before, after = pairs(log)

    def misfit(constants: Array) -> Array:
        offset, scale, x, y, yaw, latency = constants
        poses = interpolate(axle_path(log.wheels, offset, scale), log.stamps - latency)
        turn = rotation(yaw).T
        one, two = before @ turn + [x, y], after @ turn + [x, y]
        moved = between(poses[i], poses[j])
        return ((placed(moved, two) - one) / PAIR_SCALE).ravel()

    best = least_squares(misfit, RULER, loss="cauchy")
    sigmas = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    return best.x, sigmas, len(i)


def antenna(log: Log, constants: Array) -> tuple[Array, int]:
    """Return the position of the antenna relative to the axle (m, m), and the number of turns used."""
    path = axle_path(log.wheels, *constants[:2])
    poses = interpolate(path, log.fixes[:, 0])
    headings = np.interp(log.fixes[:, 0], path[:, 0], path[:, 3])
    numbers = ((log.fixes[:, 0] - log.fixes[0, 0]) // WINDOW).astype(int)
    windows = [np.flatnonzero(numbers == n) for n in range(numbers.max() + 1)]
    turns = [w for w in windows if len(w) > 20 and np.ptp(headings[w]) > MIN_TURN]

    def misfit(place: Array) -> float:
        at = placed(poses, np.tile(place, (len(poses), 1)))
        off = np.concatenate([_off(at[w], log.fixes[w, 1:]) for w in turns])
        return float(np.log1p((off / FIX_SCALE) ** 2).mean())

    best: Array = minimize(misfit, RULER[2:4], method="Nelder-Mead").x
    return best, len(turns)


def _off(points: Array, fixes: Array) -> Array:
    """Return the distances of points (n, 2) from fixes after the motion of least absolute distance."""
    weights = np.ones(len(points))
    for _ in range(10):
        weights /= weights.sum()
        p, q = points - weights @ points, fixes - weights @ fixes
        cross = weights @ (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
        turn = np.arctan2(cross, weights @ np.sum(p * q, axis=1))
        off: Array = np.hypot(*(p @ rotation(float(turn)).T - q).T)
        weights = 1.0 / np.maximum(off, 0.03)
    return off


def main() -> None:
    """Print the constants of the car estimated from each log."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    arguments = parser.parse_args()
    show: Callable[[float], str] = "{:.4f}".format
    for name in ("carpark", "victoria-park"):
        log = read(arguments.data / name)
        constants, sigmas, count = calibrate(log)
        place, turns = antenna(log, constants)
        said = [
            f"{n} {show(c)} ± {show(s)}" for n, c, s in zip(NAMES, constants, sigmas, strict=True)
        ]
        print(f"{name}: {', '.join(said)} (from {count} pairs)")
        print(f"  antenna {place[0]:.2f}, {place[1]:.2f} m from the axle (from {turns} turns)")


if __name__ == "__main__":
    main()
