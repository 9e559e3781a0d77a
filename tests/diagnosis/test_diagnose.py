"""Diagnosis of a drive through the arena with one fault: it finds only that, and its settings fix it."""

import functools
import itertools
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from tests import log_faults as faults

from impslam.calibration.lidar_path import determines_pose, unmounted
from impslam.calibration.recording import record_batches
from impslam.calibration.scan_pairs import align_pairs
from impslam.columns import Batch, Columns, batches, log_order, messages
from impslam.config import load
from impslam.diagnosis import aligned_pairs
from impslam.diagnosis.agreement import drive_axis, fit_agreement
from impslam.diagnosis.beam_samples import MAX_SCANS, BeamSamples
from impslam.diagnosis.diagnose import diagnose
from impslam.diagnosis.evidence import gather_evidence
from impslam.diagnosis.field_of_view import _beside
from impslam.diagnosis.file_order import without_repeats
from impslam.diagnosis.finding import Finding, worst_fault
from impslam.diagnosis.mount import ahead_of, check_mount
from impslam.diagnosis.no_return import check_noise
from impslam.diagnosis.robust import RobustFit
from impslam.diagnosis.scales import check_scales
from impslam.diagnosis.sweep import is_instant
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose
from impslam.health import DISTORTED, MISALIGNED, MISSCALED, MISTIMED, NO_FAULT, OPPOSED
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World, load_world
from impslam.types import Imu, LaserScan, OdometryPose, Stamped, TruePose, WheelAngles


@pytest.fixture(scope="module")
def drive() -> list[Batch]:
    """Return the arena's drive, with all noise, as columns."""
    messages = simulate(load_world("arena"), seed=3)
    return list(batches((type(message).__name__, message) for message in messages))


@pytest.fixture(scope="module")
def slow_drive() -> list[Batch]:
    """Return a drive without errors of the wheels, with a lidar that always measures: 10 Hz, 0.1 s."""
    lidar = Lidar(beams=360, angle_min=-math.pi, angle_step=math.tau / 360, beam_time=0.1 / 360)
    robot = SimulatedRobot(lidar=lidar, encoders=WheelEncoders.perfect(), imu=None)
    messages = simulate(load_world("arena"), robot, seed=3)
    return list(batches((type(message).__name__, message) for message in messages))


@pytest.fixture(scope="module")
def star_drive() -> list[Batch]:
    """Return a drive along a star, which turns by 0.5 rad during each sweep of a lidar of 2 Hz."""
    lidar = Lidar(
        beams=360, angle_min=-math.pi, angle_step=math.tau / 360, beam_time=0.49 / 360, rate=2.0
    )
    robot = SimulatedRobot(lidar=lidar, encoders=WheelEncoders.perfect(), imu=None)
    at = 0.8 * math.pi * np.arange(40)
    points = np.column_stack((3.0 + 0.3 * np.cos(at), 2.5 + 0.3 * np.sin(at))).tolist()
    plan = {"start": (3.0, 2.5, 0.0), "waypoints": points, "turn_rate": 1.0}
    ring = [(0.0, 0.0), (6.0, 0.0), (6.0, 5.0), (0.0, 5.0), (0.0, 0.0)]
    walls = [{"start": a, "end": b} for a, b in itertools.pairwise(ring)]
    boxes = [{"centre": (1.0, 1.2), "size": (0.8, 0.5)}, {"centre": (4.8, 4.0), "size": (0.6, 1.0)}]
    world = World(name="hall", robot=plan, walls=walls, boxes=boxes)
    messages = simulate(world, robot, seed=3)
    return list(batches((type(message).__name__, message) for message in messages))


MATCHED = "tracker.kind=scan_to_map"


def found(drive: Iterable[Batch], *settings: str):
    return diagnose(load("imp", settings), drive, {})


def evidence(drive: Iterable[Batch], *settings: str):
    config = load("imp", settings)
    return gather_evidence(config, "lidar", record_batches(config, drive, {}, "lidar"))


def scan_of(walls: list[tuple[float, float]], x: float, rng) -> Columns:
    """Return a scan from (x, 0) of a room; walls are (distance, angle) of their normals from the middle."""
    angles = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    towards = np.array([[max(math.cos(a - b), 1e-9) for _, b in walls] for a in angles])
    gaps = np.array([d - x * math.cos(b) for d, b in walls])
    ranges = (gaps / towards).min(axis=1) + 0.01 * rng.standard_normal(360)
    scan = LaserScan(0.0, angles, ranges, np.zeros(360))
    (batch,) = batches([("lidar", scan)])
    return batch["lidar"]


def harm(drive: Iterable[Batch], *settings: str) -> dict:
    return harmful(found(drive, *settings))


