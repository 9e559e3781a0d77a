from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from pathlib import Path

import pytest

from impslam.errors import ConfigError
from impslam.paths import (
    is_file,
    keep_inputs,
    make_folder,
    numbered,
    portable,
    read_text,
    replacement,
)


def test_names_are_numbered_before_the_suffix(tmp_path: Path) -> None:
    names = [path.name for path in islice(numbered(tmp_path, "exp.1", ".mcap"), 3)]
    assert names == ["exp.1.mcap", "exp.1-2.mcap", "exp.1-3.mcap"]


@pytest.mark.parametrize(
    ("there", "name"),
    [([], "exp.1"), (["exp.1", "exp.1-2"], "exp.1-3"), (["exp.1", "exp.1-3"], "exp.1-2")],
)
def test_a_name_that_is_taken_gets_a_number(tmp_path: Path, there: list[str], name: str) -> None:
    for taken in there:
        (tmp_path / "runs" / taken).mkdir(parents=True)
    folder = make_folder(tmp_path / "runs", "exp.1")
    assert folder == tmp_path / "runs" / name
    assert folder.is_dir()


def test_nobody_shares_a_folder(tmp_path: Path) -> None:
    """Whoever is as fast: each of many at once has one of its own."""
    with ThreadPoolExecutor(16) as pool:
        made = list(pool.map(lambda _: make_folder(tmp_path / "runs", "log"), range(64)))
    assert len(set(made)) == 64


def test_a_path_in_the_same_tree_is_relative(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert portable(Path("base.toml"), Path()) == "base.toml"
    assert portable(Path("base.toml"), tmp_path / "out") == "../base.toml"
    assert portable(tmp_path / "a" / "base.toml", Path("b")) == "../a/base.toml"
    assert portable(Path("/elsewhere/base.toml"), tmp_path) == str(Path("/elsewhere/base.toml"))


def test_a_name_that_cannot_be_one_is_no_file(tmp_path: Path) -> None:
    assert not is_file(tmp_path / "a\0b")
    assert not is_file(tmp_path / ("a" * 10_000))


def test_an_output_that_is_an_input_is_refused_under_any_name(tmp_path: Path) -> None:
    log, bag = tmp_path / "a.log", tmp_path / "bag"
    log.write_text("1")
    bag.mkdir()
    (tmp_path / "link.log").symlink_to(log)
    (tmp_path / "hard.log").hardlink_to(log)
    for name in ("a.log", "link.log", "hard.log", "bag/../a.log", "bag", "bag/new/b.csv"):
        with pytest.raises(ConfigError, match="would change it; give another path"):
            keep_inputs([None, bag, log], [None, tmp_path / name])
    keep_inputs([log, bag, tmp_path / "preset"], [tmp_path / "b.log", tmp_path / "preset"])


def test_a_file_is_replaced_completely_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(b"old")
    with suppress(OSError), replacement(file) as stream:
        stream.write(b"ne")
        raise OSError("the disk is full")
    assert file.read_bytes() == b"old"
    with replacement(file) as stream:
        stream.write(b"new")
    assert file.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [file]


def test_a_device_is_written_to_and_stays() -> None:
    with replacement(Path("/dev/null")) as stream:
        stream.write(b"lost")
    assert Path("/dev/null").is_char_device()


def test_a_text_that_cannot_be_read_is_explained_in_one_line(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"none\.toml: no such file; look there$"):
        read_text(tmp_path / "none.toml", "look there", ConfigError)
    with pytest.raises(ConfigError, match=r"cannot be read as text \(.*decode.*\); look there$"):
        read_text(binary, "look there", ConfigError)
    folder = r"cannot be read as text \((Is a directory|Permission denied)\); look there$"
    with pytest.raises(ConfigError, match=folder):
        read_text(tmp_path, "look there", ConfigError)
