"""Fault injection: effects of the faults on a drive, and verdicts of runs."""

from dataclasses import replace

import numpy as np
import pytest

from impslam.geometry.se2 import between
from impslam.studies import faults as study
from impslam.studies.drives import numbered, simulated, with_values
from impslam.studies.fault_kinds import FAULTS, FROZEN, TRACK, stuck, with_wheels
from impslam.studies.fault_scores import VERDICTS, _verdict, limit_of, map_drive, score
from impslam.studies.faults import fault_table, faults
from impslam.sweeps.job import Job
from impslam.types import OdometryPose


@pytest.fixture(scope="module")
def drive():
    return simulated("arena", 0)


def faulty(drive, name, seed=1):
    return FAULTS[name](drive, np.random.default_rng(seed))


def way(drive):
    """Return the distance by odometry, m."""
    wheels = np.column_stack((drive.odometry["left"], drive.odometry["right"]))
    return 0.0635 * np.abs(np.diff(wheels, axis=0)).mean(axis=1).sum()


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_gives_a_drive_and_leaves_the_clean_one_alone(drive, name):
    before = drive.scans["ranges"].copy(), drive.odometry["left"].copy()
    found = numbered(faulty(drive, name))
    assert len(found.scans) == len(found.truth) == len(found.scans["ranges"])
    orders = np.sort(np.concatenate((found.odometry.order, found.scans.order)))
    np.testing.assert_array_equal(orders, np.arange(len(orders)))
    assert (np.diff(found.scans.order) > 0).all()
    assert (np.diff(found.odometry.order) > 0).all()
    np.testing.assert_array_equal(before[0], drive.scans["ranges"])
    np.testing.assert_array_equal(before[1], drive.odometry["left"])
    pairs = zip((found.scans, found.odometry), (drive.scans, drive.odometry), strict=True)
    same = all(
        len(a) == len(b) and all(np.array_equal(a[n], b[n], equal_nan=True) for n in b.values)
        for a, b in pairs
    )
    assert same == (name == "none")


def test_frozen_wheels_measure_less_and_slipping_ones_more(drive):
    clean = way(drive)
    assert way(faulty(drive, "odometry frozen for 10 s")) < clean - 1.0
    assert way(faulty(drive, "slip of 0.5 m")) == pytest.approx(clean + 0.5, abs=0.01)
    assert way(faulty(drive, "wheels swapped")) == pytest.approx(clean)


def test_a_robot_against_a_wall_is_stationary_while_its_wheels_turn(drive):
    found = stuck(drive, np.random.default_rng(1))
    extra = drive.rows(FROZEN)
    assert len(found.scans) == len(drive.scans) + extra
    assert way(found) == pytest.approx(way(drive) + 0.3 * FROZEN, rel=0.01)
    assert (np.diff(found.truth, axis=0) == 0.0).all(axis=1).sum() >= extra
    assert (np.diff(found.scans.stamps) > 0.0).all()
    assert found.scans.stamps[-1] == pytest.approx(drive.scans.stamps[-1] + FROZEN)


def test_a_kidnapping_jumps_in_truth_and_not_in_odometry(drive):
    found = faulty(drive, "kidnapped")
    assert np.hypot(*np.diff(found.truth[:, :2], axis=0).T).max() > 2.0
    wheels = np.column_stack((found.odometry["left"], found.odometry["right"]))
    assert np.abs(np.diff(wheels, axis=0)).max() < 0.5  # rad
    assert (np.diff(found.scans.stamps) > 0.0).all()
    assert np.diff(found.scans.stamps).max() < 3.0 * drive.period


def test_a_turned_lidar_shows_the_same_by_a_few_beams(drive):
    found = faulty(drive, "lidar turned by 5° on the way")
    np.testing.assert_array_equal(found.scans["ranges"][-1, :-14], drive.scans["ranges"][-1, 14:])
    assert np.isnan(found.scans["ranges"][-1, -14:]).all()


def test_odometry_poses_have_wheels_too(drive):
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.5]])
    columns = replace(
        drive.odometry, kind=OdometryPose, values={"stamp": np.arange(3.0), "pose": poses}
    )
    columns = replace(columns, order=np.arange(3))
    whole = drive._replace(odometry=columns)
    np.testing.assert_allclose(with_wheels(whole, lambda w: w).odometry["pose"], poses, atol=1e-12)
    turned = with_wheels(whole, lambda w: w * np.array([0.0, 1.0])).odometry["pose"]
    np.testing.assert_allclose(between(turned[0], turned[1])[2], 1.0 / TRACK, atol=1e-9)


def test_verdicts():
    yes, no, nothing = np.array([True]), np.array([False]), frozenset()
    assert _verdict(no, no, no, nothing) == "harmless"
    assert _verdict(yes, no, no, nothing) == "said"
    assert _verdict(yes, yes, no, nothing) == "honest"
    assert _verdict(yes, yes, yes, frozenset({"gap"})) == "noted"
    assert _verdict(yes, yes, yes, nothing) == "silent"


def test_a_run_is_scored_against_the_truth(drive):
    clean = map_drive(drive)
    limit = limit_of(clean, drive)
    assert 0.0 < limit <= 0.5
    assert score(drive, limit, clean.notes, exact=True)["verdict"] == "harmless"
    moved = drive.truth + np.array([10.0 * limit, 0.0, 0.0])
    row = score(drive._replace(truth=moved), limit, clean.notes, exact=True)
    assert row["verdict"] == "silent"
    assert row["silent"] == row["wrong"] == len(drive.scans)
    refused = score(faulty(drive, "odometry absent"), limit, clean.notes, exact=True)
    assert refused["verdict"] == "said"
    assert "lidar_only" in refused["said"]


def test_the_study_shows_every_fault_and_drive(monkeypatch):
    some = ("none", "scans dropped, 5 %", "slip of 0.5 m")
    monkeypatch.setattr(study, "FAULTS", {name: FAULTS[name] for name in some})
    monkeypatch.setattr(study, "WORLDS", ("room",))
    section = faults(Job(seeds=1))
    assert [row["fault"] for row in section.runs] == list(some)
    assert [row[0] for row in section.tables[0].rows] == [*some, "all faults"]
    assert sum(section.numbers["verdicts"].values()) == section.numbers["runs"] == 2
    assert set(section.numbers["verdicts"]) == set(VERDICTS)
    assert section.pictures[0].content.startswith(b"\x89PNG")
    assert "intel" in section.text
    assert fault_table(section.runs) == section.tables[0]


def test_with_values_leaves_the_columns_alone(drive):
    changed = with_values(drive.scans, stamp=drive.scans.stamps + 1.0)
    assert changed.stamps[0] == drive.scans.stamps[0] + 1.0
    assert changed["angles"] is drive.scans["angles"]