def harmful(findings: Iterable[Finding]) -> dict:
    return {one.kind: one for one in findings if one.harmful}


def test_sound_log_has_no_findings_and_no_fault(drive) -> None:
    findings = found(drive)
    assert findings == []
    assert worst_fault(findings) == NO_FAULT


def test_scans_are_aligned_once_for_all_checks(drive, monkeypatch) -> None:
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return align_pairs(*arguments)

    monkeypatch.setattr(aligned_pairs, "align_pairs", counted)
    found(drive)
    assert len(calls) == 1


CASES = {
    "swapped, with gyro": (faults.swapped(), (), "wheels swapped"),
    "mirrored, with gyro": (faults.mirrored(), (), "scan mirrored"),
    "left reversed": (faults.reversed_wheels("left"), (), "wheel reversed"),
    "right reversed": (faults.reversed_wheels("right"), (), "wheel reversed"),
    "both reversed": (faults.reversed_wheels("left", "right"), (), "wheels reversed"),
    "turned by 20 degrees": (faults.turned(0.35), (), "lidar rotated"),
    "astern": (faults.turned(3.14159), (), "lidar rotated"),
    "ranges 10 % short": (faults.scaled_ranges(0.9), (), "range scale"),
    # at 10 %, with the slip in turns, a wrong wheel radius explains the motion as well
    "ranges 20 % long": (faults.scaled_ranges(1.2), (), "range scale"),
    "ranges 5 cm long": (faults.longer_ranges(0.05), (), "range offset"),
    "ranges 20 cm short": (faults.longer_ranges(-0.2), (), "range offset"),
    "field of view 6 % wide": (faults.wider_field(1.06), (), "field of view"),
    "field of view 10 % narrow": (faults.wider_field(0.9), (), "field of view"),
    "ranges in mm": (faults.millimetres(5600.0), (), "ranges in mm"),
    "late": (faults.late(0.2), (), "stamps late"),
    "sweep reversed": (faults.reversed_sweep(), (), "sweep reversed"),
    "sweep not reversed": (
        faults.nothing(),
        ("sensors.lidar.last_beam_first=true",),
        "sweep reversed",
    ),
    "no time_increment": (faults.sweep_of(0.0), (), "sweep time wrong"),
    "standing": (faults.standing(), (), "odometry stands still"),
    "standing, with noise": (faults.swapped(1e-4), (), "odometry stands still"),
    "track": (faults.nothing(), ("odometry.track=0.46",), "track"),
    "radius": (faults.nothing(), ("odometry.wheel_radius=0.08",), "wheel radius"),
    "ratio": (faults.nothing(), ("odometry.right_left_ratio=1.1",), "wheels unequal"),
    "wrapping": (faults.wrapping(18.85), (), "encoder wraps"),
    "jitter": (faults.jitter(0.02), (), "stamps jitter"),
    "no return": (faults.no_return(4.0), (), "value for no return"),
    "noisy no return": (faults.noisy_no_return(3.0, 0.02), (), "value for no return"),
    "clamped no return": (faults.noisy_no_return(3.0, 0.02, True), (), "value for no return"),
    "body": (faults.body(0.3), (), "own body in view"),
    "sweep": (faults.sweep_of(0.5), (), "sweep too long"),
    "stops": (faults.stopping(20.0, 10.0), (), "odometry stops"),
    "mount": (faults.nothing(), ("sensors.lidar.mount=[-0.1,0,0]",), "lidar displaced"),
}


@pytest.fixture(scope="module")
def findings(drive) -> Callable[[str], list[Finding]]:
    """Return a function that diagnoses the drive with the fault of a case, once each."""

    @functools.cache
    def of(name: str) -> list[Finding]:
        change, settings, _ = CASES[name]
        return found(list(faults.faulty(drive, change)), *settings)

    return of


def test_counters_that_began_anew_do_not_wrap(drive) -> None:
    assert "encoder wraps" not in {
        one.kind for one in found(list(faults.faulty(drive, faults.restarted(30.0))))
    }


def test_a_laser_behind_the_axle_is_reported_behind_it() -> None:
    assert ahead_of("the axle", 0.1, 0.002) == "0.100 ± 0.002 m ahead of the axle"
    assert ahead_of("the axle", -0.064, 0.0) == "0.064 ± 0.001 m behind the axle"


SPOILED = {
    "swapped, with gyro": (OPPOSED, 0.0, 0.0),
    "left reversed": (OPPOSED, 0.0, 0.0),
    "turned by 20 degrees": (MISALIGNED, 20.0, 1.0),
    "ranges 10 % short": (MISSCALED, 0.11, 0.02),
    "late": (MISTIMED, 0.2, 0.03),
    "no time_increment": (DISTORTED, 0.067, 0.01),
    "sweep reversed": (DISTORTED, 0.133, 0.02),
    "sweep": (DISTORTED, 0.433, 0.02),
    "radius": (MISSCALED, 0.26, 0.03),
    "body": (NO_FAULT.reason, 0.0, 0.0),
}


