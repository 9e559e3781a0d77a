"""Every log is recognised by one reader alone, and read the same way twice."""

import gzip
from dataclasses import fields

import numpy as np
import pytest
from tests.sources.bags import ROS1, some
from tests.sources.logs import WRITERS

from impslam.columns import messages
from impslam.component import components
from impslam.config import load
from impslam.errors import ImpError
from impslam.sources.base import recognise
from impslam.types import Detections, LaserScan, TruePose

SOURCES = components("source")
LOGS = WRITERS | {"ros1": lambda path: some(path, ROS1), "ros2": some}


@pytest.fixture(params=sorted(LOGS), ids=str)
def log(request, tmp_path):
    return LOGS[request.param](tmp_path / "log")


def test_every_reader_has_a_log_here(tmp_path):
    """So that the tests below cover a new reader too."""
    read = {recognise(write(tmp_path / name)) for name, write in LOGS.items()}
    assert read == set(SOURCES.values())


def test_exactly_one_reader_recognises_a_log(log):
    assert sum(cls.recognises(log) for cls in SOURCES.values()) == 1


def test_reading_twice_gives_the_same(log):
    source = recognise(log)(path=log)
    with source:
        one = [(type(m).__name__, m.stamp) for m in messages(source.batches())]
    with recognise(log)(path=log) as again:
        two = [(type(m).__name__, m.stamp) for m in messages(again.batches())]
    assert one == two
    seen = {LaserScan.__name__, Detections.__name__}
    assert any(name in seen for name, _ in one)


def test_any_cutting_gives_the_same_rows_and_problems(log):
    whole, problems = cutting(log, 10**6)
    assert len({order for order, *_ in whole}) == len(whole) > 0
    assert [order for order, *_ in whole] == sorted(order for order, *_ in whole)
    for rows in (1, 2, 3, 7):
        assert cutting(log, rows) == (whole, problems)


def test_any_cutting_of_a_damaged_log_gives_the_same_rows_and_problems(log):
    damage(log)
    whole = cutting(log, 10**6)
    for rows in (1, 3):
        assert cutting(log, rows) == whole


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_any_cutting_of_a_truncated_log_gives_the_same_rows_and_problems(log, share):
    truncate(log, share)
    whole = cutting_or_error(log, 10**6)
    for rows in (1, 3):
        assert cutting_or_error(log, rows) == whole


def test_streams_are_called_what_their_columns_are(log):
    with recognise(log)(path=log) as source:
        streams = {stream.name: stream for stream in source.streams()}
        given = {name: c for batch in source.batches() for name, c in batch.items()}
    mapped = {name for name, columns in given.items() if columns.kind is not TruePose}
    assert mapped <= {stream.name for stream in streams.values() if stream.used}
    assert mapped <= {stream.name for stream in streams.values() if stream.default} <= set(given)
    for kind, name in source.defaults().items():
        assert name not in given or given[name].kind is kind


def test_a_stream_that_the_log_lacks_is_refused(log):
    with (
        recognise(log)(path=log, wanted=("no such stream",)) as source,
        pytest.raises(ImpError, match=r"no stream 'no such stream'"),
    ):
        list(source.batches())


def cutting(log, rows):
    """Return all rows to the byte, and the problems, of a log read so many rows at a time."""
    found = []
    with recognise(log)(path=log) as source:
        for batch in source.batches(rows):
            assert 0 < sum(map(len, batch.values())) <= rows
            for name, columns in batch.items():
                assert name == columns.stream
                found += [row_bytes(columns, k) for k in range(len(columns))]
    return sorted(found), source.problems


def cutting_or_error(log, rows):
    try:
        return cutting(log, rows)
    except ImpError as error:
        return str(error)


def truncate(log, share):
    """Cut off the end of each file."""
    for path in [path for path in log.rglob("*") if path.is_file()] if log.is_dir() else [log]:
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])


def row_bytes(columns, k):
    row = columns.row(k)
    values = [getattr(row, field.name) for field in fields(row)]
    said = [v.tobytes() if isinstance(v, np.ndarray) else repr(v) for v in values]
    return int(columns.order[k]), columns.stream, columns.kind.__name__, said


def damage(log):
    """Spoil the middle of each text file: a line without sense, one cut short, one with a NaN."""
    for path in list(log.glob("*.[dt][ax]t")) if log.is_dir() else [log]:
        if b"\0" in path.read_bytes():  # a bag, or MATLAB's
            continue
        lines = path.read_bytes().split(b"\n")
        middle = len(lines) // 2
        sound = lines[middle]
        spoilt = [b"what", sound[: len(sound) // 2], sound.replace(b"5", b"nan"), sound]
        path.write_bytes(b"\n".join(lines[:middle] + spoilt + lines[middle:]))


def test_the_preset_of_a_log_exists(log):
    with recognise(log)(path=log) as source:
        load(source.preset)


@pytest.mark.parametrize("name", sorted(SOURCES))
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n\n",
        b"hello\n",
        b"\x00" * 100,
        b"\xff\xfe\x00",
        b"{}",
        b"1 2 3\n",
        gzip.compress(b"", mtime=0),  # a name of the test that does not depend on the time
    ],
)
def test_nothing_else_is_recognised(name, content, tmp_path):
    file = tmp_path / "thing.mcap"  # the name says nothing
    file.write_bytes(content)
    assert not SOURCES[name].recognises(file)
    with pytest.raises(ImpError) as error:
        recognise(file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_an_empty_folder_is_not_recognised(name, tmp_path):
    assert not SOURCES[name].recognises(tmp_path)
