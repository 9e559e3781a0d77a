"""Journal and table of a sweep: robust against crashes, and independent of the order of the runs."""

import csv
import errno
import math
from contextlib import contextmanager

import pytest

from impslam.errors import ConfigError, ImpError
from impslam.paths import replacement
from impslam.sweeps.journal import JOURNAL, Journal
from impslam.sweeps.table import CSV, PARQUET, write_table


def row(seed, error="", **more):
    who = {"log": "a", "config": "", "settings": {"x.y": 0.5}, "seed": seed}
    hashes = {"log_sha256": "1", "config_sha256": "2", "references_sha256": ""}
    return {**who, **hashes, "error": error, **more}


def test_a_journal_ignores_an_incomplete_line_and_knows_finished_runs(tmp_path):
    journal = Journal(tmp_path)
    for one in (row(0, ate_m=0.25), row(1, "IMU on fire"), row(2, ate_m=math.nan)):
        journal.add(one)
    with (tmp_path / JOURNAL).open("a") as file:
        file.write('{"log": "a", "config"')
    again = Journal(tmp_path)
    assert [again.has(row(seed)) for seed in range(4)] == [True, False, True, False]
    assert not again.has({**row(0), "log_sha256": "another log of that name"})
    again.add(row(1, ate_m=0.5))
    assert [r.get("ate_m") for r in Journal(tmp_path).rows()] == [0.25, 0.5, None]


def test_a_run_is_repeated_if_a_file_has_changed_and_its_new_row_replaces_the_old_one(tmp_path):
    journal = Journal(tmp_path)
    journal.add(row(0, ate_m=0.25))
    for name in ("log_sha256", "config_sha256", "references_sha256"):
        assert not journal.has({**row(0), name: "3"})
    journal.add({**row(0, ate_m=0.5), "config_sha256": "3"})
    for known in (journal, Journal(tmp_path)):
        assert [r["ate_m"] for r in known.rows()] == [0.5]
        assert known.has({**row(0), "config_sha256": "3"})
        assert not known.has(row(0))


def test_a_folder_with_other_content_is_rejected(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ConfigError, match="is not the folder of a sweep"):
        Journal(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_the_table_has_a_row_for_each_run_in_order(tmp_path):
    rows = [row(1, "IMU on fire"), row(0, scans=7, ate_m=0.25, cpu_s=1.5)]
    assert write_table(tmp_path, rows)[0] == tmp_path / CSV
    with (tmp_path / CSV).open() as file:
        first, second = csv.DictReader(file)
    assert list(first) == [
        *("log", "config", "x.y", "seed", "status", "message", "scans", "ate_m"),
        *("cpu_s", "log_sha256", "config_sha256", "references_sha256"),
    ]
    assert (first["seed"], first["status"], first["ate_m"]) == ("0", "ok", "0.25")
    assert (second["status"], second["message"], second["ate_m"]) == ("failed", "IMU on fire", "")


def test_rows_are_sorted_by_the_size_of_numbers(tmp_path):
    rows = [
        {**row(seed), "settings": {"k": value}} for value in ("auto", 10, 2.0) for seed in (10, 2)
    ]
    write_table(tmp_path, rows)
    with (tmp_path / CSV).open() as file:
        found = [(one["k"], one["seed"]) for one in csv.DictReader(file)]
    assert found == [(k, seed) for k in ("2.0", "10", "auto") for seed in ("2", "10")]


def test_parquet_contains_the_same_with_types(tmp_path):
    io = pytest.importorskip("arro3.io")
    write_table(tmp_path, [row(0, scans=7, ate_m=0.25), row(1, "lost")])
    table = io.read_parquet(tmp_path / PARQUET).read_all()
    assert table["seed"].to_pylist() == [0, 1]
    assert table["scans"].to_pylist() == [7, None]
    assert table["ate_m"].to_pylist() == [0.25, None]
    assert table["message"].to_pylist() == ["", "lost"]


@pytest.mark.parametrize("name", [CSV, PARQUET])
def test_on_a_full_disk_the_files_stay_as_they_were(tmp_path, monkeypatch, name):
    pytest.importorskip("arro3.io")
    write_table(tmp_path, [row(0)])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    @contextmanager
    def full(path):
        if path.name == name:
            raise OSError(errno.ENOSPC, "No space left on device")
        with replacement(path) as stream:
            yield stream

    monkeypatch.setattr("impslam.paths.replacement", full)
    with pytest.raises(
        ImpError, match=rf"{name}: cannot be written \(No space left on device\); free"
    ):
        write_table(tmp_path, [row(0), row(1)])
    assert (tmp_path / name).read_bytes() == before[tmp_path / name]
    assert {path.name for path in tmp_path.iterdir()} == {CSV, PARQUET}


def test_without_the_extra_only_csv_is_written(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(__import__("sys").modules, "arro3.core", None)
    assert write_table(tmp_path, [row(0)]) == [tmp_path / CSV]
    assert "for Parquet: pip install " in caplog.text