@pytest.mark.parametrize("name", SPOILED)
def test_worst_fault_gives_reason_and_amount(findings, name) -> None:
    fault = worst_fault(findings(name))
    reason, amount, within = SPOILED[name]
    assert fault.reason == reason
    assert fault.amount == pytest.approx(amount, abs=within)


def test_turns_of_matched_scans_do_not_depend_on_those_of_odometry(drive) -> None:
    (finding,) = found(drive, "odometry.track=0.5", MATCHED)
    assert finding.kind == "track"
    assert finding.harmful
    assert finding.fault == NO_FAULT


@pytest.mark.parametrize(("seconds", "reason"), [(0.12, NO_FAULT.reason), (0.3, MISTIMED)])
def test_scan_matching_tolerates_a_lag_of_one_sweep_but_not_of_a_queue(
    drive, seconds, reason
) -> None:
    wrong = list(faults.faulty(drive, faults.late(seconds)))
    findings = found(wrong, "tracker.kind=scan_to_map", "estimator.kind=graph")
    assert [one.kind for one in findings] == ["stamps late"]
    assert worst_fault(findings).reason == reason


@pytest.mark.parametrize(("scans", "reason"), [(0, NO_FAULT.reason), (6, MISTIMED)])
def test_late_scans_are_found_by_order_if_stamps_run_back(drive, scans, reason) -> None:
    """All rows are stamped by a busy computer, up to a second late; the order of the log is right."""
    begin = drive[0]["LaserScan"].stamps[0] - 1.0
    wrong = list(faults.faulty(faults.faulty(drive, faults.delayed(scans)), faults.busy(begin)))
    findings = found(wrong, MATCHED)
    assert worst_fault(findings).reason == reason
    late = [one for one in findings if one.kind == "stamps late"]
    assert len(late) == bool(scans)
    for finding in late:
        assert set_by(finding.fix)["sensors.lidar.latency"] == pytest.approx(0.1 * scans, abs=0.1)


def test_scans_that_were_written_twice_count_once_in_the_order_of_a_log(drive) -> None:
    """Each copy would count as a period of time; scans alone that equal each other are a robot at rest."""
    once = record_batches(load("imp", [MATCHED]), drive, {}, "lidar")
    (scans,) = once.scans
    twice = replace(once, scans=(scans.take(np.repeat(np.arange(len(scans)), 2)),))
    (found,) = without_repeats(twice).scans
    np.testing.assert_array_equal(found.stamps, scans.stamps)
    np.testing.assert_array_equal(found["ranges"], scans["ranges"])
    resting = scans.take(slice(0, 2)).with_stamps(np.array([0.0, 0.1]))
    resting["ranges"][:] = 1.0
    assert len(without_repeats(replace(once, scans=(resting,))).scans[0]) == 2


@pytest.mark.parametrize("seconds", [-8.0, 1.0])
def test_the_clock_of_another_computer_is_found(drive, seconds) -> None:
    """Nothing synchronises it; it may be off by much more than the delay of any driver."""
    wrong = list(faults.faulty(drive, faults.late(seconds)))
    (finding,) = found(wrong, MATCHED)
    assert finding.kind == "stamps late"
    assert set_by(finding.fix)["sensors.lidar.latency"] == pytest.approx(seconds, abs=0.02)
    assert found(wrong, MATCHED, *finding.fix) == []


@pytest.mark.parametrize("seconds", [-1e9, 500.0])
def test_clocks_that_share_no_time_are_aligned_by_the_order_of_the_log(drive, seconds) -> None:
    wrong = list(faults.faulty(drive, faults.late(seconds)))
    (finding,) = found(wrong, MATCHED)
    assert finding.kind == "clocks differ"
    assert set_by(finding.fix)["sensors.lidar.latency"] == pytest.approx(seconds, abs=0.2)
    assert harm(wrong, MATCHED, *finding.fix) == {}


def test_the_lag_of_long_sweeps_is_found(slow_drive) -> None:
    """A scan of a whole turn is distorted in turns, which looks as if it had been taken earlier."""
    wrong = list(faults.faulty(slow_drive, faults.late(0.1)))
    lag = evidence(wrong).timing.lag
    assert lag.seconds == pytest.approx(0.1, abs=0.005)
    assert lag.sigma < 0.005


