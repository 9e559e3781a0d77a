"""Calibration against references: simulated robots, a published data set, squares with motion capture.

    python benchmarks/calibration.py simulated --runs 20
    python benchmarks/calibration.py published --data ../shared/data/calibration
    python benchmarks/calibration.py squares --data ../shared/data/optiodom/square
    python benchmarks/calibration.py arena

simulated: drives of several robots with scans; NEES, and standard deviations against the Cramér-Rao bound
of the lidar's motions with the true noise. published: Censi et al. 2013, three mounts of a laser, whole
logs and thirds. squares: UMBmark and least squares, with the truth of OptiTrack in place of a lidar.
arena: the return error of a square of 4 m after calibration.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from impslam.calibration.calibrate import calibrate, extract_drives  # noqa: E402  from the root
from impslam.calibration.closed_form import initial_estimate  # noqa: E402
from impslam.calibration.least_squares import Prior, solve  # noqa: E402
from impslam.calibration.noise import MATCHING, scan_covariances, unit_covariances  # noqa: E402
from impslam.calibration.odometry_models import DifferentialDrive, motion  # noqa: E402
from impslam.calibration.recording import record_batches  # noqa: E402
from impslam.calibration.residuals import LIDAR_PARAMETERS, CalibrationDrive, residuals  # noqa: E402
from impslam.calibration.scan_pairs import LidarMotions  # noqa: E402
from impslam.calibration.umbmark import corrected, umbmark  # noqa: E402
from impslam.columns import batches  # noqa: E402
from impslam.config import load  # noqa: E402
from impslam.geometry.se2 import between  # noqa: E402
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders  # noqa: E402
from impslam.simulation.simulate import simulate  # noqa: E402
from impslam.simulation.world import load_world  # noqa: E402
from impslam.types import Array  # noqa: E402

NAMES = (*DifferentialDrive.names, *LIDAR_PARAMETERS[:-1])
FINE = {"slip_sigma": 0.0, "skid_rate": 0.0, "radius_sigma": 0.0, "track_sigma": 0.0}
CLEAR = {"bias_sigma": 0.0}
ROBOTS = {
    "imp": ({}, {}),
    "small": (
        {"wheel_radius": 0.033, "track": 0.16, "noise": 5e-5},
        {"mount": (-0.05, 0.02, 3.0), "beams": 360, "angle_min": -3.14, "angle_step": 0.01745,
         "beam_time": 5e-4, "rate": 5.0},
    ),
    "large": (
        {"wheel_radius": 0.15, "track": 0.55, "rate": 20.0, "noise": 4e-5},
        {"mount": (0.3, -0.1, 0.5), "beams": 541, "angle_min": -2.356, "angle_step": 0.00873,
         "beam_time": 2e-5, "range_max": 20.0, "sigma": 0.01},
    ),
}  # fmt: skip


def simulated(runs: int) -> None:
    """Print errors relative to the estimated sigmas, and the sigmas relative to the bound."""
    for name, (wheels, lidar) in ROBOTS.items():
        robot = SimulatedRobot(
            encoders=WheelEncoders(**{**FINE, **wheels}),
            lidar=Lidar(**{**CLEAR, **lidar}),
            imu=None,
        )
        rows = [_one(robot, seed) for seed in range(runs)]
        errors, sigmas, bound, nees = (np.array(column) for column in zip(*rows, strict=True))
        print(f"{name}: {runs} drives, NEES {nees.mean():.2f} of {errors.shape[1]}")
        bounds = np.sqrt(np.mean(bound**2, axis=0))
        ratios = np.sqrt(np.mean(errors**2, axis=0)) / bounds
        for k, parameter in enumerate(NAMES):
            print(
                f"  {parameter:17} mean error {errors[:, k].mean():9.5f}  sigma {sigmas[:, k].mean():8.5f}"
                f"  bound {bounds[k]:8.5f}  rms/bound {ratios[k]:5.2f}"
                f"  sigma/bound {sigmas[:, k].mean() / bounds[k]:5.2f}"
            )


def _one(robot: SimulatedRobot, seed: int) -> tuple[Array, Array, Array, float]:
    """Return errors, sigmas and bounds, (8,) each, and the NEES of one drive in the arena."""
    config = load("imp", [f"sensors.lidar.mount={[0.9 * v for v in robot.lidar.mount]}",
                          f"sensors.lidar.range_max={robot.lidar.range_max}",
                          f"sensors.lidar.sigma={robot.lidar.sigma}",
                          f"odometry.wheel_radius={robot.encoders.wheel_radius * 1.02}",
                          f"odometry.track={robot.encoders.track * 1.05}"])  # fmt: skip
    messages = simulate(load_world("arena"), robot, seed)
    recorded = record_batches(config, batches((type(m).__name__, m) for m in messages))
    drives = extract_drives(config, recorded, "simulated")
    found = calibrate(config, drives)
    true = np.array(
        [robot.encoders.wheel_radius, 1.0, robot.encoders.track, *robot.lidar.mount, 0, 0, 1]
    )
    free = np.arange(9) < 8
    error = (found.solution.parameters - true)[free]
    error[5] = (error[5] + np.pi) % (2 * np.pi) - np.pi
    P = found.solution.covariance[np.ix_(free, free)]
    return (
        error,
        np.sqrt(np.diag(P)),
        bound_of(drives, true, robot.encoders.noise),
        float(error @ np.linalg.solve(P, error)),
    )


def bound_of(drives: list[CalibrationDrive], true: Array, noise: float) -> Array:
    """Return the Cramér-Rao bound (8,) for the lidar's motions, with the scans' own covariances."""
    H = np.zeros((8, 8))
    for drive in drives:
        S = scan_covariances(drive) + noise * unit_covariances(drive, true)[len(MATCHING)]
        J = residuals(drive, true).by_all[..., :8]
        H += np.einsum("kim,kij,kjn->mn", J, np.linalg.inv(S), J)
    return np.sqrt(np.diag(np.linalg.inv(H)))


# ------------------------------------------------------------------ published


def published(data: Path) -> None:
    """Print the results for each mount with the published ones, for whole logs and thirds."""
    names = ("l diameter", "r diameter", "axle", "x", "y", "yaw")
    for mount in ("lstraight", "l90", "lmov"):
        result = data / f"{mount}_results.json"
        if not result.is_file():
            continue
        theirs = reference(result)
        found, sigmas = of_tuples(data / f"{mount}.tuple")
        parts = [of_tuples(part)[0] for part in sorted(data.glob(f"{mount}_?.tuple"))]
        others = [reference(part) for part in sorted(data.glob(f"{mount}_?_results.json"))]
        print(f"{mount}: {len(parts)} thirds")
        for k, name in enumerate(names):
            spread = np.std([part[k] for part in parts], ddof=1) if len(parts) > 1 else np.nan
            spread_theirs = (
                np.std([part[k] for part in others], ddof=1) if len(others) > 1 else np.nan
            )
            print(
                f"  {name:10} found {found[k]:9.5f} +- {sigmas[k]:.5f} (thirds {spread:.5f})"
                f"  published {theirs[k]:9.5f} (thirds {spread_theirs:.5f})"
                f"  difference {found[k] - theirs[k]:9.5f}"
            )


def reference(file: Path) -> Array:
    values = json.loads(file.read_text())
    return np.array([values[key] for key in ("l_diam", "r_diam", "axle", "l_x", "l_y", "l_theta")])


def _tuples(file: Path) -> Iterator[tuple[float, float, float, list[float]]]:
    text, start, decoder = file.read_text(), 0, json.JSONDecoder()
    while (start := text.find("{", start)) >= 0:
        one, start = decoder.raw_decode(text, start)
        yield one["T"], one["phi_l"], one["phi_r"], one["sm"]


def of_tuples(file: Path) -> tuple[Array, Array]:
    """Return left and right diameter, axle, x, y, yaw, and their standard deviations."""
    seconds, left, right, moved = (np.array(column) for column in zip(*_tuples(file), strict=True))
    stamps = np.concatenate(([0.0], np.cumsum(seconds)))
    model = DifferentialDrive(stamps, np.zeros(len(left), bool), left * seconds, right * seconds)
    drive = CalibrationDrive(model, exact_motions(stamps[:-1], stamps[1:], moved))
    start = np.array([0.04, 1.0, 0.09, 0, 0, 0, 0, 0, 1.0])
    first = initial_estimate([drive], 0.0)
    assert first is not None
    first[6] = 0.0
    free = np.arange(9) < 6
    wide = Prior(start, np.array([0.1, 1.0, 1.0, 1.0, 1.0, 10.0, 1.0, 1.0, 1.0]))
    found = solve([drive], first, free, wide)
    values, sigmas = found.parameters, np.sqrt(np.diag(found.covariance))
    J = np.array([values[1], values[0]])  # of the right radius, by the left one and the ratio
    right_sigma = float(np.sqrt(J @ found.covariance[:2, :2] @ J))
    diameters = (2.0 * values[0], 2.0 * values[0] * values[1])
    return (
        np.array([*diameters, *values[2:6]]),
        np.array([2.0 * sigmas[0], 2.0 * right_sigma, *sigmas[2:6]]),
    )


def exact_motions(begins: Array, ends: Array, moved: Array) -> LidarMotions:
    """Return motions (k, 3) with negligible errors; the noise is estimated from the data."""
    joint, one = np.column_stack((moved, np.zeros(len(moved)))), np.ones(len(moved))
    information = np.tile(np.diag([1e8, 1e8, 1e8, 1e8]), (len(moved), 1, 1))
    return LidarMotions(begins, ends, moved, joint, information, one, one)


# ------------------------------------------------------------------ squares


def squares(data: Path) -> None:
    """Print the mean return error of squares: nominal, by UMBmark, by least squares."""
    for folder in sorted(path for path in data.iterdir() if path.is_dir()):
        runs = sorted(folder.glob("*_run-*.csv"))
        facts = {row[0]: row[1:] for row in _rows(next(folder.glob("*_metadata.csv")))}
        track, radius = float(facts["Li"][0]), float(facts["Di"][0]) / 2.0
        per_turn, side = float(facts["ngear"][0]) * float(facts["encRes"][0]), float(facts["L"][0])
        values = np.array([radius, 1.0, track])
        logs = [_square(run, per_turn) for run in runs]
        half = len(logs) // 2
        found = umbmark(
            np.array([_return(log, values) for log in logs[:half]]),
            np.array([_return(log, values) for log in logs[half:]]), side, track,
        )  # fmt: skip
        chosen = {
            "nominal": values,
            "UMBmark": corrected(found, values),
            "least squares": _fit(logs, values),
        }
        print(f"{folder.name}: {len(logs)} squares of {side} m")
        for name, of in chosen.items():
            ends = np.array([_return(log, of) for log in logs])
            worst = max(np.hypot(*ends[:half].mean(0)), np.hypot(*ends[half:].mean(0)))
            rms = np.sqrt(np.mean(np.sum(ends**2, axis=1)))
            print(
                f"  {name:14} radius {of[0]:.5f} ratio {of[1]:.5f} track {of[2]:.5f}"
                f"  E_max,syst {1000 * worst:6.1f} mm  rms {1000 * rms:6.1f} mm"
            )


def _rows(file: Path) -> list[list[str]]:
    return [line.split(",") for line in file.read_text("utf-8-sig").splitlines() if line]


def _square(file: Path, per_turn: float) -> tuple[DifferentialDrive, Array]:
    """Return the wheels of a run, and (n, 4) stamps and true poses."""
    table = np.array([[float(cell) for cell in row] for row in _rows(file)])
    turned = 2.0 * np.pi / per_turn * table[1:, [5, 4]]
    model = DifferentialDrive(table[:, 0], np.zeros(len(turned), bool), *turned.T.copy())
    return model, table[:, :4]


def _return(log: tuple[DifferentialDrive, Array], values: Array) -> Array:
    """Return the end position of a run, true minus odometry, (2,) m in the frame of the start."""
    model, truth = log
    odometry = motion(model, values, 0.0, model.stamps[:1], model.stamps[-1:])
    true = between(truth[0, 1:], truth[-1, 1:])
    return true[:2] - [odometry.translation[0].real, odometry.translation[0].imag]


def _fit(logs: list[tuple[DifferentialDrive, Array]], values: Array) -> Array:
    """Return the wheels that fit the true motions over 4 s best."""
    drives = []
    for model, truth in logs:
        begins = np.arange(20, len(truth) - 101, 81)
        moved = between(truth[begins, 1:], truth[begins + 80, 1:])
        drives.append(
            CalibrationDrive(model, exact_motions(truth[begins, 0], truth[begins + 80, 0], moved))
        )
    start = np.array([*values, 0, 0, 0, 0, 0, 1.0])
    wide = Prior(start, np.array([0.1, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]))
    return solve(drives, start, np.arange(9) < 7, wide).parameters[:3]


# ------------------------------------------------------------------ arena

SQUARE = ((0.0, 1.0), (-1.0, 1.0), (-1.0, 0.0), (-0.02, 0.0))


def arena() -> None:
    """Print the return error of a square of 4 m by the encoders, as configured and calibrated."""
    faults = {"slip_sigma": 0.0, "skid_rate": 0.0, "radius_sigma": 0.01, "track_sigma": 0.03}
    config = load("imp")
    for noise in (0.0, 1e-4):
        off: dict[str, list[float]] = {"config": [], "calibrated": []}
        for seed in range(5):
            robot = SimulatedRobot(encoders=WheelEncoders(**faults, noise=noise), imu=None)
            found = calibrate(config, _arena_drive(config, robot, seed, None))
            (square,) = _arena_drive(config, robot, seed, SQUARE)
            truth = square.truth
            for name, values in (
                ("config", np.array([0.0635, 1.0, 0.4])),
                ("calibrated", found.solution.parameters[:3]),
            ):
                odometry = motion(square.model, values, 0.0, truth[:1, 0], truth[-1:, 0])
                true = between(truth[0, 1:], truth[-1, 1:])
                off[name].append(abs(odometry.translation[0] - complex(true[0], true[1])))
        for name, errors in off.items():
            mm = ", ".join(f"{1000 * e:.1f}" for e in errors)
            print(f"wheel noise {np.sqrt(noise):.2f} m/sqrt(m), {name:10}: return off by {mm} mm")


def _arena_drive(config, robot, seed, waypoints):
    """Return the drives of a robot in the arena: on its usual path, or on another one with the truth."""
    world = load_world("arena")
    if waypoints is not None:
        plan = world.robot.model_copy(update={"waypoints": waypoints, "lookahead": 0.15})
        world = world.model_copy(update={"robot": plan})
    messages = simulate(world, robot, seed)
    recorded = record_batches(config, batches((type(m).__name__, m) for m in messages))
    drives = extract_drives(config, recorded, "arena")
    return drives if waypoints is None else [_WithTruth(drives[0].model, recorded.truth)]


class _WithTruth:
    """Odometry and the truth (n, 4)."""

    def __init__(self, model: DifferentialDrive, truth: Array) -> None:
        self.model, self.truth = model, truth


def main() -> None:
    """Run one of the studies."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("study", choices=("simulated", "published", "squares", "arena"))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--data", type=Path)
    arguments = parser.parse_args()
    data = ROOT.parent / "shared" / "data"
    if arguments.study == "simulated":
        simulated(arguments.runs)
    elif arguments.study == "published":
        published(arguments.data or data / "calibration")
    elif arguments.study == "squares":
        squares(arguments.data or data / "optiodom" / "square")
    else:
        arena()


if __name__ == "__main__":
    main()
