"""Runs of a sweep: all combinations; invalid ones are rejected before anything runs."""

import pytest

from impslam.errors import ConfigError, SourceError
from impslam.sweeps.cases import alternatives, cases, find_log, plain


def test_every_combination_in_order():
    logs = [find_log("arena"), find_log("room")]
    made = cases(logs, ["imp", "thesis-lines"], {"filter.kind": ["ekf", "riekf"]}, 2)
    assert [case.log.name for case in made] == ["arena"] * 8 + ["room"] * 8
    assert len({(c.log.name, c.config, c.settings, c.seed) for c in made}) == 16
    assert made[0].overrides == ["filter.kind=ekf", "seed=0"]
    assert made[1].row() | {"log_sha256": "", "config_sha256": ""} == {
        "log": "arena",
        "config": "imp",
        "settings": {"filter.kind": "ekf"},
        "seed": 1,
        "log_sha256": "",
        "config_sha256": "",
    }


def test_a_config_is_identified_by_its_content(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('base = "imp"\n')
    (before,) = cases([find_log("room")], [str(file)], {}, 1)
    file.write_text('base = "imp"\nstart = [1.0, 0.0, 0.0]\n')
    (after,) = cases([find_log("room")], [str(file)], {}, 1)
    assert before.row() != after.row()


def test_an_unknown_setting_is_rejected_before_anything_runs():
    with pytest.raises(ConfigError, match="knd is not a parameter"):
        cases([find_log("room")], ["imp"], {"filter.knd": ["ekf"]}, 3)


def test_invalid_logs_are_rejected():
    with pytest.raises(
        SourceError, match=r"aren: no such file or folder, and none of the worlds arena"
    ):
        find_log("aren")


def test_commas_separate_values_except_in_brackets_and_quotes():
    assert alternatives(["a.b=1,2.5", "c=[1, 2],[3,4]", 'd="x,y"', "a.b=7"]) == {
        "a.b": ["1", "2.5", "7"],
        "c": ["[1, 2]", "[3,4]"],
        "d": ['"x,y"'],
    }
    with pytest.raises(ConfigError, match="expected key=value"):
        alternatives(["filter"])


def test_values_are_parsed_as_numbers_if_possible():
    assert [plain(text) for text in ("1", "2.5", "true", "ekf", "[1]")] == [
        1,
        2.5,
        True,
        "ekf",
        "[1]",
    ]