def test_a_turned_laser_says_what_the_drive_shows_of_its_y() -> None:
    """Odometry with turns measures y; where its distances are too uncertain, the finding says so."""
    lidar = Lidar(mount=(0.1, 0.08, 0.5))
    robot = SimulatedRobot(lidar=lidar, encoders=WheelEncoders.perfect(), imu=None)
    messages = simulate(load_world("arena"), robot, seed=3)
    e = evidence(batches((type(message).__name__, message) for message in messages))
    (turned,) = check_mount(e)
    told = re.search(r"y stays 0.000 m; by odometry it is (\S+) ± (\S+) m", turned.advice)
    assert float(told[1]) == pytest.approx(0.08, abs=0.01)
    unsure = e.agreement._replace(distance=RobustFit(e.agreement.distance.p, np.eye(2)))
    (turned,) = check_mount(replace(e, agreement=unsure))
    assert turned.advice == "y stays 0.000 m: the drive does not show it, so measure it"


def set_by(fix: Iterable[str]) -> dict[str, float]:
    return {key: float(value) for key, value in (one.split("=") for one in fix)}


@pytest.mark.parametrize("name", CASES)
def test_fault_is_found_and_its_settings_fix_it(drive, findings, name: str) -> None:
    change, settings, kind = CASES[name]
    problems = harmful(findings(name))
    assert list(problems) == [kind]
    assert problems[kind].certainty > 0.99 or problems[kind].advice
    wrong = list(faults.faulty(drive, change))
    assert harm(wrong, *settings, *problems[kind].fix) == {}


@pytest.mark.parametrize("scale", [0.9, 1.06])
def test_the_field_of_view_is_found_within_a_hundredth(drive, scale) -> None:
    (finding,) = found(list(faults.faulty(drive, faults.wider_field(scale))))
    assert set_by(finding.fix) == {
        "sensors.lidar.angle_scale": pytest.approx(1.0 / scale, rel=0.01)
    }


def test_a_derivative_by_the_angles_is_that_of_turned_beams(rng) -> None:
    points, middle, step = rng.normal(0.0, 3.0, (20, 2)), 0.4, 1e-6
    angles = wrap(np.arctan2(points[:, 1], points[:, 0]) - middle)
    c, s = np.cos(step * angles), np.sin(step * angles)
    turned = np.column_stack(
        (c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1])
    )
    np.testing.assert_allclose((turned - points) / step, _beside(points, middle), atol=1e-4)


def test_ranges_in_mm_beyond_a_limit_in_m_are_the_drivers_fault(drive) -> None:
    (only,) = found(list(faults.faulty(drive, faults.millimetres(4.0))))
    assert only.kind == "ranges in mm"
    assert not only.fix
    assert only.advice.startswith("write ranges in m like range_max")


@pytest.mark.parametrize(
    ("scale", "turned", "kind", "remedy"),
    [
        ((1000.0, 1000.0, 1.0), 9.0, "poses in mm", "--set odometry.distance_scale=0.001"),
        ((1.0, 1.0, 57.29578), 9.0, "poses in degrees", "--columns theta=NAME*0.0174533"),
        ((1.0, 1.0, 1.0), 9.0, "lidar rotated", ",-2.71"),
        ((1.0, 1.0, 1.0), 2.0 * math.tau, None, ""),
    ],
)
def test_units_of_poses(drive, scale, turned, kind, remedy) -> None:
    """Truth as odometry, in another unit; its headings are not wrapped, as in many CSV logs."""
    true = [c for batch in drive for c in batch.values() if c.kind is TruePose]
    stamps = np.concatenate([c.stamps for c in true])
    headings = np.unwrap(np.concatenate([c["pose"][:, 2] for c in true])) + turned

    def change(c: Columns) -> Columns:
        heading = headings[np.searchsorted(stamps, c.stamps)]
        pose = np.array(scale) * np.column_stack((c["pose"][:, :2], heading))
        return replace(faults.with_values(c, pose=pose), kind=OdometryPose)

    wrong = list(faults.faulty(drive, faults.of(TruePose, change)))
    problems = [one for one in diagnose(load("default"), wrong, {}) if one.harmful]
    assert [one.kind for one in problems] == ([kind] if kind else [])
    assert all(remedy in str(one) for one in problems)


def test_rounded_poses_are_no_fault(drive) -> None:
    def change(c: Columns) -> Columns:
        return replace(faults.rounded(0.01, 0.01)(replace(c, kind=OdometryPose)), order=c.order)

    rounded = list(faults.faulty(drive, faults.of(TruePose, change)))
    assert harmful(diagnose(load("default"), rounded, {})) == {}


