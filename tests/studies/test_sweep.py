"""Sweeps: a row for each run, in order, independent of the processes; failures have rows too."""

import math

import pytest
from tests.studies.worlds import beginning

from impslam.errors import ConfigError, ImpError
from impslam.simulation.world import load_world
from impslam.studies.sweep import Variant, grid, simulate_and_map, sweep
from impslam.sweeps.cases import ROBOT
from impslam.sweeps.job import Job
from impslam.sweeps.rows import by_variant, failures, median_row
from impslam.sweeps.statistics import Quantiles, mean, rms


@pytest.fixture(scope="module")
def short():
    """Two worlds in which the robot drives for three seconds."""
    return [beginning(load_world(name), 3.0) for name in ("arena", "room")]


def fail_for_ekf(run):
    if run.variant.name == "ekf" and run.seed == 0:
        raise ArithmeticError("singular")
    return {"scans": len(run.rows.stamps)}


VARIANTS = grid(["imp"], {"default": (), "ekf": ("filter.kind=ekf",)})


def test_rows_are_ordered_independent_of_the_processes(short):
    steps = []
    rows = sweep(VARIANTS, [3, 1], short, job=Job(progress=lambda *step: steps.append(step)))
    assert [(row["world"], row["seed"], row["variant"]) for row in rows] == [
        (world, seed, variant)
        for world in ("arena", "room")
        for seed in (3, 1)
        for variant in ("default", "ekf")
    ]
    assert steps[-1] == ("simulate and map", 4, 4)
    assert rows == sweep(VARIANTS, [3, 1], short, job=Job(processes=2))


def test_a_failed_run_has_a_row_and_does_not_affect_others(short):
    rows = sweep(VARIANTS, [0, 1], short[:1], measure=fail_for_ekf)
    assert [row["error"] for row in rows] == ["", "ArithmeticError: singular", "", ""]
    assert all(row["scans"] > 5 for row in rows if not row["error"])
    assert "end" not in rows[1]
    seeds = {name: [row["seed"] for row in some] for name, some in by_variant(rows).items()}
    assert seeds == {"default": [0, 1], "ekf": [1]}
    assert failures(rows) == (
        "Runs that failed and are left out: arena, ekf, seed 0: ArithmeticError: singular."
    )
    assert failures(rows[:1]) == ""
    with pytest.raises(ImpError, match="ekf: all 1 runs failed; the first: ArithmeticError"):
        by_variant(rows[:2])


def test_an_unknown_setting_is_rejected_before_anything_runs(short):
    with pytest.raises(ConfigError, match="knd is not a parameter"):
        sweep([Variant("bad", settings=("filter.knd=ekf",))], range(10**9), short)


def test_variants_of_other_robots_map_other_messages(short):
    still = ROBOT.model_copy(update={"encoders": ROBOT.encoders.perfect()})
    rows = sweep([Variant("noisy"), Variant("exact", robot=still)], [0], short[:1])
    assert rows[0]["odometry_end"] > 1e-4
    assert rows[1]["odometry_end"] < 1e-4


def test_a_run_knows_its_errors_and_every_landmark_that_entered_the_map(short):
    run = simulate_and_map(short[1], [Variant("default")], 0)["default"]
    assert len(run.path) == len(run.truth) == len(run.errors) == len(run.nees)
    assert run.travelled[0] == 0.0
    assert run.travelled[-1] > 0.1
    entered = [promotion.id for promotion in run.promotions]
    assert entered == sorted(entered)
    assert {mark.id for mark in run.landmarks} <= set(entered)
    kinds = {promotion.id: promotion.observation.kind for promotion in run.promotions}
    assert all(kinds[mark.id] == mark.kind for mark in run.landmarks)


def test_a_grid_is_every_preset_with_every_setting():
    made = grid(["imp", "thesis-lines"], {"": (), "gate 1": ("association.max_distance=1.0",)})
    assert [variant.name for variant in made] == [
        *("imp", "imp gate 1", "thesis-lines", "thesis-lines gate 1"),
    ]
    assert made[3].settings == ("association.max_distance=1.0",)


def test_the_median_row_is_that_of_the_median_metric():
    rows = [{"seed": seed, "end": end} for seed, end in enumerate((0.3, 0.1, 0.2))]
    assert median_row(rows)["seed"] == 2


def test_quantiles_by_nearest_rank():
    assert Quantiles.of(range(1, 101)) == (50, 3, 98)
    assert str(Quantiles.of([0.1, 0.2, math.inf])) == "0.200 [0.100, missing]"


def test_means_and_their_standard_errors(rng):
    values = rng.normal(2.0, 3.0, 10_000)
    assert mean(values).value == pytest.approx(2.0, abs=3 * mean(values).error)
    assert mean(values).error == pytest.approx(0.03, rel=0.05)
    assert rms(values).value == pytest.approx(math.sqrt(13.0), abs=3 * rms(values).error)
