"""Parameter search: finds the optimum, resumes after an interruption, and tolerates failed trials."""

import json
import math
import sys

import numpy as np
import pytest

from impslam import extras
from impslam.config import load
from impslam.errors import ConfigError, ImpError
from impslam.sweeps.cases import find_log
from impslam.sweeps.pool import Processes, ThisProcess
from impslam.sweeps.rows import attempt
from impslam.sweeps.searches import noise_space, parse_space
from impslam.sweeps.space import Choice, Range
from impslam.sweeps.task import Task
from impslam.sweeps.tuned import tuned_config
from impslam.sweeps.tuning import best, finished, open_study, score_of, search, suggest

pytest.importorskip("optuna")
SPACE = {"odometry.wheel_noise": Range(0.001, 1.0), "filter.kind": Choice(("ekf", "riekf"))}
BASE = {"odometry.wheel_noise": 0.5, "filter.kind": "ekf"}


def bowl(cases):
    """Return the row of a run with the least error at a noise of 0.03 with the riekf."""
    (settings,) = cases

    def measure():
        noise = float(settings["odometry.wheel_noise"])
        if noise > 0.6:
            raise ArithmeticError("too noisy")
        return {"ate_m": 0.1 + abs(math.log(noise / 0.03)) + (settings["filter.kind"] == "ekf")}

    return [attempt({"log": "toy"}, measure)]


def tune(folder, trials, work=bowl, processes=1):
    study = open_study(folder, BASE, SPACE)
    steps = []
    search(
        study,
        lambda trial: [dict(suggest(SPACE, trial))],
        "best",
        Processes(processes) if processes > 1 else ThisProcess(),
        trials,
        lambda *step: steps.append(step),
        work,
    )
    return study, steps


def test_the_best_is_found_and_the_config_itself_is_tried_first(tmp_path):
    study, steps = tune(tmp_path, 40)
    assert dict(suggest(SPACE, study.trials[0])) == {
        "odometry.wheel_noise": "0.5",
        "filter.kind": "ekf",
    }
    found = dict(suggest(SPACE, best(study)))
    assert 0.01 < float(found["odometry.wheel_noise"]) < 0.09
    assert found["filter.kind"] == "riekf"
    assert steps[-1] == ("trials", 40, 40)
    failed = [trial for trial in study.trials if not trial.values]
    assert {trial.user_attrs["message"] for trial in failed} <= {"ArithmeticError: too noisy"}


def interrupted(cases):
    raise KeyboardInterrupt


def test_an_interrupted_search_is_resumed(tmp_path):
    tune(tmp_path, 3)
    with pytest.raises(KeyboardInterrupt):
        tune(tmp_path, 9, interrupted)
    study, steps = tune(tmp_path, 6)
    assert steps[-1] == ("trials", 3, 3)
    assert len(finished(study)) == 6
    lost = next(trial for trial in study.trials if trial not in finished(study) and trial.params)
    assert lost.params in [trial.params for trial in finished(study)]


def test_processes_share_the_trials(tmp_path):
    study, _ = tune(tmp_path, 6, processes=2)
    assert len(finished(study)) == 6


@pytest.mark.parametrize(
    ("search", "value"),
    [
        ("association.gate=0.9,0.99,0.999", "0.999"),
        ("sensors.lidar.deskew=false,true", "true"),
        ("odometry.wheel_noise=0.001:1.0", "0.005"),
    ],
)
def test_the_config_itself_is_tried_first_whatever_the_type_of_a_value(tmp_path, search, value):
    task = Task([find_log("room")], [], "imp", ["odometry.wheel_noise=0.005"], 1)
    space = task.space([search])
    study = open_study(tmp_path, task.values(space), space)
    assert [found for _, found in suggest(space, study.ask())] == [value]