def test_small_turns_rounded_to_zero_are_not_the_rule(rng) -> None:
    """On straight drives, most changes of a heading in steps of 0.01 rad are 0."""
    turns = rng.normal(0.0, 0.004, 200)
    axle = np.column_stack((np.full(200, 0.4), turns))
    heading = np.round(np.cumsum(turns) / 0.01) * 0.01
    measured = np.column_stack((axle[:, 0], np.zeros(200), np.diff(heading, prepend=0.0)))
    assert np.mean(measured[:, 2] == 0.0) > 0.5
    agreed = fit_agreement(axle, measured, (1e-4, 0.0, 0.01))
    assert agreed.turn.p[1] == pytest.approx(1.0, abs=3.0 * agreed.turn.sigma[1])
    assert agreed.turn.sigma[1] < 0.3


def test_odometry_at_1_hz_shows_no_lag(drive) -> None:
    """Between its readings, turns seem to begin and end at other times."""

    def rare(c: Columns) -> Columns:
        return c.take(np.flatnonzero(np.diff(np.floor(c.stamps), prepend=-1.0)))

    late = list(faults.faulty(drive, faults.late(0.3)))
    assert "stamps late" in harm(late)
    rarely = list(faults.faulty(late, faults.of((WheelAngles, Imu), rare)))
    assert "stamps late" not in [one.kind for one in found(rarely)]


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_stamps_in_whole_seconds_are_reported_and_nothing_else_is_concluded(drive, step) -> None:
    """As of a CSV log with a pose and a scan in each row; its headings are not wrapped."""
    true = [c for batch in drive for c in batch.values() if c.kind is TruePose]
    stamps, poses = (np.concatenate([c[name] for c in true]) for name in ("stamp", "pose"))
    rows = []
    for scan in messages(drive):
        if isinstance(scan, LaserScan):
            stamp, k = math.floor(scan.stamp / step) * step, np.searchsorted(stamps, scan.stamp)
            rows.append(OdometryPose(stamp, poses[k] + [0.0, 0.0, 2.0 * math.tau]))
            rows.append(replace(scan, stamp=stamp))
    wrong = list(batches((type(row).__name__, row) for row in rows))
    problems = [one for one in diagnose(load("default"), wrong, {}) if one.harmful]
    assert [one.kind for one in problems] == ["stamps repeat"]
    assert f"stamps come in steps of {step:g} s" in problems[0].what


def test_stamps_in_ms_are_a_problem(drive) -> None:
    wrong = list(faults.faulty(drive, lambda c: faults.with_values(c, stamp=1000.0 * c.stamps)))
    assert harmful(found(wrong)).keys() == {"stamps in ms"}


def test_scans_that_are_far_apart_may_have_stamps_in_s(drive) -> None:
    """A robot that takes half a minute from scan to scan."""

    def rare(c: Columns) -> Columns:
        kept = c.take(slice(None, None, 8)) if c.kind is LaserScan else c
        return faults.with_values(kept, stamp=40.0 * kept.stamps)

    rarely = list(faults.faulty(drive, rare))
    assert "stamps in ms" in [one.kind for one in found(rarely)]
    assert "stamps in ms" not in harm(rarely)


def test_a_straight_drive_does_not_show_where_the_laser_is(rng) -> None:
    """Errors of matches are correlated: turned by an angle, a scan also moves along the walls it sees."""
    off = 3e-4 * rng.standard_normal(50)
    sideways = -2.9 * off + 1e-4 * rng.standard_normal(50)
    motions = np.column_stack((np.full(50, 0.4), sideways, off))
    axis = drive_axis(motions)
    assert abs(axis.ahead) < 3.0 * math.sqrt(axis.covariance[1, 1])
    agreed = fit_agreement(motions[:, [0, 2]], np.column_stack((motions[:, :2], 0.0 * off)))
    assert abs(agreed.turn.p[1] - 1.0) < 3.0 * agreed.turn.sigma[1]
    motions[:, 1] += 0.2 * np.linspace(-0.3, 0.3, 50)
    motions[:, 2] += np.linspace(-0.3, 0.3, 50)
    turning = drive_axis(motions)
    assert abs(turning.ahead - 0.2) < 0.02
    assert math.sqrt(turning.covariance[1, 1]) < 0.02


def test_a_drive_along_arcs_of_one_radius_shows_neither_scales_nor_the_driving_direction(
    rng,
) -> None:
    """Distance and turn are proportional: only errors of the matches tell one from the other."""
    truth = np.tile([0.4, 0.0, 0.4], (40, 1))
    motions = truth + rng.standard_normal((40, 3)) * [0.002, 0.002, 0.001]
    axis = drive_axis(motions)
    assert math.sqrt(axis.covariance[0, 0]) > 1.0
    agreed = fit_agreement(motions[:, [0, 2]], truth)
    assert abs(agreed.distance.p[0] - 1.0) < 3.0 * agreed.distance.sigma[0]
    assert abs(agreed.turn.p[1] - 1.0) < 3.0 * agreed.turn.sigma[1]
    straight = np.tile([0.4, 0.0, 0.0], (40, 1))
    both, truth = np.concatenate((motions, straight)), np.concatenate((truth, straight))
    assert math.sqrt(drive_axis(both).covariance[0, 0]) < 0.01
    agreed = fit_agreement(both[:, [0, 2]], truth)
    assert max(agreed.distance.sigma[0], agreed.turn.sigma[1]) < 0.01


