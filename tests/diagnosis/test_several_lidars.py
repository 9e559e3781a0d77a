"""Diagnosis of a robot with two lidars: each fault is found, with the name of the lidar that has it."""

import math

import pytest
from tests import log_faults as faults

from impslam.columns import Batch, batches
from impslam.config import load
from impslam.diagnosis.diagnose import diagnose
from impslam.simulation.robot import Lidar, SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import Imu, LaserScan

MOUNTS = {"front": (0.15, 0.0, 0.0), "rear": (-0.15, 0.0, math.pi)}
SETTINGS = (
    "tracker.kind=scan_to_map",
    "estimator.kind=graph",
    "sensors.lidar.kind=none",
    *(f"sensors.{name}.kind=lidar2d" for name in MOUNTS),
    *(f"sensors.{name}.stream={name}" for name in MOUNTS),
    *(f"sensors.{name}.mount={list(mount)}" for name, mount in MOUNTS.items()),
)


@pytest.fixture(scope="module")
def drive() -> list[Batch]:
    """Return a drive through the arena without a gyro."""
    rows, world = [], load_world("arena")
    for name, mount in MOUNTS.items():
        for m in simulate(world, SimulatedRobot(lidar=Lidar(mount=mount)), seed=3):
            if isinstance(m, LaserScan):
                rows.append((name, m))
            elif name == "front" and not isinstance(m, Imu):
                rows.append((type(m).__name__, m))
    return list(batches(sorted(rows, key=lambda row: row[1].stamp)))


def found(drive, *settings: str):
    return diagnose(load("imp", [*SETTINGS, *settings]), drive, {})


def on(stream: str, change: faults.Change) -> faults.Change:
    return lambda columns: change(columns) if columns.stream == stream else columns


def test_sound_lidars_have_no_findings(drive) -> None:
    assert found(drive) == []


CASES = [
    ("front", faults.late(0.15), "stamps late"),
    ("rear", faults.late(0.15), "stamps late"),
    ("front", faults.mirrored(), "scan mirrored"),  # of the rear one below
    ("rear", faults.turned(0.35), "lidar rotated"),
    ("front", faults.scaled_ranges(0.9), "range scale"),
    ("rear", faults.sweep_of(0.5), "sweep too long"),
    ("front", faults.noisy_no_return(3.0, 0.02), "value for no return"),
]


@pytest.mark.parametrize(
    ("name", "change", "kind"), CASES, ids=[f"{kind}-{name}" for name, _, kind in CASES]
)
def test_a_fault_is_found_with_its_lidar(
    drive, name: str, change: faults.Change, kind: str
) -> None:
    wrong = list(faults.faulty(drive, on(name, change)))
    (only,) = found(wrong)
    assert (only.kind, only.lidar, only.harmful) == (kind, name, True)
    assert f"{name}: " in str(only)
    assert all(setting.startswith(f"sensors.{name}.") for setting in only.fix)
    assert found(wrong, *only.fix) == []


def test_the_other_lidar_decides_whether_a_scan_is_mirrored(drive) -> None:
    (only,) = found(faults.faulty(drive, on("rear", faults.mirrored())))
    assert only.certainty > 0.99
    assert only.advice == ""


def test_a_fault_of_odometry_is_found_once(drive) -> None:
    (only,) = found(drive, "odometry.track=0.5")
    assert (only.kind, only.lidar) == ("track", "")
