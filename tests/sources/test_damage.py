"""Whatever happened to a log, it is refused in one line or read with sound messages only."""

import gzip
import shutil
import subprocess
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.sources.bags import ROS1, ROS2, bag, scan, some
from tests.sources.logs import (
    WRITERS,
    dat_line,
    flaser,
    odom,
    read,
    read_or_refuse,
    robot_laser,
)

from impslam.columns import messages
from impslam.errors import SourceError
from impslam.sources.base import recognise

STORAGES = {
    "ros1": lambda path: some(path, ROS1),
    "ros2": some,
    "mcap folder": lambda path: some(path.with_name("mcap")),
    "mcap": lambda path: next(some(path.with_name("mcap2")).glob("*.mcap")).rename(path),
    "db3": lambda path: next(some(path.with_name("lite")).glob("*.db3")).rename(path),
}
FORMATS = sorted(WRITERS)
DAMAGED = sorted(WRITERS | STORAGES)
FUZZ = settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.fixture
def logs(tmp_path: Path) -> dict[str, Path]:
    return {name: write(tmp_path / f"{name}-log") for name, write in WRITERS.items()}


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("originals")
    writers = WRITERS | STORAGES
    return {name: write(folder / f"{name}-log") for name, write in writers.items()}


def damaged_file(log: Path) -> Path:
    """The file to damage: of a folder, the largest, which has the scans."""
    if log.is_dir():
        return max(log.iterdir(), key=lambda file: file.stat().st_size)
    return log


def copy(log: Path, folder: Path) -> Path:
    target = folder / "damaged"
    if target.exists():
        shutil.rmtree(target) if target.is_dir() else target.unlink()
    shutil.copytree(log, target) if log.is_dir() else shutil.copy(log, target)
    return target


@pytest.mark.parametrize("name", FORMATS)
def test_formats_are_never_confused(logs: dict[str, Path], name: str) -> None:
    assert recognise(logs[name]).name == name
    known = [cls for cls in map(recognise, logs.values()) if cls.recognises(logs[name])]
    assert [cls.name for cls in known] == [name]


@pytest.mark.parametrize(
    "content",
    [
        b"\0" * 1000,
        b"\n\n\n",
        b"hello world\n",
        b"1 2 3\n4 5 6\n",
        b"x,y\n1,2\n",
        b"\x1f\x8b not gzip",
        b"\x89PNG\r\n\x1a\n",
        b"ODOM\n",
        b"FLASER",
        bytes(range(256)),
    ],
)
def test_other_files_are_one_line_errors(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r"^.*file: no known log format; readable are [^\n]*$"):
        recognise(path)


def test_for_other_formats_csv_is_named(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"XIAON 224 0000 0001\n")
    with pytest.raises(SourceError, match="of another format as CSV"):
        recognise(path)


def test_a_file_that_begins_with_zeros_is_explained(tmp_path: Path) -> None:
    """As a recorder leaves it that goes on behind what another program cut off."""
    path = tmp_path / "file.mcap"
    path.write_bytes(bytes(5000) + b"\x06 and more")
    with pytest.raises(SourceError, match="begins with zeros: writing was interrupted"):
        recognise(path)