def test_scans_in_a_round_room_do_not_determine_the_turn(rng) -> None:
    """From the middle of a square room as large, and near its wall, they do."""

    def determined(walls: list[tuple[float, float]], x: float) -> bool:
        columns = scan_of(walls, x, rng)
        own = unmounted(load("imp").make_robot().sensors["lidar"])
        return bool(determines_pose(own.sweeps(columns, np.zeros((1, 3)))).all())

    round_room = [(5.0, 2.0 * math.pi * k / 32.0) for k in range(32)]
    square_room = [(5.0, 0.5 * math.pi * k) for k in range(4)]
    for x in (0.0, 2.0, 4.0):
        assert not determined(round_room, x)
        assert determined(square_room, x)


@pytest.mark.parametrize("turn", [0.05, -0.05])
def test_no_setting_is_proposed_that_its_parameter_cannot_have(drive, turn) -> None:
    e = evidence(drive, "odometry.track=0.01")
    odd = e.agreement._replace(turn=RobustFit(np.array([0.0, turn]), 1e-8 * np.eye(2)))
    for finding in check_scales(replace(e, agreement=odd)):
        assert finding.fix == ()
        assert "no setting" in finding.advice


def test_a_lost_scan_is_no_long_sweep(drive) -> None:
    """A driver that measures the time of a revolution doubles it when it loses one."""
    lost = iter([True])

    def change(c: Columns) -> Columns:
        return faults.with_layout(c, time_offsets=(1.0 + next(lost, 0.0)) * c["time_offsets"])

    assert found(list(faults.faulty(drive, faults.of(LaserScan, change)))) == []


def test_matching_preset_is_proposed(drive) -> None:
    (only,) = diagnose(load("turtlebot3-waffle", ["sensors.lidar.mount=[0.15,0,0]"]), drive, {})
    assert only.kind == "wrong preset"
    assert only.advice.endswith("-c imp")


def test_tolerable_error_is_not_harmful(drive) -> None:
    settings = "tracker.kind=scan_to_map", "odometry.track=0.43"
    (only,) = found(drive, *settings)
    assert (only.kind, only.harmful) == ("track", False)


@pytest.mark.parametrize("late", [-0.3, 0.3])
def test_a_reversed_sweep_is_found_whatever_the_lag(drive, late) -> None:
    both = list(faults.faulty(faults.faulty(drive, faults.reversed_sweep()), faults.late(late)))
    problems = harm(both)
    assert list(problems) == ["sweep reversed", "stamps late"]
    fixes = [setting for one in problems.values() for setting in one.fix]
    assert harm(both, *fixes) == {}


@pytest.mark.parametrize(
    ("change", "given", "fix"),
    [
        (faults.sweep_of(0.0), 0.0, (0.1, None)),
        (faults.sweep_of(0.05), 0.05, (0.1, None)),
        (faults.sweep_of(0.4), 0.4, (0.1, None)),
        (faults.reversed_sweep(), 0.1, (None, "true")),
    ],
)
@pytest.mark.parametrize("settings", [(), ("odometry.kind=lidar_only", MATCHED)])
def test_the_duration_of_a_sweep_is_found_from_scans_alone(
    slow_drive, change, given, fix, settings
) -> None:
    wrong = list(faults.faulty(slow_drive, change))
    (problem,) = harm(wrong, *settings).values()
    assert (f"{given:.3f} s" in problem.what) == (fix[0] is not None)
    settable = dict(one.removeprefix("sensors.lidar.").split("=") for one in problem.fix)
    assert settable.get("last_beam_first") == fix[1]
    if fix[0] is not None:
        assert float(settable["sweep_time"]) == pytest.approx(fix[0], abs=0.003)
    assert harm(wrong, *settings, *problem.fix) == {}


def test_a_sweep_time_of_the_config_that_is_wrong_is_named(drive) -> None:
    (problem,) = harm(drive, "sensors.lidar.sweep_time=0").values()
    assert "as sensors.lidar.sweep_time says" in problem.what


def test_a_sweep_time_of_the_config_may_exceed_the_period_by_rounding(slow_drive) -> None:
    assert harm(slow_drive, "sensors.lidar.sweep_time=0.1002") == {}


