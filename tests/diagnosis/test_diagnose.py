"""A drive through the arena with one thing wrong: it is found, its settings mend it, nothing else is."""

from collections.abc import Iterable

import numpy as np
import pytest
from tests import log_faults as faults

from impslam.columns import Batch, batches
from impslam.config import load
from impslam.diagnosis.diagnose import diagnose
from impslam.diagnosis.finding import standing
from impslam.health import MISALIGNED, MISSCALED, MISTIMED, OPPOSED, SOUND
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.types import LaserScan, Stamped, WheelAngles


@pytest.fixture(scope="module")
def drive() -> list[Batch]:
    """Return the arena's drive, with all noise, as columns."""
    messages = simulate(load_world("arena"), seed=3)
    return list(batches((type(message).__name__, message) for message in messages))


def found(drive: Iterable[Batch], *settings: str):
    return diagnose(load("imp", settings), drive, {})


def harm(drive: Iterable[Batch], *settings: str) -> dict:
    return {one.kind: one for one in found(drive, *settings) if one.harmful}


def test_silent_on_a_sound_log(drive) -> None:
    assert found(drive) == []


CASES = {
    "exchanged, a gyro tells": (faults.exchanged(), (), "wheels exchanged"),
    "mirrored, a gyro tells": (faults.mirrored(), (), "scan mirrored"),
    "left reversed": (faults.reversed_wheels("left"), (), "wheel reversed"),
    "right reversed": (faults.reversed_wheels("right"), (), "wheel reversed"),
    "both reversed": (faults.reversed_wheels("left", "right"), (), "wheels reversed"),
    "turned by 20 degrees": (faults.turned(0.35), (), "laser turned"),
    "astern": (faults.turned(3.14159), (), "laser turned"),
    "ranges 10 % short": (faults.scaled_ranges(0.9), (), "ranges scale"),
    "late": (faults.late(0.2), (), "stamps late"),
    "standing": (faults.standing(), (), "odometry stands still"),
    "track": (faults.nothing(), ("odometry.track=0.46",), "track"),
    "radius": (faults.nothing(), ("odometry.wheel_radius=0.08",), "wheel radius"),
    "ratio": (faults.nothing(), ("odometry.right_left_ratio=1.1",), "wheels unequal"),
    "wrapping": (faults.wrapping(18.85), (), "encoder wraps"),
    "jitter": (faults.jitter(0.02), (), "stamps jitter"),
    "no return": (faults.no_return(4.0), (), "value for no return"),
    "body": (faults.body(0.3), (), "own body in view"),
    "sweep": (faults.sweep_of(0.5), (), "sweep too long"),
    "stops": (faults.stopping(20.0, 10.0), (), "odometry stops"),
    "mount": (faults.nothing(), ("sensors.lidar.mount=[-0.1,0,0]",), "laser elsewhere"),
}


SPOILED = {
    "exchanged, a gyro tells": (OPPOSED, 0.0, 0.0),
    "left reversed": (OPPOSED, 0.0, 0.0),
    "turned by 20 degrees": (MISALIGNED, 20.0, 1.0),
    "ranges 10 % short": (MISSCALED, 0.11, 0.02),
    "late": (MISTIMED, 0.2, 0.03),
    "radius": (MISSCALED, 0.26, 0.03),
    "body": (SOUND.reason, 0.0, 0.0),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_fault_that_spoils_every_pose_is_said_of_the_run(drive, name) -> None:
    change, settings, _ = CASES[name]
    told = standing(found(list(faults.faulty(drive, change)), *settings))
    reason, amount, within = SPOILED[name]
    assert told.reason == reason
    assert told.amount == pytest.approx(amount, abs=within)


@pytest.mark.parametrize(("seconds", "reason"), [(0.12, SOUND.reason), (0.3, MISTIMED)])
def test_a_run_that_matches_scans_copes_with_a_sweep_s_lag_and_not_with_a_queue(
    drive, seconds, reason
) -> None:
    wrong = list(faults.faulty(drive, faults.late(seconds)))
    told = found(wrong, "tracker.kind=scan_to_map", "estimator.kind=graph")
    assert [one.kind for one in told] == ["stamps late"]
    assert standing(told).reason == reason


def test_nothing_is_said_of_a_sound_run(drive) -> None:
    assert standing(found(drive)) == SOUND


@pytest.mark.parametrize("name", CASES)
def test_a_fault_is_found_and_mended(drive, name: str) -> None:
    change, settings, kind = CASES[name]
    wrong = list(faults.faulty(drive, change))
    problems = harm(wrong, *settings)
    assert list(problems) == [kind]
    assert problems[kind].sure > 0.99 or problems[kind].advice
    mended = harm(wrong, *settings, *problems[kind].fix)
    assert mended == {}


def test_another_robots_preset_is_named(drive) -> None:
    (only,) = diagnose(load("turtlebot3-waffle", ["sensors.lidar.mount=[0.15,0,0]"]), drive, {})
    assert only.kind == "wrong preset"
    assert only.advice.endswith("-c imp")


def test_what_a_run_copes_with_is_a_note(drive) -> None:
    settings = "tracker.kind=scan_to_map", "odometry.track=0.42"
    (only,) = found(drive, *settings)
    assert (only.kind, only.harmful) == ("track", False)


def test_a_dead_sector(drive) -> None:
    (only,) = found(faults.faulty(drive, faults.blocked(0.3)))
    assert (only.kind, only.harmful) == ("dead sector", False)


def test_mirrored_or_exchanged_without_a_gyro(drive) -> None:
    quiet = [{name: c for name, c in batch.items() if name != "Imu"} for batch in drive]
    problems = harm(faults.faulty(quiet, faults.exchanged()))
    assert problems["scan mirrored"].sure == 0.5
    assert "odometry.exchanged=true" in problems["scan mirrored"].advice


def test_logs_that_tell_nothing(drive) -> None:
    """Nothing of these can be compared, and nothing is made up."""
    scans = [{name: c for name, c in batch.items() if name == "LaserScan"} for batch in drive]
    wheels = [{name: c for name, c in batch.items() if name == "WheelAngles"} for batch in drive]
    stopped = faults.of(Stamped, lambda c: faults.with_values(c, stamp=0.0 * c["stamp"]))
    blind = faults.of(LaserScan, lambda c: faults.with_values(c, ranges=np.nan * c["ranges"]))
    rare = faults.of(WheelAngles, lambda c: faults.with_values(c, left=_with_one(c["left"], 1e300)))
    cases = [[], scans, wheels, drive[:1], scans[:2] + wheels[:1]]
    cases += [list(faults.faulty(drive[:8], change)) for change in (stopped, blind, rare)]
    for case in cases:
        assert not [one for one in found(case) if one.harmful]


def _with_one(column, value: float):
    out = column.copy()
    out[len(out) // 2] = value
    return out