def test_a_packed_bag_is_explained(tmp_path: Path) -> None:
    (log := tmp_path / "log.bag.gz").write_bytes(gzip.compress(b"#ROSBAG V2.0\n" + bytes(100)))
    with pytest.raises(
        SourceError, match=r"it is packed; unpack it first: gunzip -k .*/log\.bag\.gz$"
    ):
        recognise(log)


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("log.rawlog", "gunzip -c {0}.rawlog > {0}.rawlog.unpacked"),
        ("log", "gunzip -c {0} > {0}.unpacked"),
        ("log.gz", "gunzip -k {0}.gz"),
    ],
)
def test_the_command_that_unpacks_a_file_works(tmp_path: Path, name: str, command: str) -> None:
    (log := tmp_path / name).write_bytes(gzip.compress(b"#ROSBAG V2.0\n" + bytes(100)))
    with pytest.raises(SourceError) as error:
        recognise(log)
    said = str(error.value).partition("unpack it first: ")[2]
    assert said == command.format(tmp_path / "log")
    subprocess.run(said, shell=True, check=True, cwd=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("name", ["log.bag", "log.mcap", "log.db3", "log.csv"])
def test_a_pointer_of_git_lfs_is_explained(tmp_path: Path, name: str) -> None:
    text = "version https://git-lfs.github.com/spec/v1\noid sha256:aa20eaef40\nsize 347807744\n"
    (tmp_path / name).write_text(text)
    with pytest.raises(
        SourceError, match=rf"{name}: no known .*; it is a pointer .* `git lfs pull`"
    ):
        recognise(tmp_path / name)


@pytest.mark.parametrize("name", ["logs.tar.gz", "logs.tgz", "logs.tar.xz"])
def test_an_archive_is_unpacked_as_one(tmp_path: Path, name: str) -> None:
    content = b"\xfd7zXZ\x00" if name.endswith("xz") else gzip.compress(b"any")
    (tmp_path / name).write_bytes(content + bytes(20))
    with pytest.raises(SourceError, match=rf"unpack it first: tar xf .*{name}$"):
        recognise(tmp_path / name)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", [b"\x8dCSensoryFrame\x02\x01", b"\x91CActionCollection\x00"])
def test_a_binary_rawlog_is_explained(tmp_path: Path, kind: bytes, packed: bool) -> None:
    content = kind + bytes(500)
    (log := tmp_path / "log.rawlog").write_bytes(gzip.compress(content) if packed else content)
    with pytest.raises(SourceError, match="a binary rawlog of MRPT: export it with raw") as error:
        recognise(log)
    assert "packed" not in str(error.value)


def test_a_bag_of_an_early_version_is_explained(tmp_path: Path) -> None:
    path = tmp_path / "file.bag"
    path.write_bytes(b"#ROSRECORD V1.2\n" + bytes(4096))
    with pytest.raises(SourceError, match=r"a ROS bag of version 1\.2.*`rosbag filter OLD"):
        recognise(path)


@pytest.mark.parametrize("as_folder", [False, True])
def test_an_mcap_with_a_hole_is_reported(tmp_path: Path, as_folder: bool) -> None:
    """Nothing is compressed and nothing has a checksum, as `ros2 bag record` writes by default."""
    folder = bag(tmp_path / "mcap", *[("/scan", scan(ROS2, n=50))] * 40)
    file = next(folder.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    middle = content.index(b"\x05", len(content) // 3)  # a message
    content[middle : middle + 999] = bytes(999)
    file.write_bytes(content)
    found, source = read(folder if as_folder else file)
    assert len(found) < 40
    assert set(source.problems.counts) & {"missing messages", "damaged file"}


def test_a_folder_with_a_truncated_mcap_is_reported(tmp_path: Path) -> None:
    folder = bag(tmp_path / "mcap", *[("/scan", scan(ROS2, n=50_000))] * 40)
    file = next(folder.glob("*.mcap"))
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    found, source = read(folder)
    assert 10 < len(found) < 40
    assert set(source.problems.counts) >= {"cut file"}


def test_an_empty_path_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    for path, why in ((tmp_path / "empty", "is empty"), (tmp_path / "no", "no such file")):
        with pytest.raises(SourceError, match=why):
            recognise(path)
    with pytest.raises(SourceError, match="no known log format"):
        recognise(tmp_path)


@pytest.mark.parametrize("name", DAMAGED)
@FUZZ
@given(cut=st.floats(0.0, 1.0))
def test_cut_anywhere(originals: dict[str, Path], tmp_path: Path, name: str, cut: float) -> None:
    path = copy(originals[name], tmp_path)
    file = damaged_file(path)
    content = file.read_bytes()
    file.write_bytes(content[: int(cut * len(content))])
    read_or_refuse(path)


@pytest.mark.parametrize("name", DAMAGED)
@FUZZ
@given(st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=20))
def test_bytes_flipped(
    originals: dict[str, Path], tmp_path: Path, name: str, flips: list[tuple[float, int]]
) -> None:
    path = copy(originals[name], tmp_path)
    file = damaged_file(path)
    content = bytearray(file.read_bytes())
    for where, value in flips:
        content[int(where * len(content))] = value
    file.write_bytes(content)
    read_or_refuse(path)


@pytest.mark.parametrize("name", DAMAGED)
@FUZZ
@given(tail=st.binary(max_size=400))
def test_bytes_appended_to_the_head(
    originals: dict[str, Path], tmp_path: Path, name: str, tail: bytes
) -> None:
    path = copy(originals[name], tmp_path)
    file = damaged_file(path)
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 3] + tail)
    read_or_refuse(path)