def test_the_times_of_beams_are_not_looked_for_where_nothing_is_deskewed(drive) -> None:
    for change in (faults.reversed_sweep(), faults.sweep_of(0.0)):
        wrong = faults.faulty(drive, change)
        kinds = [one.kind for one in found(wrong, "sensors.lidar.deskew=false")]
        assert not {"sweep reversed", "sweep time wrong"} & {*kinds}


def test_before_a_run_missing_times_are_found_unless_a_sweep_is_short(drive, slow_drive) -> None:
    for log in (drive, slow_drive):
        wrong = list(faults.faulty(log, faults.sweep_of(0.0)))
        problems = diagnose(load("imp"), wrong, {}, is_quick=True)
        assert [one.kind for one in problems if one.harmful] == ["sweep time wrong"]
    e = evidence(faults.faulty(drive, faults.sweep_of(0.0)))
    assert not is_instant(e)
    assert is_instant(replace(e, timing=e.timing._replace(period=0.025)))


@pytest.mark.parametrize("yaw", [0.0, 0.35])
def test_mounts_are_found_by_sweeps_that_turns_bend_much(star_drive, yaw) -> None:
    findings = found(faults.faulty(star_drive, faults.turned(yaw)))
    assert [one.kind for one in findings] == (["lidar rotated"] if yaw else [])
    for finding in findings:
        assert finding.fault.amount == pytest.approx(math.degrees(yaw), abs=2.0)


def test_sweeps_without_turns_do_not_show_the_order_of_beams(drive) -> None:
    still = [batch for batch in drive if all((c.stamps < 3.0).all() for c in batch.values())]
    assert found(faults.faulty(still, faults.reversed_sweep())) == []


def test_dead_sector(drive) -> None:
    (only,) = found(faults.faulty(drive, faults.blocked(0.3)))
    assert (only.kind, only.harmful) == ("dead sector", False)


def test_no_return_does_not_mean_a_covered_lidar_while_the_robot_stands(drive) -> None:
    """Open space in the same direction explains it, and a wall nearby explains a constant range."""
    still = list(faults.faulty(drive, faults.parked()))
    assert found(faults.faulty(still, faults.blocked(0.3))) == []
    assert found(faults.faulty(still, faults.body(0.3))) == []


@pytest.mark.parametrize("limit", [0.8, 2.0])
@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_noise_of_no_return_is_all_that_is_found_while_the_robot_stands(
    drive, limit, sigma
) -> None:
    """It looks like a round wall, on which a standing lidar seems to turn, unlike the wheels."""
    still = faults.faulty(drive, faults.parked())
    creeping = faults.faulty(still, creeping_wheels())
    wrong = list(faults.faulty(creeping, faults.noisy_no_return(limit, sigma)))
    (only,) = found(wrong, MATCHED)
    assert only.kind == "value for no return"
    (fix,) = only.fix
    name, _, value = fix.partition("=")
    assert name == "sensors.lidar.range_max"
    assert 0.5 * limit < float(value) < limit - 5.0 * sigma
    assert found(wrong, MATCHED, fix) == []


def test_beams_are_checked_if_their_times_differ_from_scan_to_scan(drive) -> None:
    """As those of drivers that measure each revolution."""
    factors = itertools.cycle([0.98, 1.0, 1.02])

    def change(c: Columns) -> Columns:
        with_more = faults.with_values(c, intensities=np.ones_like(c["ranges"]))
        return faults.with_layout(with_more, time_offsets=next(factors) * c["time_offsets"])

    single = [batch for whole in drive for batch in batches(log_order(whole), 1)]
    wrong = faults.faulty(single, faults.of(LaserScan, change))
    assert len(evidence(wrong).samples.ranges) == MAX_SCANS


@pytest.mark.parametrize(("corners", "reach"), [(4, 4.2), (6, 3.63)])
def test_walls_near_a_range_max_that_the_lidar_exceeds_are_not_its_noise(
    drive, corners, reach
) -> None:
    """A cheap lidar measures farther than its range_max says, and gives 0 for no return."""
    rng, apothem, limit = np.random.default_rng(1), 3.45, 3.5
    angles = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    normals = math.tau * np.arange(corners) / corners
    places = rng.uniform(-0.08, 0.08, (100, 2))
    gaps = apothem - places @ np.stack((np.cos(normals), np.sin(normals)))
    towards = np.maximum(np.cos(angles[:, None] - normals), 1e-9)
    ranges = (gaps[:, None] / towards).min(axis=2) + 0.03 * rng.standard_normal((100, 360))
    ranges[(rng.random(ranges.shape) < 0.2) | (ranges > reach)] = 0.0
    valid = (ranges > 0.0) & (ranges < limit)
    sample = BeamSamples(ranges, valid, angles, np.zeros(100), limit)
    assert check_noise(replace(evidence(drive), samples=sample)) == []