def test_a_trial_without_a_score_counts_as_failed(tmp_path):
    def unknown(cases):
        (settings,) = cases
        known = settings["filter.kind"] == "ekf"
        return [{"log": "toy", "error": "", "ate_m": 0.1 if known else math.nan}]

    study, _ = tune(tmp_path, 12, unknown)
    assert len(finished(study)) == 12
    failed = [trial for trial in study.trials if not trial.values]
    assert failed
    assert "toy: its best score is unknown" in failed[0].user_attrs["message"]


def test_a_search_whose_first_score_is_unknown_ends_and_can_be_continued(tmp_path):
    with pytest.raises(ConfigError, match="toy: its best score is unknown"):
        tune(tmp_path, 4, lambda cases: [{"log": "toy", "error": "", "ate_m": math.nan}])
    study, _ = tune(tmp_path, 4)
    assert len(finished(study)) == 4


def test_a_study_with_another_space_is_rejected(tmp_path):
    open_study(tmp_path, BASE, SPACE)
    with pytest.raises(ConfigError, match="contains another search"):
        open_study(tmp_path, BASE, {"filter.kind": Choice(("ekf", "oc"))})


def test_a_continued_search_does_not_repeat_its_first_suggestions(tmp_path):
    study, _ = tune(tmp_path, 4)
    study, _ = tune(tmp_path, 8)
    noise = [trial.params["odometry.wheel_noise"] for trial in study.trials]
    assert len(set(noise)) == 8


def test_scores_of_other_logs_settings_or_kinds_are_not_mixed(tmp_path):
    def opened(world="room", config="imp", settings=(), seeds=1, score="best"):
        task = Task([find_log(world)], [], config, settings, seeds)
        return open_study(tmp_path, BASE, SPACE, task.evidence(score))

    opened()
    opened()
    for other in (
        {"world": "arena"},
        {"config": "thesis-lines"},
        {"settings": ["grid.resolution=0.1"]},
        {"seeds": 2},
    ):
        with pytest.raises(
            ConfigError, match=r"another search \(with other runs\); give another -o"
        ):
            opened(**other)
    with pytest.raises(ConfigError, match=r"with other score"):
        opened(score="quality")


@pytest.mark.parametrize(
    ("range_", "value", "text"),
    [
        (Range(0.001, 1.0), 0.0123456, "0.01235"),
        (Range(0.99, 0.99999), 0.9999512345, "0.99995"),
        (Range(0.9999, 0.999999), 0.99999876, "0.9999988"),
        (Range(0.10004, 0.9), 0.1000400001, "0.10004"),
    ],
)
def test_a_suggestion_is_rounded_as_its_range_allows(range_, value, text):
    class Trial:
        def suggest_float(self, *_, **__):
            return value

    assert range_.suggest(Trial(), "key") == text


def test_the_first_reason_is_reported_if_all_trials_fail(tmp_path):
    def refuse(cases):
        return [{"log": "toy", "error": "no scan"}]

    study, _ = tune(tmp_path, 2, refuse)
    with pytest.raises(ImpError, match="no trial gave a score; the first: no scan"):
        best(study)


def test_logs_of_any_size_have_equal_weight():
    def rows(small, large):
        return [{"log": "a", "ate_m": small}, {"log": "b", "relation_m": large}]

    assert score_of(rows(0.02, 1.0), "best") == pytest.approx(score_of(rows(0.01, 2.0), "best"))
    assert score_of([{"log": "a", "nll": -3.0}, {"log": "b", "nll": 1.0}], "likelihood") == -1.0
    with pytest.raises(ConfigError, match=r"b: its truth score is unknown; give --truth FILE"):
        score_of(rows(1.0, 1.0), "truth")
    with pytest.raises(ConfigError, match=r"estimator.kind=landmarks"):
        score_of([{"log": "a", "nll": math.nan}], "likelihood")