WORDS = st.sampled_from(
    ["nan", "inf", "-1", "0", "1e999", "x", "", "9" * 400, "1.5", "ODOM", "FLASER", "-0", "1_0"]
)


@pytest.mark.parametrize("line", [flaser(1.0), odom(1.0), robot_laser(1.0), dat_line(9, 1, 2)])
@FUZZ
@given(st.lists(st.tuples(st.integers(0, 800), WORDS), min_size=1, max_size=5))
def test_words_replaced(tmp_path: Path, line: str, changes: list[tuple[int, str]]) -> None:
    words = line.split()
    for where, word in changes:
        words[where % len(words)] = word
    path = tmp_path / "log"
    path.write_text("\n".join([line, " ".join(words), line]) + "\n")
    read_or_refuse(path)


@FUZZ
@given(st.binary(max_size=2000))
def test_random_bytes(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log"
    path.write_bytes(content)
    read_or_refuse(path)


@FUZZ
@given(st.text("MS 0123456789.-\nnaif", max_size=300))
def test_random_words_in_a_lego_folder(logs: dict[str, Path], tmp_path: Path, text: str) -> None:
    path = copy(logs["lego"], tmp_path)
    (path / "run_motors.txt").write_text("M 1 2 3 4 5 6 7\n" + text)
    read_or_refuse(path)


@pytest.mark.parametrize("name", ["carmen", "dat"])
def test_memory_stays_flat(tmp_path: Path, name: str, rng: np.random.Generator) -> None:
    make = {
        "carmen": lambda i: flaser(i * 0.1, rng.random(180).round(2)),
        "dat": lambda i: dat_line(100_000 * i, i, i, rng.integers(0, 5000, 682)),
    }[name]
    peaks = []
    for n in (1000, 4000):
        path = tmp_path / f"{n}"
        path.write_text("".join(make(i) + "\n" for i in range(n)))
        peaks.append(_peak(path))
    assert peaks[1] < 1.2 * peaks[0] + 50_000  # bytes; the longer file has 2 MB more


def _peak(path: Path) -> int:
    with recognise(path)(path=path) as source:
        tracemalloc.start()
        count = sum(1 for _ in messages(source.batches(64)))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert count > 100
    return peak


def test_a_file_without_line_ends_does_not_fill_memory(tmp_path: Path) -> None:
    path = tmp_path / "log"
    path.write_text(odom(1.0) + "\n" + "7 " * 5_000_000)
    with recognise(path)(path=path) as source:
        tracemalloc.start()
        assert len(list(messages(source.batches()))) == 1
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert sum(source.problems.counts.values()) > 5
    assert peak < 60e6  # bytes: one line's limit of 1 MiB, split into words


def test_two_passes_give_the_same(logs: dict[str, Path]) -> None:
    for path in logs.values():
        with recognise(path)(path=path) as source:
            stamps = [[m.stamp for m in messages(source.batches())] for _ in range(2)]
        assert stamps[0] == stamps[1]
        assert len(read(path)[0]) == len(stamps[0]) > 0