def creeping_wheels() -> faults.Change:
    """Let the wheels of a standing robot creep, each the other way, as they do in simulators."""
    return faults.of(
        WheelAngles,
        lambda c: faults.with_values(c, left=1e-3 * c["stamp"], right=-1e-3 * c["stamp"]),
    )


def test_mirrored_or_swapped_without_a_gyro(drive) -> None:
    quiet = [{name: c for name, c in batch.items() if name != "Imu"} for batch in drive]
    problems = harm(faults.faulty(quiet, faults.swapped()))
    assert problems["scan mirrored"].certainty == 0.5
    assert "odometry.swapped=true" in problems["scan mirrored"].advice


def test_logs_without_usable_data_have_no_harmful_findings(drive) -> None:
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


@pytest.mark.parametrize("config", ["imp", "default"])
def test_a_log_whose_scans_are_too_far_apart_is_not_compared(drive, config) -> None:
    def thinned(columns: Columns) -> Columns:
        return columns.take(slice(None, None, 40 if columns.kind is LaserScan else 1))

    sparse = list(faults.faulty(drive, thinned))
    findings = diagnose(load(config), sparse, {})
    if config == "default":  # without odometry there is nothing to compare
        assert findings == []
        return
    (finding,) = findings
    assert finding.kind == "not compared"
    assert not finding.harmful
    assert "certain" not in str(finding)


def test_a_log_without_scans_is_not_said_to_have_too_few(drive) -> None:
    blind = [{k: c for k, c in batch.items() if c.kind is not LaserScan} for batch in drive]
    assert diagnose(load("imp"), blind, {}) == []


BASE = np.array([0.15, -0.1, math.radians(40.0)])
"""A frame on the robot; it moves sideways when the robot drives ahead."""


@pytest.fixture(scope="module")
def sideways_drive() -> list[Batch]:
    return drive_in(BASE)


def drive_in(frame: np.ndarray) -> list[Batch]:
    """Return a drive of a robot whose odometry is that of a frame (3,) on it."""
    rng = np.random.default_rng(1)
    robot = SimulatedRobot(imu=None)
    messages = []
    for message in simulate(load_world("arena"), robot, seed=3):
        if isinstance(message, TruePose):
            pose = compose(message.pose, frame) + rng.normal(0.0, 1e-4, 3)
            message = OdometryPose(message.stamp, pose)  # noqa: PLW2901
        if isinstance(message, OdometryPose | LaserScan):
            messages.append((type(message).__name__, message))
    return list(batches(messages))


def sideways_findings(drive: Iterable[Batch], off=(0.0, 0.0, 0.0), frame=BASE) -> dict:
    """Return what is found with a mount in the frame that is off by m, m, rad."""
    mount = between(frame, np.array(load("imp").make_robot().sensors["lidar"].mount)) + off
    settings = [f"sensors.lidar.mount={mount.round(6).tolist()}"]
    return {one.kind: one for one in diagnose(load("default", settings), drive, {})}


def test_a_sound_robot_that_moves_sideways_has_no_findings(sideways_drive) -> None:
    assert sideways_findings(sideways_drive) == {}


def test_scales_of_a_robot_that_only_moves_sideways_are_not_checked() -> None:
    frame = np.array([0.15, -0.1, math.radians(89.0)])
    assert sideways_findings(drive_in(frame), frame=frame) == {}


@pytest.mark.parametrize("yaw", [-0.2, 0.08, 0.8, 3.0])
def test_the_yaw_of_a_laser_on_a_robot_that_moves_sideways_is_found(sideways_drive, yaw) -> None:
    (finding,) = sideways_findings(sideways_drive, (0.0, 0.0, yaw)).values()
    assert finding.kind == "lidar rotated"
    angle = float(re.findall(r"-?\d+\.\d+", finding.fix[0])[-1])
    assert wrap(angle + BASE[2]) == pytest.approx(0.0, abs=0.01)


def test_the_position_of_a_laser_on_a_robot_that_moves_sideways_is_found(sideways_drive) -> None:
    (finding,) = sideways_findings(sideways_drive, (0.2, 0.0, 0.0)).values()
    assert finding.kind == "lidar displaced"
    assert "base_link" in finding.what


def test_a_mirrored_scan_of_a_robot_that_moves_sideways_is_found(sideways_drive) -> None:
    mirrored = list(faults.faulty(sideways_drive, faults.mirrored()))
    (finding,) = sideways_findings(mirrored, (0.0, 0.0, 0.5)).values()
    assert finding.kind == "scan mirrored"
    upside_down, mount = finding.fix
    assert upside_down.endswith("upside_down=true")
    yaw = float(re.findall(r"-?\d+\.\d+", mount)[-1])
    assert wrap(yaw + BASE[2]) == pytest.approx(0.0, abs=0.01)
