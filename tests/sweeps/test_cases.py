"""Runs of a sweep: all combinations; invalid ones are rejected before anything runs."""

from pathlib import Path

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
        "references_sha256": "",
    }


def test_a_config_is_identified_by_its_content(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text('base = "imp"\n')
    (before,) = cases([find_log("room")], [str(file)], {}, 1)
    file.write_text('base = "imp"\nstart = [1.0, 0.0, 0.0]\n')
    (after,) = cases([find_log("room")], [str(file)], {}, 1)
    assert before.row() != after.row()


def test_configs_with_the_same_file_name_have_different_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "config.toml").write_text('base = "imp"\n')
    files = ["first/config.toml", "./second/config.toml"]
    made = cases([find_log("room")], files, {}, 1)
    assert [case.row()["config"] for case in made] == [str(Path(file)) for file in files]


def test_a_log_is_identified_with_the_files_that_score_it(tmp_path):
    log, truth = tmp_path / "drive.log", tmp_path / "truth.tum"
    log.write_text("ODOM 0.0 0.0 0.0 0.0 0.0 0.0 1.0 host 1.0\n" * 2)
    truth.write_text("0 0 0 0 0 0 0 1\n")
    found = [
        find_log(str(log)),
        find_log(str(log), str(truth)),
        find_log(str(log), None, str(truth)),
    ]
    truth.write_text("0 1 0 0 0 0 0 1\n")
    found.append(find_log(str(log), str(truth)))
    (tmp_path / "drive.landmarks.csv").write_text("x,y\n1,2\n")
    found += [find_log(str(log)), find_log(str(log), str(truth))]
    assert found[0].references == ""
    assert len({log.references for log in found}) == len(found)
    assert len({log.content for log in found}) == 1


def test_the_seed_is_not_a_setting():
    with pytest.raises(ConfigError, match=r"seed: each run has its own one; .* --seeds"):
        cases([find_log("room")], ["imp"], {"seed": ["1", "2"]}, 1)


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