def test_by_default_all_noise_is_searched_around_its_value():
    space = noise_space(load("imp"))
    assert space["sensors.lidar.sigma"] == Range(0.0003, 0.03)
    assert space["odometry.slip.turn_per_turn"] == Range(0.005, 0.5)
    assert "sensors.lidar.bias" not in space  # no innovation shows it
    assert "odometry.slip.forward" not in space  # 0 in this config: that there is none is known
    assert not any(key.startswith(("tracker", "landmarks")) for key in space)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("filter.kind=ekf", "expected LOW:HIGH or values"),
        ("odometry.wheel_noise=1:0.1", "the lower one first"),
        ("odometry.wheel_noise=a:b", "expected two numbers"),
    ],
)
def test_an_invalid_space_is_rejected(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_space([text], load("imp"))


def test_a_range_of_whole_numbers_stays_whole():
    assert parse_space(["filter.iterations=1:5"], load("imp", ["filter.kind=ekf"])) == {
        "filter.iterations": Range(1, 5, whole=True)
    }


def test_positive_whole_numbers_are_searched_on_a_logarithmic_scale(tmp_path):
    space = {"tracker.length": Range(1, 10000, whole=True)}
    study = open_study(tmp_path, {"tracker.length": 100}, space)
    values = [int(dict(suggest(space, study.ask()))["tracker.length"]) for _ in range(41)]
    assert values[0] == 100
    assert 20 < np.median(values) < 500
    text = dict(suggest({"k": Range(0, 10000, whole=True)}, study.ask()))["k"]
    assert 0 <= int(text) <= 10000


def test_a_held_out_log_without_a_score_does_not_lose_the_result(tmp_path):
    study, _ = tune(tmp_path, 4)
    task = Task([find_log("room")], [find_log("arena")], None, [], 1)
    rows = [
        {"log": log, "config": when, "error": "", "ate_m": error}
        for log, error in (("room", 0.02), ("arena", None))
        for when in ("before", "after")
    ]
    text = tuned_config(task, suggest(SPACE, best(study)), rows, "truth", study, tmp_path)
    assert "# room: 0.02 before, 0.02 after" in text
    assert "# arena, held out: its truth score is unknown; give --truth FILE" in text
    (tmp_path / "tuned.toml").write_text(text)
    assert load(tmp_path / "tuned.toml").robot == "imp"


def test_the_tuned_config_loads_and_contains_its_scores(tmp_path):
    study, _ = tune(tmp_path, 8)
    task = Task([find_log("room")], [find_log("arena")], None, ["grid.resolution=0.1"], 1)
    rows = [
        {"log": log, "config": when, "error": "", "ate_m": error}
        for log, when, error in (
            *(("room", "before", 0.02), ("room", "after", 0.01)),
            *(("arena", "before", 0.04), ("arena", "after", 0.05)),
        )
    ]
    found = suggest(SPACE, best(study))
    text = tuned_config(task, found, rows, "best", study, tmp_path)
    assert "# room: 0.02 before, 0.01 after" in text
    assert "# arena, held out: 0.04 before, 0.05 after" in text
    (tmp_path / "tuned.toml").write_text(text)
    config = load(tmp_path / "tuned.toml")
    assert config.filter["kind"] == "riekf"
    assert config.odometry["wheel_noise"] == float(dict(found)["odometry.wheel_noise"])
    assert config.grid.resolution == 0.1
    assert config.robot == "imp"


def test_a_range_with_an_invalid_end_is_rejected():
    task = Task([find_log("room")], [], "imp", [], 1)
    with pytest.raises(ConfigError, match=r"sensors.lidar.sigma = 500"):
        task.space(["sensors.lidar.sigma=0.001:500.0"])
    assert json.dumps(task.values(task.space([])))


def test_without_optuna_the_error_names_an_installable_package(tmp_path, monkeypatch):
    """The extra `impslam[tune]` is on no index; its packages are."""
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.setattr(extras, "requires", lambda name: ["optuna>=4; extra == 'tune'"])
    with pytest.raises(ConfigError, match="install it with `pip install 'optuna>=4'`"):
        open_study(tmp_path, BASE, SPACE)
